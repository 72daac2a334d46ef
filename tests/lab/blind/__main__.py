"""`python -m tests.lab.blind`: hidden effects diagnosed, and the score."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from typing import TextIO

from soilbus.allocator import keep_freed_memory
from soilbus.simulator.reference import REFERENCES, TRACTOR
from soilbus.workers import workers
from tests.lab.blind.calibration import curve, draw, stated
from tests.lab.blind.cases import KINDS, Case, cases
from tests.lab.blind.table import HALVES, report, targets_are_met
from tests.lab.blind.trial import Trial, trial_of


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, diagnose, print; 1 where the half that nothing is tuned on misses a target (table.targets_are_met)."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.blind", description=__doc__)
    parser.add_argument("--seed", type=int, action="append", help="picks soils, sensors and drives (1); repeatable")
    parser.add_argument("--kind", choices=KINDS, action="append", help="repeatable; all by default")
    parser.add_argument("--machine", choices=REFERENCES, default=TRACTOR.stem, help=f"what drives ({TRACTOR.stem})")
    parser.add_argument("--half", choices=HALVES, help="all by default")
    parser.add_argument("--only", default="", help="only cases with this in their id")
    parser.add_argument("--every", type=int, metavar="N", default=1, help="take each N-th case only (1)")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--list", action="store_true", help="name the cases without driving them")
    parser.add_argument("--json", help="write one object a line for each case")
    parser.add_argument("--svg", help="draw the calibration curve")
    chosen = parser.parse_args(arguments)
    wanted = [
        case
        for seed in chosen.seed or [1]
        for kind in chosen.kind or KINDS
        for case in cases(kind, seed, chosen.machine)
        if chosen.half in (None, case.half) and chosen.only in case.id
    ][:: max(chosen.every, 1)]
    if chosen.list:
        print("\n".join(f"{case.half:7}{case.id}" for case in wanted))
        return 0
    with open(chosen.json, "w") if chosen.json else nullcontext() as out:
        trials = list(_reported(trials_of(wanted, chosen.processes), out))
    print(report(trials))
    if chosen.svg:
        draw(curve(stated(trials)), chosen.svg)
    return int(not targets_are_met(trials))


def _reported(found: Iterable[tuple[Case, Trial | None]], out: TextIO | None) -> Iterator[Trial]:
    """The trials of cases that can be driven, each printed in a line, and written to `out` as JSON."""
    for case, trial in found:
        if trial is None:
            print(f"{case.id}: cannot be driven", flush=True)
            continue
        names = " + ".join(" or ".join(f"{n} {p:.2f}" for n, p in one.items()) for one in trial.sets)
        print(
            f"{trial.half:7}{trial.id} [{trial.visible:.0f}]: {trial.verdict} {names}"
            f" gap {trial.gap_before:.3f} -> {trial.gap_after:.3f} {trial.seconds:.1f} s",
            flush=True,
        )
        if out is not None:
            print(json.dumps(asdict(trial)), file=out, flush=True)
        yield trial


def trials_of(wanted: Sequence[Case], count: int) -> Iterator[tuple[Case, Trial | None]]:
    """Each case with its trial, None where it cannot be driven, in `count` processes."""
    if count < 2:
        for case in wanted:
            yield case, trial_of((case.kind, case.id, case.machine))
        return
    with workers(count, "spawn", keep_freed_memory) as pool:
        yield from zip(wanted, pool.map(trial_of, [(case.kind, case.id, case.machine) for case in wanted]), strict=True)


if __name__ == "__main__":
    keep_freed_memory()
    raise SystemExit(main())
