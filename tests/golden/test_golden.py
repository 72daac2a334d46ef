"""What soilbus says of the golden recordings is what it said; `python -m tests.golden --renew` keeps what is new."""

from __future__ import annotations

from pathlib import Path

import pytest

from availability import unavailable

from .compare import Tolerances, moves, summary
from .outputs import CHEAP, Source, diagnoses, replays

SOURCES = (*replays(), *diagnoses(CHEAP))


@pytest.mark.parametrize("source", SOURCES, ids=[source.name for source in SOURCES])
def test_an_output_is_what_it_was(source: Source, tmp_path: Path) -> None:
    if source.missing is not None:
        unavailable(f"no {source.missing}")
    found = moves(source.name, source.golden(), source.now(tmp_path), Tolerances())
    assert not any(move.fails for move in found), f"\n{summary(found)}\nif it is meant: python -m tests.golden --renew"
