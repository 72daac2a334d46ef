"""`python -m tests.lab.stories --stories 3000 --seed 1`: random stories, judged.

Of each story the seed is counted on from --seed.  Each is played to a service whose tracker is given the truth, the
first --real of them also to one that must estimate it.  Exit code 1 if go was said where the truth forbids
it, or not said again where it was due.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence

from soilbus.simulator.reference import REFERENCES, TRACTOR
from tests.lab.stories.drives import cheap, real
from tests.lab.stories.story import TO_ALL, TO_SOME, drawn, played

HEALED = 10
"""Every tenth story goes on until go is due again."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, play, judge."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.stories", description=__doc__)
    parser.add_argument("--stories", type=int, default=3000, help="how many (3000)")
    parser.add_argument("--real", type=int, default=30, help="how many with a real estimator (30)")
    parser.add_argument("--seed", type=int, default=1, help="of the first one (1)")
    parser.add_argument("--machine", choices=REFERENCES, default=TRACTOR.stem, help=f"what drives ({TRACTOR.stem})")
    chosen = parser.parse_args(arguments)
    logging.disable(logging.CRITICAL)
    seeds = range(chosen.seed, chosen.seed + max(chosen.stories, chosen.real))
    bad = go = go_of_real = 0
    for seed in seeds[: chosen.stories]:
        drive = cheap(chosen.machine)
        story = drawn(seed, drive.needed)
        played(drive, story, healed=seed % HEALED == 0)
        go += drive.go
        bad += _wrong(f"story {seed}", story, drive.faults)
    for seed in seeds[: chosen.real]:
        drive = real(seed, chosen.machine)
        story = drawn(seed, drive.needed, (*TO_SOME, *TO_ALL))
        played(drive, story)
        go_of_real += drive.go
        bad += _wrong(f"real story {seed}", story, drive.faults)
    print(f"{chosen.stories} stories, {go} times go; {chosen.real} with a real estimator, {go_of_real}; {bad} wrong")
    return int(bad > 0 or not go or (chosen.real >= 10 and not go_of_real))


def _wrong(name: str, story: object, faults: Sequence[str]) -> bool:
    if faults:
        print(f"{name}: {story}\n    " + "\n    ".join(faults[:3]))
    return bool(faults)


if __name__ == "__main__":
    raise SystemExit(main())
