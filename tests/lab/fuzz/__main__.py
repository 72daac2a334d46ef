"""`python -m tests.lab.fuzz --target NAME --seconds N --seed S`: seeded mutations of good inputs.

A crash, or an input that takes longer than LONGEST, ends the run with a traceback and the input in a file named by its
digest.
"""

from __future__ import annotations

import argparse
import hashlib
import signal
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.lab.fuzz.mutation import mutated
from tests.lab.fuzz.targets import TARGETS

LONGEST = 30
"""Seconds for one input."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, fuzz, report."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.fuzz", description=__doc__)
    parser.add_argument("--target", required=True, choices=TARGETS)
    parser.add_argument("--seconds", type=int, default=60, help="of processor time (60)")
    parser.add_argument("--seed", type=int, default=1, help="of the random numbers (1)")
    chosen = parser.parse_args(arguments)
    target, rng = TARGETS[chosen.target], np.random.default_rng(chosen.seed)
    seeds = target.seeds()
    signal.signal(signal.SIGALRM, _too_long)
    begin, inputs, total = time.process_time(), 0, 0
    while time.process_time() - begin < chosen.seconds:
        data = mutated(seeds, rng)
        signal.alarm(LONGEST)
        try:
            total += target.one(data)
        except BaseException:
            Path(f"{chosen.target}-{hashlib.sha1(data).hexdigest()[:12]}").write_bytes(data)
            raise
        finally:
            signal.alarm(0)
        inputs += 1
    print(f"{chosen.target}: {inputs} inputs, {total} frames: nothing found")
    return 0


def _too_long(signum: int, frame: object) -> None:
    raise TimeoutError(f"longer than {LONGEST} s")


if __name__ == "__main__":
    raise SystemExit(main())
