"""The tracer of one hop: what it counts, and that it counts the same again."""

import re
import sys

from tests.lab.hop_trace import hop_trace, main


def test_the_same_hop_has_the_same_counts_and_profiling_is_off_again(capsys):
    main()
    found = re.fullmatch(
        r"one hop enters (\d+) files, (\d+) functions, (\d+) calls of soilbus\n", capsys.readouterr().out
    )
    here = hop_trace()
    assert 0 < here.files < here.functions < here.calls
    assert tuple(map(int, found.groups())) == here
    assert sys.getprofile() is None
