"""Runs where vcan0 is: plays a recording in real time, the service listens, candump writes down everything.

live.py CONFIG RECORDING OUT      leaves OUT/bus.log and OUT/filters; exit status is the service's
"""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

SOILBUS = [sys.executable, "-c", "import sys; from soilbus.cli import main; sys.exit(main())"]


def main(config: str, recording: str, out: Path) -> int:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify, (out / "bus.log").open("wb") as log:
        notify.bind(str(out / "notify"))
        notify.settimeout(60.0)
        candump = subprocess.Popen(["candump", "-L", "-r", "4194304", "vcan0"], stdout=log)
        service = subprocess.Popen(
            [*SOILBUS, "run", "--config", config, "--set", "bus.interface=socketcan", "--set", "bus.channel=vcan0"],
            env={**os.environ, "NOTIFY_SOCKET": str(out / "notify")},
        )
        try:
            while b"READY=1" not in notify.recv(4096):
                pass
            (out / "filters").write_text("".join(p.read_text() for p in Path("/proc/net/can").glob("rcvlist_*")))
            subprocess.run(["canplayer", "-I", recording, "vcan0=can0"], check=True)
            service.send_signal(signal.SIGTERM)
            return service.wait(15.0)
        finally:
            service.kill()
            candump.terminate()
            candump.wait(5.0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], Path(sys.argv[3])))
