"""`python -m tests.lab.peers`: ours beside the methods of other papers, on the same windows."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

from tests.lab.peers.compare import compared, ours_is_ahead, tables, verdict
from tests.lab.peers.learned import trained
from tests.lab.peers.roster import NEEDS, roster
from tests.lab.peers.windows import ASSUMED_SD

SOILS = ("loam", "wet_clay", "dry_sand")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, train, run, print; 1 where ours failed on a window or peers given the same are better more often."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.peers", description=__doc__)
    parser.add_argument("--windows", type=int, default=20, help="windows of each soil (20)")
    parser.add_argument("--seed", type=int, default=1, help="picks the drives and their noise (1)")
    parser.add_argument("--train", type=int, default=400, help="training windows of the learned regressor (400)")
    chosen = parser.parse_args(arguments)
    if chosen.windows < 1 or not 0 <= chosen.seed < 100 or chosen.train < 20:
        parser.error("at least 1 window and 20 training windows, and a seed from 0 to 99")
    begin = time.perf_counter()
    try:
        regressor = trained(chosen.train)
    except ModuleNotFoundError as reason:
        print(reason, file=sys.stderr)
        return 1
    training = time.perf_counter() - begin
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if sys.stderr.isatty():
            print(f"\r{done} of {chosen.windows * len(SOILS)} windows", end="", file=sys.stderr)

    scores = compared(roster(regressor), SOILS, chosen.windows, chosen.seed, step)
    print(f"{chosen.windows} windows of 10 s on each soil, seed {chosen.seed}. Kernel ridge: {chosen.train} training")
    print(
        f"windows, {training:.1f} s to make and fit. To {100 * ASSUMED_SD:.0f} %: off by that, one standard deviation."
    )
    print("Errors relative, in %: RMS / median of the size [truths inside the 95 % interval], failures left out.")
    print("bearing: pressure at 2 cm under a plate 0.3 m wide.\n")
    print(NEEDS)
    print("\n".join(tables(scores)))
    print(verdict(scores), end="")
    return int(not ours_is_ahead(scores))
