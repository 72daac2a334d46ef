"""Find where model and data disagree, name the missing effect, add it, show the gap shrink."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from soilbus.diagnosis.candidates import THINNED, Standing
from soilbus.diagnosis.completion import Completion
from soilbus.diagnosis.fits import Fits
from soilbus.diagnosis.gap import Gap, gap_of
from soilbus.diagnosis.late_posterior import with_lateness
from soilbus.diagnosis.learned import Correction, corrections
from soilbus.diagnosis.naming import ASTRAY, Addition, converged, named
from soilbus.diagnosis.reconsidered import reconsidered
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.verdict import SURE, Verdict, is_real
from soilbus.diagnosis.where import Disagreement, disagreements
from soilbus.estimation.posterior import Posterior, SoilPrior
from soilbus.terra.effects.effect import Effect

MAX_EFFECTS = 3


class NotFitted(Exception):
    """The present model cannot be fitted to the recordings at all."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What was found; base is the present model, completed the one with the effects added.

    additions are in the order of what they explain beside each other, the most first.
    learned describes what is left where the verdict is unknown.  The gaps are those of
    gap_of().
    """

    verdict: Verdict
    where: tuple[Disagreement, ...]
    additions: tuple[Addition, ...]
    base: Completion
    completed: Completion
    learned: tuple[Correction, ...]
    gap_before: Gap
    gap_after: Gap

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
    candidates = [effect for effect in catalogue if effect.base_law in (None, law)]
    where = disagreements(base)
    present = base
    additions: list[Addition] = []
    while len(additions) < MAX_EFFECTS:
        progress(f"looking for effect {len(additions) + 1}")
        left = [effect for effect in candidates if effect.name not in present.names]
        found = named(whole, few, Standing.of(present, whole, few), left, base.evidence - present.evidence)
        if found is None:
            break
        addition, present = found
        additions.append(addition)
        if len(additions) > 1 and present.gap < ASTRAY:
            additions, present = reconsidered(whole, few, base, present, additions, candidates)
    present = converged(whole, base.evidence, present)
    if any(effect.late for effect in present.effects):
        progress("telling delays from low passes")
        present = with_lateness(records, prior, present, base.evidence - present.evidence)
    additions.sort(key=lambda addition: -addition.falls[addition.effect.name])
    progress("holding out every block in turn")
    before = gap_of(records, prior, base)
    after = gap_of(records, prior, present) if additions else before
    verdict = _verdict(before, after, additions)
    learned = corrections(list(records), present) if verdict is Verdict.UNKNOWN else []
    return Diagnosis(verdict, tuple(where), tuple(additions), base, present, tuple(learned), before, after)


def _verdict(before: Gap, after: Gap, additions: Sequence[Addition]) -> Verdict:
    if is_real(before.value, after.value, min(before.rows, after.rows)):
        return Verdict.UNKNOWN
    if not additions:
        return Verdict.NONE
    return Verdict.NAMED if all(a.probability >= SURE for a in additions) else Verdict.AMBIGUOUS
