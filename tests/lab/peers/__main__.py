"""`python -m tests.lab.peers`: ours beside the methods of other papers, on the same windows."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from tests.lab.peers.compare import compared, comparison, ours_is_ahead, verdict
from tests.lab.peers.roster import NEEDS, roster
from tests.lab.peers.windows import ASSUMED_SD

SOILS = ("loam", "wet_clay", "dry_sand")
LEAST = 2
"""Windows of each soil: a sign test needs six windows that all say the same."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, run, print; 1 where ours failed on a window or is not closer more often than peers given the same."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.peers", description=__doc__)
    parser.add_argument("--windows", type=int, default=20, help="windows of each soil (20)")
    parser.add_argument("--seed", type=int, default=1, help="picks the drives and their noise (1)")
    chosen = parser.parse_args(arguments)
    if chosen.windows < LEAST or not 0 <= chosen.seed < 100:
        parser.error(f"at least {LEAST} windows, and a seed from 0 to 99")
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if sys.stderr.isatty():
            print(f"\r{done} of {chosen.windows * len(SOILS)} windows", end="", file=sys.stderr)

    scores = compared(roster(), SOILS, chosen.windows, chosen.seed, step)
    print(f"{chosen.windows} windows of 10 s on each of {', '.join(SOILS)}, seed {chosen.seed}.")
    print(f"To {100 * ASSUMED_SD:.0f} %: off by that, one standard deviation.")
    print("Errors relative, in %: RMS / median of the size [truths inside the 95 % interval], failures left out.")
    print("Behind it who is closer to the truth, the peer or ours that is given the same exactly: alike where the RMS")
    print("errors are, open where a sign test of the windows does not confirm them. A failed window is the other's.")
    print("bearing: pressure at 2 cm under a plate 0.3 m wide.\n")
    print(NEEDS)
    print(comparison(scores))
    print(verdict(scores), end="")
    return int(not ours_is_ahead(scores))


if __name__ == "__main__":
    raise SystemExit(main())
