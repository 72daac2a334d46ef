"""Runs where vcan0 is: plays a recording in real time, the service listens, candump writes down everything.

live.py CONFIG RECORDING OUT      leaves OUT/bus.log and OUT/filters; exit status is the service's

A machine may stand still for seconds: nobody is stopped before he has heard all that was played.
"""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import can

SOILBUS = [sys.executable, "-c", "import sys; from soilbus.cli.main import main; sys.exit(main())"]
LAST = b"the last"


def main(config: str, recording: str, out: Path) -> int:
    ready, heard_out = threading.Event(), threading.Event()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify, (out / "bus.log").open("wb") as log:
        (out / "notify").unlink(missing_ok=True)
        notify.bind(str(out / "notify"))
        threading.Thread(target=_listen, args=(notify, ready, heard_out), daemon=True).start()
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
            heard_out.clear()
            subprocess.run(["canplayer", "-I", recording, "vcan0=can0"], check=True)
            if not heard_out.wait(20.0):
                sys.exit("the service never told that the bus is silent")
            service.send_signal(signal.SIGTERM)
            status = service.wait(15.0)
            _written_down(out / "bus.log")
            return status
        finally:
            service.kill()
            candump.terminate()
            candump.wait(5.0)


def _listen(notify: socket.socket, ready: threading.Event, heard_out: threading.Event) -> None:
    """systemd's end of the notification socket."""
    while True:
        text = notify.recv(4096)
        if b"READY=1" in text:
            ready.set()
        if b"STATUS=listening: no_frames" in text:
            heard_out.set()


def _written_down(log: Path) -> None:
    """Wait until candump has written a last frame of ours, and so all before it."""
    with can.Bus(interface="socketcan", channel="vcan0", can_filters=[]) as bus:
        bus.send(can.Message(arbitration_id=0x7FF, is_extended_id=False, data=LAST))
    end = time.monotonic() + 20.0
    while f"7FF#{LAST.hex().upper()}" not in log.read_text():
        if time.monotonic() > end:
            sys.exit("candump has not written down the last frame")
        time.sleep(0.1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], Path(sys.argv[3])))
