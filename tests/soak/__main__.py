"""`PYTHONPATH=service:tests/support python -m tests.soak [--hours 24] [--seed 1]`: a day through the daemon's loop."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

from .books import Hour
from .run import HOUR, soak

ALLOWED_GROWTH = 1e6
"""Of resident memory [bytes] after the first hour."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print an hour a line, then the books; 1 where something does not add up."""
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
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
            f"  {hour.worst_z:5.1f}  {hour.memory / 1e6:8.1f} MB", flush=True,
        )  # fmt: skip

    told = soak(chosen.hours * HOUR, chosen.seed, show)
    growth = max(h.memory for h in told.hours) - told.hours[0].memory
    print(f"{told.received} frames received = {told.admitted} admitted + {dict(told.refused)} refused;")
    print(f"{told.unknown} of other identifiers; lost {told.lost or 'none'}; faults {dict(told.faults)}")
    print(f"{told.deadline_misses} deadlines missed; {told.sent} Traversability frames, {told.off_beat} off their beat")
    print(f"memory {growth / 1e6:+.1f} MB after the first hour; {time.perf_counter() - begin:.0f} s in all")
    return int(bool(told.lost) or told.deadline_misses > 0 or told.off_beat > 0 or growth > ALLOWED_GROWTH)


if __name__ == "__main__":
    sys.exit(main())
