"""The tracer of one hop: what it counts, and that it counts the same again."""

import os
import re
import subprocess
import sys
from pathlib import Path

import soilbus
from tests.lab.hop_trace import hop_trace

REPO = Path(__file__).resolve().parents[2]
COUNTS = r"(\d+) files, (\d+) functions, (\d+) calls of soilbus\n"
LINES = re.compile(f"one hop enters {COUNTS}with its watch it enters {COUNTS}")


def test_another_process_prints_the_same_counts():
    program = [sys.executable, "-m", "tests.lab.hop_trace"]
    env = {**os.environ, "PYTHONPATH": str(Path(soilbus.__file__).parents[1])}
    text = subprocess.run(program, check=True, capture_output=True, text=True, env=env, cwd=REPO).stdout
    found, here = LINES.fullmatch(text), hop_trace()
    assert found is not None
    assert 0 < here.files < here.functions < here.calls
    assert tuple(map(int, found.groups())) == (*here, *hop_trace(watched=True))


def test_profiling_is_off_again_after_the_trace():
    hop_trace(warm_hops=0)
    assert sys.getprofile() is None
