"""`PYTHONPATH=service python -m tests.diagnosis.blind`: the cases of a seed, each driven once."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

from soilbus.simulator.drive import SimulationError

from .cases import DURATION, KINDS, cases


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, drive, print; 1 if a case cannot be driven to its end."""
    parser = argparse.ArgumentParser(prog="python -m tests.diagnosis.blind", description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="picks soils, sensors and drives (1)")
    parser.add_argument("--kind", choices=KINDS, action="append", help="repeatable; all by default")
    parser.add_argument("--list", action="store_true", help="name the cases without driving them")
    chosen = parser.parse_args(arguments)
    short, slowest, total, number = 0, 0.0, 0.0, 0
    for kind in chosen.kind or KINDS:
        for case in cases(kind, chosen.seed):
            number += 1
            if chosen.list:
                print(f"{case.half:7}{case.id}")
                continue
            begin = time.process_time()
            try:
                end = float(case.recording.truth["t"][-1])
                problem = "" if end > DURATION - 0.1 else f"  stuck after {end:.1f} s"
            except SimulationError as error:
                problem = f"  {error}"
            seconds = time.process_time() - begin
            short, slowest, total = short + bool(problem), max(slowest, seconds), total + seconds
            print(f"{case.half:7}{seconds:5.2f} s  {case.id}{problem}", flush=True)
    if not chosen.list:
        print(f"{number} cases, {total / number:.2f} s each, slowest {slowest:.2f} s, {short} not driven to the end")
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
