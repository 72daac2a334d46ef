"""Runs where vcan0 is: plays a recording in real time, the service listens, candump writes down everything.

live.py CONFIG RECORDING OUT      leaves OUT/bus.log and OUT/filters; exit status is the service's
"""

import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

SOILBUS = [sys.executable, "-c", "import sys; from soilbus.cli import main; sys.exit(main())"]


def main(config: str, recording: str, out: Path) -> int:
    ready = threading.Event()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify, (out / "bus.log").open("wb") as log:
        notify.bind(str(out / "notify"))
        threading.Thread(target=_listen, args=(notify, ready), daemon=True).start()
        candump = subprocess.Popen(["candump", "-L", "-r", "4194304", "vcan0"], stdout=log)
        service = subprocess.Popen(
            [*SOILBUS, "run", "--config", config, "--set", "bus.interface=socketcan", "--set", "bus.channel=vcan0"],
            env={**os.environ, "NOTIFY_SOCKET": str(out / "notify")},
        )
        try:
            if not ready.wait(60.0):
                sys.exit("the service did not become ready in 60 s")
            lists = [Path(f"/proc/net/can/rcvlist_{kind}") for kind in ("all", "fil", "sff", "eff")]
            (out / "filters").write_text("".join(path.read_text() for path in lists))
            subprocess.run(["canplayer", "-I", recording, "vcan0=can0"], check=True)
            service.send_signal(signal.SIGTERM)
            return service.wait(15.0)
        finally:
            service.kill()
            candump.terminate()
            candump.wait(5.0)


def _listen(notify: socket.socket, ready: threading.Event) -> None:
    """systemd's end of the notification socket."""
    while True:
        if b"READY=1" in notify.recv(4096):
            ready.set()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], Path(sys.argv[3])))
