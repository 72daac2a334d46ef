"""`python -m tests.lab.settled`: ambiguous blind cases, diagnosed again after what `diagnose` says to drive.

    right      a single name with probability above that of `named`, and the hidden effect
    wrong      the same, another effect
    open       still ambiguous, or unknown

For comparison, the same cases after a drive of the same length that repeats the first one.  Both are driven by the
blind generator, with the hidden effect in its own formula (`tests.lab.blind`), on the same field by the same
vehicle, with noise of their own.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from soilbus.diagnosis.diagnose import Diagnosis, NotFitted, diagnose
from soilbus.diagnosis.verdict import Verdict
from soilbus.estimation.assembly import prior_of
from soilbus.offline.manoeuvre import Plan, record_of_recording, what_to_drive
from soilbus.report.table import table
from soilbus.simulator.drive import SimulationError
from soilbus.simulator.recording import simulate
from soilbus.simulator.scenario import Patch, Scenario
from soilbus.terra.effects.catalogue import CATALOGUE
from tests.lab.blind.cases import Case, cases

KINDS = ("right", "wrong", "open")
MAX_DRIVES = 4
"""Repetitions of the manoeuvre at most, where the plan asks for more: three minutes."""


def driven(case: Case, scenario: Scenario, seed: int) -> Diagnosis:
    """The case's recording and a further drive of its tractor, with its gain errors, diagnosed together."""
    how, scenario = case.how, replace(scenario, vehicle_seed=case.seed)
    further = how.after(simulate(how.tractor(case.config), how.way(scenario), seed, how.effects))
    recordings = {"before": case.recording, "next": further}
    records = [record_of_recording(name, recording, case.config) for name, recording in recordings.items()]
    return diagnose(records, prior_of(case.config), list(CATALOGUE.values()))


def outcome(case: Case, found: Diagnosis) -> str:
    """One of KINDS."""
    if found.verdict is not Verdict.NAMED:
        return "open"
    return "right" if found.additions[0].effect.name in case.hidden else "wrong"


def settled(case: Case) -> tuple[Plan, str, str] | None:
    """The plan, and the outcomes after it and after more of the same; None where the case is not ambiguous at first."""
    first = diagnose(
        [record_of_recording(case.id, case.recording, case.config)], prior_of(case.config), [*CATALOGUE.values()]
    )
    plan = what_to_drive(first, case.config)
    if plan is None:
        return None
    table = plan.manoeuvre.repeated(min(plan.repeats or 1, MAX_DRIVES))
    manoeuvre = table.over(Scenario(table.duration, (Patch(0.0, case.soil_name, case.soil),)))
    same = replace(case.scenario, duration=table.duration)
    planned, control = (outcome(case, driven(case, drive, case.seed + 1)) for drive in (manoeuvre, same))
    return plan, planned, control


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line a case and the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.settled", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seed", type=int, default=1, help="of the blind cases (1)")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take each N-th case only (1)")
    parser.add_argument("--only", default="", help="only cases with this in their id")
    chosen = parser.parse_args(arguments)
    found: list[tuple[Plan, str, str]] = []
    for case in [case for case in cases("single", chosen.seed) if chosen.only in case.id][:: chosen.every]:
        try:
            one = settled(case)
        except (SimulationError, NotFitted, np.linalg.LinAlgError) as error:
            print(f"{case.id}: {error}", flush=True)
            continue
        if one is not None:
            plan, planned, control = one
            found.append(one)
            print(
                f"{case.id}: {planned} (more of the same: {control}); expected {plan.expected_probability:.2f}, "
                f"{plan.repeats} times, {plan.manoeuvre.duration:.0f} s: {plan.manoeuvre.words}",
                flush=True,
            )
    groups = {
        f"expected to settle in {MAX_DRIVES} drives": [
            one for one in found if (one[0].repeats or np.inf) <= MAX_DRIVES
        ],
        "not expected to": [one for one in found if (one[0].repeats or np.inf) > MAX_DRIVES],
    }
    rows = []
    for group, ones in groups.items():
        for name, picked in (("as planned", 1), ("more of the same", 2)):
            counts = Counter(one[picked] for one in ones)
            shares = (f"{counts[kind]} ({100.0 * counts[kind] / max(len(ones), 1):.0f} %)" for kind in KINDS)
            rows.append((group, name, *shares))
    print(table(("cases", "then", *KINDS), rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
