"""Find where model and data disagree, name the missing effect, add it, show the gap shrink."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from soilbus.diagnosis.delays import with_delays
from soilbus.diagnosis.detectable import Detectable, detectable
from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.diagnosis.gap import Gap, gap_of
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.residual_terms import Correction, corrections
from soilbus.diagnosis.search import ASTRAY, THINNED, Addition, Fits, Standing, converged, named, reconsidered
from soilbus.diagnosis.verdict import Verdict, verdict_of
from soilbus.diagnosis.where import Disagreement, disagreements
from soilbus.estimation.posterior import Posterior, SoilPrior
from soilbus.terra.effects.effect import Effect
from soilbus.terra.effects.vehicle import GRADE, GRADE_BESIDE_PITCH

__all__ = ["Diagnosis", "NotFitted", "diagnose"]

MAX_EFFECTS = 3
OVERLAP = 0.25
"""Share by which the sum of what effects explain alone may differ from what they explain together: of 9 blind pairs
(seed 132) with nothing in common it was 0.96 to 1.08, of 5 that look alike 1.1 to 1.6."""


class NotFitted(Exception):
    """The present model cannot be fitted to the recordings at all."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What was found; base is the present model, completed the one with the effects added.

    additions are in the order of what they explain beside each other, the most first.
    learned describes what is left where the verdict is unknown.  The gaps are those of
    gap_of().  imitation: what each effect explains alone, where all may be an imitation (see shares_alone()).
    detectable tells of a verdict `none` what these recordings could have shown.
    """

    verdict: Verdict
    where: tuple[Disagreement, ...]
    additions: tuple[Addition, ...]
    base: FittedModel
    completed: FittedModel
    learned: tuple[Correction, ...]
    gap_before: Gap
    gap_after: Gap
    imitation: tuple[float, ...] = ()
    detectable: tuple[Detectable, ...] = ()

    def soil_before(self, record: int) -> Posterior:
        """The soil of a recording as the present model tells it."""
        return self.base.fits[record].posterior

    def soil_after(self, record: int) -> Posterior:
        """As the completed model tells it, with a share of each change of a logarithm as a further deviation.

        One for all parameters together: what the effects changed they may have changed too much or too little.
        """
        told, before = self.completed.fits[record].posterior, self.soil_before(record)
        share = max((addition.form_left for addition in self.additions), default=0.0)
        left = share * np.log(np.array(told.soil) / np.array(before.soil))
        return Posterior(told.soil, told.log_covariance + np.outer(left, left))


def diagnose(
    records: Sequence[Record],
    prior: SoilPrior,
    catalogue: Sequence[Effect],
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """The whole of it; NotFitted where already the present model cannot be fitted."""
    progress("fitting the present model")
    whole, few = Fits(records, prior), Fits([record.thinned(THINNED) for record in records], prior)
    base = whole.of(records[0].learned.effects)
    if base is None:
        raise NotFitted("the present model does not converge on these recordings")
    law = records[0].learned.model.shear_law
    candidates = [of_vehicle(effect, records) for effect in catalogue if effect.base_law in (None, law)]
    where = disagreements(base)
    present = base
    additions: list[Addition] = []
    while len(additions) < MAX_EFFECTS:
        progress(f"looking for effect {len(additions) + 1}")
        left = [effect for effect in candidates if effect.name not in present.names]
        found = named(
            whole, few, Standing.of(present, whole, few), left, base.neg2_log_evidence - present.neg2_log_evidence
        )
        if found is None:
            break
        addition, present = found
        additions.append(addition)
        if len(additions) > 1 and present.gap < ASTRAY:
            additions, present = reconsidered(whole, few, base, present, additions, candidates)
    present = converged(whole, base.neg2_log_evidence, present)
    if any(effect.late for effect in present.effects):
        progress("telling delays from low passes")
        present = with_delays(records, prior, present, base.neg2_log_evidence - present.neg2_log_evidence)
    additions.sort(key=lambda addition: -addition.falls[addition.effect.name])
    progress("holding out every block in turn")
    before = gap_of(records, prior, base)
    after = gap_of(records, prior, present) if additions else before
    imitation = shares_alone(whole, base, present, additions)
    chances = [addition.probability for addition in additions]
    verdict = verdict_of(before.value, after.value, min(before.rows, after.rows), chances, bool(imitation))
    learned = corrections(list(records), present) if verdict is Verdict.UNKNOWN else []
    shown: tuple[Detectable, ...] = ()
    if verdict is Verdict.NONE:
        progress("asking what these recordings could have shown")
        shown = detectable(records, prior, base, [effect for effect in candidates if effect.name not in base.names])
    return Diagnosis(
        verdict, tuple(where), tuple(additions), base, present, tuple(learned), before, after, imitation, shown
    )


def shares_alone(
    whole: Fits, base: FittedModel, present: FittedModel, additions: Sequence[Addition]
) -> tuple[float, ...]:
    """What each effect explains alone, as a share of what all explain together; empty where nothing is to be doubted.

    Faults that have nothing in common explain together the sum of what each explains alone.  Where as many effects as
    are ever added do not, the signature of one lies over that of another, which hides it or cancels part of it: as
    likely an imitation of something that the catalogue lacks as so many faults at once.
    """
    if len(additions) < MAX_EFFECTS:
        return ()
    alone = [whole.of((*base.effects, addition.effect)) for addition in additions]
    together = base.neg2_log_evidence - present.neg2_log_evidence
    shares = tuple(
        0.0 if one is None else max(base.neg2_log_evidence - one.neg2_log_evidence, 0.0) / together for one in alone
    )
    return () if abs(sum(shares) - 1.0) < OVERLAP else shares


def of_vehicle(effect: Effect, records: Sequence[Record]) -> Effect:
    """The effect as it can be on the vehicle of these recordings: beside a pitch sensor a slope is measured."""
    with_pitch = all(record.learned.with_pitch for record in records)
    return GRADE_BESIDE_PITCH if with_pitch and effect is GRADE else effect
