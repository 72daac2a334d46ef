"""The harness itself: what the vcan and systemd tests rely on."""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
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


@pytest.mark.vcan
def test_the_guests_kernel_and_its_processes_keep_to_one_processor(vcan_run, tmp_path: Path) -> None:
    """Where they may go to another one a system call in there takes five times as long."""
    goes_on = tmp_path / "goes_on"
    goes_on.touch()
    seen: set[str] = set()
    with ThreadPoolExecutor(1) as beside:
        done = beside.submit(vcan_run, ["sh", "-c", f"while test -e {goes_on}; do sleep 0.1; done"], rw=[tmp_path])
        while len(seen) < 5 and not done.done():  # kernel, init, sh, sleep
            seen |= _processes_of_guests()
        allowed = {pid: _allowed(pid) for pid in seen}
        goes_on.unlink()
        assert done.result().returncode == 0
    assert len(seen) >= 5
    assert {1} == {len(processors) for processors in allowed.values() if processors}


def _processes_of_guests() -> set[str]:
    """Processes of this machine that are guests of ours, by number."""
    found = set()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes()
            if words.split(b"\0")[0].endswith(b"linux.uml") and b"umid=guest-" in words:
                found.add(folder.name)
        except OSError:  # it has just ended
            continue
    return found


def _allowed(pid: str) -> set[int]:
    """Where a process may run; nowhere if it has ended."""
    try:
        return os.sched_getaffinity(int(pid))
    except ProcessLookupError:
        return set()
