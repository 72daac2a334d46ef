"""`PYTHONPATH=service python -m tests.golden`: compares what soilbus says of fixed recordings with what it said."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from .compare import EXACT, Move, Tolerances, moves, summary
from .drives import drive_again
from .outputs import HERE, Source, diagnoses, replays


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare, print what moved, and keep the new outputs if asked; 1 where something moved and is not kept."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__)
    parser.add_argument("--renew", action="store_true", help="keep what is said now, and print what moved")
    parser.add_argument("--exact", action="store_true", help="no tolerances: nothing may move in its six digits")
    parser.add_argument("--only", default="", help="only outputs with this in their name")
    parser.add_argument("--first", type=int, default=30, help="rows of the largest moves (30)")
    parser.add_argument("--drive-again", action="store_true", help="first simulate the recordings anew")
    chosen = parser.parse_args(arguments)
    if chosen.drive_again:
        drive_again(HERE / "recordings")
    limits = EXACT if chosen.exact else Tolerances()
    found: list[Move] = []
    for source in (*replays(), *diagnoses()):
        if chosen.only in source.name:
            found += _compared(source, limits, chosen.renew)
    print(summary(found, chosen.first))
    return int(not chosen.renew and any(move.fails for move in found))


def _compared(source: Source, limits: Tolerances, renew: bool) -> Iterator[Move]:
    """What moved in one output."""
    if source.missing is not None:
        print(f"{source.name}: left out: no {source.missing}", flush=True)
        return
    with TemporaryDirectory() as folder:
        now = source.now(Path(folder))
    found = moves(source.name, source.golden(), now, limits)
    failed = sum(move.fails for move in found)
    print(f"{source.name}: {failed} values moved" if failed else f"{source.name}: as it was", flush=True)
    if renew and found:
        source.keep(now)
    yield from found


if __name__ == "__main__":
    sys.exit(main())
