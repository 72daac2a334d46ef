"""The tracer of one hop: what it counts, and that it counts the same again."""

import re
import sys

from tests.lab.hop_trace import hop_trace, main

COUNTS = r"(\d+) files, (\d+) functions, (\d+) calls of soilbus\n"
LINES = re.compile(f"one hop enters {COUNTS}with its watch it enters {COUNTS}")


def test_the_same_hop_has_the_same_counts(capsys):
    main()
    found, here = LINES.fullmatch(capsys.readouterr().out), hop_trace()
    assert found is not None
    assert 0 < here.files < here.functions < here.calls
    assert tuple(map(int, found.groups())) == (*here, *hop_trace(watched=True))


def test_profiling_is_off_again_after_the_trace():
    hop_trace(warm_hops=0)
    assert sys.getprofile() is None
