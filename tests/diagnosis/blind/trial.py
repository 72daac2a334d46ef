"""One blind case through the diagnosis, and what there is to score of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from soilbus.assembly import model_of, prior_of, rig_of
from soilbus.diagnosis.completion import Completion, complete
from soilbus.diagnosis.diagnose import Diagnosis, diagnose
from soilbus.diagnosis.records import Record, record_of
from soilbus.diagnosis.score import further_scores, scores
from soilbus.estimation.posterior import Estimate, Posterior, SoilPrior
from soilbus.estimation.window import BinStore
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Effect

from .cases import Case


@dataclass(frozen=True)
class Trial:
    """A case's truth beside the diagnosis.

    named: names added, the one that explains most first; sets: for each of them all names
    with probabilities.  visible: by how much the true effect lowers the penalised cost, of
    two effects the less visible one beside the other (nan for what the catalogue lacks).
    bearing_*: relative errors of the bearing pressure; bearing_sd the told relative deviation in the end.
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
    visible: float
    gap_before: float
    gap_after: float
    rows: int
    bearing_before: float
    bearing_after: float
    bearing_sd: float
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """Plain objects."""
        return asdict(self)


def record_of_case(case: Case) -> Record:
    """What the diagnosis is given."""
    config, recording = case.config, case.recording
    rig, settings = rig_of(config), case.config.estimator
    store = BinStore(rig, settings.bin, 0.0)
    columns = {n: (c.t, c.value) for n, c in recording.channels.items() if n in rig.channels}
    store.add(columns)
    end = max(float(t[-1]) for t, _ in columns.values())
    return record_of(case.id, store.window(0.0, end), rig, model_of(config), settings.min_speed, settings.max_turn)


def tried(case: Case) -> Trial:
    """The case diagnosed; SimulationError if it cannot be driven."""
    record, prior = record_of_case(case), prior_of(case.config)
    begin = time.process_time()
    found = diagnose([record], prior, list(CATALOGUE.values()))
    seconds = time.process_time() - begin
    before, after = (_bearing(case, soil) for soil in (found.soil_before(0), found.soil_after(0)))
    return Trial(
        id=case.id,
        kind=case.kind,
        half=case.half,
        hidden=case.hidden,
        size=case.size,
        imitable=case.imitable,
        verdict=str(found.verdict),
        named=tuple(a.effect.name for a in found.additions),
        sets=tuple({a.effect.name: a.probability} | a.alternatives for a in found.additions),
        falls=tuple(a.falls for a in found.additions),
        visible=_visible(case, record, found),
        gap_before=found.gap_before.value,
        gap_after=found.gap_after.value,
        rows=found.gap_after.rows,
        bearing_before=_bearing_error(case, before),
        bearing_after=_bearing_error(case, after),
        bearing_sd=after.std / after.value,
        seconds=seconds,
    )


def _visible(case: Case, record: Record, found: Diagnosis) -> float:
    """Fall of -2 log posterior, learned and held-out blocks, when the true effect is added to the present model.

    Of two effects the smaller fall: that of each one beside the other.
    """
    if not case.hidden:
        return float("nan")
    prior = prior_of(case.config)
    without = {name: _with([*case.hidden], name, record, prior, found) for name in case.hidden}
    whole = min((_added(CATALOGUE[name], record, prior, without[name]) for name in case.hidden), key=_cost)
    if set(found.completed.names) == set(case.hidden):
        whole = min(whole, found.completed, key=_cost)
    return min(map(_cost, without.values())) - _cost(whole)


def _with(hidden: Sequence[str], left_out: str, record: Record, prior: SoilPrior, found: Diagnosis) -> Completion:
    """The present model with all the true effects but one."""
    present = found.base
    for name in hidden:
        if name != left_out:
            present = _added(CATALOGUE[name], record, prior, present)
    return present


def _added(effect: Effect, record: Record, prior: SoilPrior, present: Completion) -> Completion:
    """The model with one effect more, from every start; itself where that fits worse."""
    scored = [*scores([record], prior, present, [effect]), *further_scores([record], prior, present, [effect])]
    tries = [complete([record], prior, (*present.effects, effect), score.starts) for score in scored]
    return min((more for more in (present, *tries) if more is not None), key=_cost)


def _cost(completion: Completion) -> float:
    return completion.cost + sum(check.at.chi2 for check in completion.checks)


def _bearing(case: Case, soil: Posterior) -> Estimate:
    settings = case.config.estimator
    return soil.bearing_pressure(settings.z_ref, settings.b_ref)


def _bearing_error(case: Case, told: Estimate) -> float:
    settings = case.config.estimator
    return float(np.log(told.value / case.soil.bearing_pressure(settings.z_ref, settings.b_ref)))
