"""The harness itself: what the vcan and systemd tests rely on."""

import sys
from pathlib import Path

import pytest

import guest
from availability import unavailable

ONE_FRAME = """
import os, socket, struct
def can():
    s = socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    s.bind(("vcan0",))
    return s
a, b = can(), can()
b.settimeout(5)
a.send(struct.pack("=IB3x8s", 0x123, 8, b"soilbus!"))
open(os.environ["PATH_OUT"], "wb").write(b.recv(16)[8:])
print("a line")
raise SystemExit(7)
"""


@pytest.mark.vcan
def test_frames_output_status_and_shared_folder(vcan_run, tmp_path: Path) -> None:
    out = tmp_path / "frame"
    done = vcan_run(["env", f"PATH_OUT={out}", sys.executable, "-c", ONE_FRAME], rw=[tmp_path])
    assert (done.returncode, done.stdout) == (7, "a line\n")
    assert out.read_bytes() == b"soilbus!"


@pytest.mark.vcan
def test_a_guest_that_hangs_ends_at_its_time_limit(tmp_path: Path) -> None:
    try:
        done = guest.run(["sh", "-c", f"echo before; echo lost > {tmp_path}/lost; sleep 1000"], timeout=5.0)
    except guest.Unavailable as reason:
        unavailable(str(reason))
        raise
    assert done.returncode == guest.NO_STATUS
    assert "before\n" in done.stdout
    assert "took more than 5 s" in done.stdout
    assert not (tmp_path / "lost").exists()  # written to the throw-away layer
