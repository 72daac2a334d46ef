"""`python -m tests.lab.peers`: ours beside the methods of other papers, on the same windows."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from tests.lab.peers.compare import compared, comparison, duels, ours_is_ahead
from tests.lab.peers.roster import NEEDS, roster
from tests.lab.peers.windows import ASSUMED_SD

SOILS = ("loam", "wet_clay", "dry_sand")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, run, print; 1 where ours failed on a window or is not closer more often than not."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.peers", description=__doc__)
    parser.add_argument("--windows", type=int, default=20, help="windows of each soil (20)")
    parser.add_argument("--seed", type=int, default=1, help="picks the drives and their noise (1)")
    chosen = parser.parse_args(arguments)
    if chosen.windows < 1 or not 0 <= chosen.seed < 100:
        parser.error("at least one window, and a seed from 0 to 99")
    scores = compared(roster(), SOILS, chosen.windows, chosen.seed)
    print(f"{chosen.windows} windows of 10 s on each of {', '.join(SOILS)}, seed {chosen.seed}.")
    print(f"To {100 * ASSUMED_SD:.0f} %: off by that, one standard deviation.")
    print("RMS errors relative, in % [truths inside the 95 % interval]; a failure is off by everything.")
    print("bearing: pressure at 2 cm under a plate 0.3 m wide.\n")
    print(NEEDS)
    print(comparison(scores))
    closer = [ours for _, _, ours in duels(scores)]
    print(f"Ours that is given the same exactly has the smaller error in {sum(closer)} of {len(closer)} comparisons.")
    return int(not ours_is_ahead(scores))


if __name__ == "__main__":
    raise SystemExit(main())
