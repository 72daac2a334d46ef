"""`python -m tests.lab.soak [--hours 24] [--seed 1]`: a day through the daemon's loop."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

from tests.lab.soak.figures import Hour
from tests.lab.soak.run import HOUR, demands, soak


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print an hour a line, then the counts and what was asked of them; 1 where a demand is missed."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.soak", description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="simulated (24)")
    parser.add_argument("--seed", type=int, default=1, help="picks noise and faults (1)")
    chosen = parser.parse_args(arguments)
    begin = time.perf_counter()
    print("hour  windows  valid  error rms  error/sd rms  worst  resident memory")
    number = 0

    def show(hour: Hour) -> None:
        nonlocal number
        number += 1
        print(
            f"{number:4d}  {hour.windows:7d}  {hour.valid:5d}  {hour.error:9.2%}  {hour.rms_z:12.2f}"
            f"  {hour.worst_z:5.1f}  {hour.memory / 1e6:8.2f} MB", flush=True,
        )  # fmt: skip

    found = soak(chosen.hours * HOUR, chosen.seed, show)
    print(f"{found.received} frames received = {found.admitted} admitted + {dict(found.refused)} refused;")
    print(
        f"{found.unknown} of other identifiers; faults {dict(found.faults)}; {time.perf_counter() - begin:.0f} s in all"
    )
    results = demands(found)
    for asked, result, met in results:
        print(f"{'too short' if met is None else 'holds' if met else 'MISSED'}: {asked}: {result}")
    return int(not all(met is not False for _, _, met in results))


if __name__ == "__main__":
    raise SystemExit(main())
