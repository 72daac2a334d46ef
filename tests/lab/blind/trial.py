"""A blind trial: one case diagnosed, and the figures that are scored."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from soilbus.diagnosis.diagnose import NotFitted, diagnose
from soilbus.diagnosis.records import Record
from soilbus.estimation.assembly import possible_effects, prior_of
from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.offline.manoeuvre import record_of_recording
from soilbus.simulator.drive import SimulationError
from soilbus.terra.effects.effect import Effect
from tests.lab.blind.cases import Case, cases
from tests.lab.blind.visible import Shown, shown


@dataclass(frozen=True)
class Trial:
    """A case's truth beside the diagnosis.

    named: names added, the one that explains most first; sets: for each of them all names
    with probabilities.  visible: what the recording shows of the effect, of two effects of
    the less visible one beside the other, and true_gap what it leaves unexplained, by the generator
    alone (visible.py).  A diagnosis that fails has the verdict FAILED and no names.
    bearing_*: relative errors of the bearing pressure; bearing_sd the relative deviation reported in the end.
    """

    id: str
    kind: str
    half: str
    hidden: tuple[str, ...]
    size: str
    imitable: bool
    verdict: str
    named: tuple[str, ...]
    sets: tuple[dict[str, float], ...]
    falls: tuple[dict[str, float], ...]
    far: bool
    visible: float
    true_gap: float
    gap_before: float
    gap_after: float
    rows: int
    bearing_before: float
    bearing_after: float
    bearing_sd: float
    seconds: float


def record_of_case(case: Case) -> Record:
    """What the diagnosis is given."""
    return record_of_recording(case.id, case.recording, case.config)


def trial_of(key: tuple[str, str, str]) -> Trial | None:
    """The trial of the case of this kind, id and machine, None where it cannot be driven.

    Forms are functions and do not travel between processes; nor does what stands in a `__main__`.
    """
    kind, name, machine = key
    seed = int(name.rpartition("/")[2].partition(".")[0])
    case = next(case for case in cases(kind, seed, machine) if case.id == name)
    try:
        return tried(case)
    except SimulationError:
        return None


def tried(case: Case, candidates: Sequence[Effect] | None = None, truth: Shown | None = None) -> Trial:
    """The case diagnosed; SimulationError if it cannot be driven.

    candidates: by default all that the machine can have.
    truth: what the recording shows of the effect; None: worked out, which takes longer than the diagnosis.
    """
    record, prior = record_of_case(case), prior_of(case.config)
    candidates = possible_effects(case.config) if candidates is None else candidates
    truth = shown(case) if truth is None else truth
    begin = time.process_time()
    reported: dict[str, Any] = FAILED
    try:
        found = diagnose([record], prior, list(candidates))
    except (NotFitted, np.linalg.LinAlgError):
        pass
    else:
        before, after = (_bearing(case, soil) for soil in (found.soil_before(0), found.soil_after(0)))
        reported = {
            "verdict": str(found.verdict),
            "named": tuple(a.effect.name for a in found.additions),
            "sets": tuple({a.effect.name: a.probability} | a.alternatives for a in found.additions),
            "falls": tuple(a.falls for a in found.additions),
            "gap_before": found.gap_before.value,
            "gap_after": found.gap_after.value,
            "rows": found.gap_after.rows,
            "bearing_before": _bearing_error(case, before),
            "bearing_after": _bearing_error(case, after),
            "bearing_sd": after.std / after.value,
        }
    return Trial(
        id=case.id,
        kind=case.kind,
        half=case.half,
        hidden=case.hidden,
        size=case.size,
        imitable=case.imitable,
        far=case.far,
        visible=truth.energy,
        true_gap=truth.gap,
        seconds=time.process_time() - begin,
        **reported,
    )


FAILED = {
    "verdict": "failed", "named": (), "sets": (), "falls": (), "gap_before": np.inf, "gap_after": np.inf, "rows": 1,
    "bearing_before": np.inf, "bearing_after": np.inf, "bearing_sd": np.inf,
}  # fmt: skip
"""Fields of a Trial whose diagnosis failed."""


def _bearing(case: Case, soil: Posterior) -> Estimate:
    settings = case.config.estimator
    return soil.bearing_pressure(settings.z_ref, settings.b_ref)


def _bearing_error(case: Case, reported: Estimate) -> float:
    settings = case.config.estimator
    return float(np.log(reported.value / case.soil.bearing_pressure(settings.z_ref, settings.b_ref)))
