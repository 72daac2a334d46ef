"""The newcomer's first minute."""

import resource
import subprocess
import sys
import time

DRIVE = 42.0 / 8.0
"""Time [s] that the drive takes: simulated seconds over the compression."""


def run(*arguments: str) -> tuple[subprocess.CompletedProcess[str], float, float]:
    """What Python did with these arguments, the time it took [s] and the processor's time [s], whatever runs beside."""
    begin, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=60)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return done, time.monotonic() - begin, used


def test_demo_ends_by_itself_in_time_and_turns_from_go_to_no_go():
    """It takes the drive's time and the work of less than 5.5 starts: 6 s where a start with bytecode takes 1.1 s."""
    _, _, start = run("-c", "import soilbus.cli.demo")
    done, taken, used = run("-m", "soilbus", "demo")
    _, _, again = run("-c", "import soilbus.cli.demo")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    story = [line.split() for line in done.stdout.splitlines() if line.endswith(("GO", "NO-GO", "UNKNOWN", "CAUTION"))]
    decisions = [words[-1] for words in story]
    assert decisions[0] == "GO"
    assert "NO-GO" in decisions[-4:]
    assert taken > DRIVE
    assert used < 5.5 * max(start, again)
