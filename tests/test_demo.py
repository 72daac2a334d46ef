"""The newcomer's first minute."""

from __future__ import annotations

import subprocess
import sys
import time


def test_demo_ends_by_itself_in_time_and_turns_from_go_to_no_go():
    begin = time.monotonic()
    done = subprocess.run([sys.executable, "-m", "soilbus", "demo"], capture_output=True, text=True, timeout=60)
    taken = time.monotonic() - begin
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    story = [line.split() for line in done.stdout.splitlines() if line.endswith(("GO", "NO-GO", "UNKNOWN", "CAUTION"))]
    decisions = [words[-1] for words in story]
    assert decisions[0] == "GO"
    assert "NO-GO" in decisions[-4:]
    assert taken < 10.0
