"""The diagnosis: where model and data disagree, which effects are missing, and how much of the gap they explain.

    gap  = reduced chi-square of blocks, each predicted from all others (`blocks`, `gap`)
    fall = score before - after an effect is added

The noise is that of the recording itself (`noise_floor`).  The present model is fitted and its held-out residuals are
tested place by place (`where`).  Effects are added one at a time, at most three, by stepwise search (`search`);
`verdict` turns scores and remaining gap into a verdict.
Where the verdict is unknown, `residual_terms` describes what remains; where it is none, `detectable` says what these
recordings could have shown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from soilbus.allocator import keep_freed_memory
from soilbus.diagnosis.detectable import Detectable, detectable
from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.diagnosis.gap import Gap, gap_of
from soilbus.diagnosis.noise_floor import with_noise_floor
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.residual_terms import ResidualTerms, residual_terms
from soilbus.diagnosis.search import Addition, FitCache, Search
from soilbus.diagnosis.verdict import Verdict, verdict_of
from soilbus.diagnosis.where import Disagreement, disagreements
from soilbus.estimation.posterior import Posterior, SoilPrior
from soilbus.terra.effects.effect import Effect, Late
from soilbus.terra.effects.vehicle import GRADE, GRADE_BESIDE_PITCH
from soilbus.words import WorkError

__all__ = ["Diagnosis", "NotFitted", "diagnose"]


class NotFitted(WorkError):
    """The present model cannot be fitted to the recordings at all."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What was found.

    Attributes
    ----------
    verdict
        None, named, ambiguous or unknown.
    where
        Places of significant disagreement under the present model, the clearest first.
    additions
        Effects added, in the order of what they explain beside each other, the most first.
    base, completed
        The present model, and the model with the effects added.
    residual_terms
        Description of what remains, where the verdict is unknown.
    gap_before, gap_after
        Gaps of these two models over all folds.
    imitation
        What each effect explains alone, as a share of what all explain, where all may be an imitation (see
        shares_alone()).
    detectable
        Where the verdict is none, what these recordings could have shown.
    rivals
        Where the verdict is ambiguous, the fitted models between which it is, the completed one first: they differ in
        the effect of the least probable name.
    """

    verdict: Verdict
    where: tuple[Disagreement, ...]
    additions: tuple[Addition, ...]
    base: FittedModel
    completed: FittedModel
    residual_terms: tuple[ResidualTerms, ...]
    gap_before: Gap
    gap_after: Gap
    imitation: tuple[float, ...] = ()
    detectable: tuple[Detectable, ...] = ()
    rivals: tuple[FittedModel, ...] = ()

    def soil_before(self, record: int) -> Posterior:
        """The soil of a recording under the present model."""
        return self.base.fits[record].posterior

    def soil_after(self, record: int) -> Posterior:
        """The soil of a recording under the completed model.

        A share of each change of a logarithm counts as a further standard deviation (`verdict.soil_error_share`), one
        for all parameters together: what the effects changed they may have changed too much or too little.
        """
        after, before = self.completed.fits[record].posterior, self.soil_before(record)
        share = max((addition.soil_error_share for addition in self.additions), default=0.0)
        soil, base = np.array(after.soil), np.array(before.soil)
        error = share * np.log(np.divide(soil, base, out=np.ones_like(base), where=base > 0.0))  # one held at 0 stays
        return Posterior(after.soil, after.log_covariance + np.outer(error, error))


def diagnose(
    records: Sequence[Record],
    prior: SoilPrior,
    catalogue: Sequence[Effect],
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """The whole diagnosis.

    Parameters
    ----------
    records
        Recordings of one vehicle, each divided into training and held-out blocks; the options of the first count.
    prior
        Of the soil, the same for each recording.
    catalogue
        Effects that may be missing.
    progress
        Called with each stage's name.

    Raises
    ------
    NotFitted
        Where already the present model cannot be fitted.
    """
    keep_freed_memory()
    progress("fitting the present model")
    options = records[0].options
    full = FitCache(records, prior, options)
    base = full.fit(records[0].training.effects)
    for _ in range(options.noise_rounds):
        if base is not None:
            full, base = weighed(full, base, base)
    if base is None:
        raise NotFitted("the present model does not converge on these recordings")
    records = full.records
    thinned = FitCache([record.thinned(options.thinning) for record in records], prior, options)
    law = records[0].training.model.shear_law
    of_law = [effect for effect in catalogue if effect.base_law in (None, law)]
    candidates = [effect for effect in (of_vehicle(effect, records) for effect in of_law) if effect.parameters]
    where, present = disagreements(records, base), base
    additions: list[Addition] = []
    progress("looking for effects")
    search = Search(full, thinned, base, candidates, options)
    for step in search.steps():
        additions, present = step
        progress(f"looking for effects beside {' and '.join(addition.effect.name for addition in additions)}")
    # such an end has no evidence, and predicts worse
    if not present.converged and not present.held_out_chi2 < base.held_out_chi2:
        additions, present = [], base
    if additions:  # the noise without what they explain
        progress("finding the noise floor")
        again = weighed(full, present, base)
        completed = again[0].fit(present.effects, [present.as_starts()])
        if again[1] is not None and completed is not None:
            full, base, present = again[0], again[1], completed
            records = full.records
    additions.sort(key=lambda addition: -addition.falls[addition.effect.name])
    before, after = gap_of(base), gap_of(present)
    imitation = shares_alone(full, base, present, additions)
    chances = [addition.probability for addition in additions]
    rows = min(before.rows, after.rows)
    names = [addition.effect.name for addition in additions]
    is_doubtful = bool(imitation) or not base.converged or any(f.effect in names for f in present.at_limits)
    verdict = verdict_of(before.value, after.value, rows, chances, is_doubtful, options)
    explains = after.value < before.value
    if verdict is Verdict.UNKNOWN and not explains:  # what explains nothing new is no name
        additions, present, after, imitation = [], base, before, ()
    remaining = residual_terms(records, present) if verdict is Verdict.UNKNOWN else []
    shown: tuple[Detectable, ...] = ()
    if verdict is Verdict.NONE:
        progress("finding what these recordings could have shown")
        shown = detectable(records, prior, base, [effect for effect in candidates if effect.name not in base.names])
    rivals: tuple[FittedModel, ...] = ()
    if verdict is Verdict.AMBIGUOUS:
        progress("fitting the rivals")
        rivals = rivals_of(full, present, additions, candidates)
    found = tuple(where), tuple(additions), base, present, tuple(remaining), before, after
    return Diagnosis(verdict, *found, imitation, shown, rivals)


def weighed(full: FitCache, noise_by: FittedModel, base: FittedModel) -> tuple[FitCache, FittedModel | None]:
    """Return the cache and the present model with the noise that `noise_by` shows, and weights of computed loads."""
    records = with_noise_floor(full.records, full.prior, noise_by)
    full = FitCache(records, full.prior, full.options)
    again = full.fit(base.effects, [base.as_starts()])
    if again is None or not any(record.training.computes_loads for record in records):
        return full, again
    records = [
        record.with_weights_at(fit.optimum.at, check.at)
        for record, fit, check in zip(records, again.fits, again.checks, strict=True)
    ]
    full = FitCache(records, full.prior, full.options)
    return full, full.fit(base.effects, [again.as_starts()])


def rivals_of(
    full: FitCache, present: FittedModel, additions: Sequence[Addition], candidates: Sequence[Effect]
) -> tuple[FittedModel, ...]:
    """The present model, and those with an alternative in the place of the effect of the least probable name."""
    by_name = {effect.name: effect for effect in candidates}
    contested = [addition for addition in additions if addition.alternatives]
    if not contested:
        return ()
    least = min(contested, key=lambda addition: addition.probability)
    others = [effect for effect in present.effects if effect.name != least.effect.name]
    likeliest = sorted(least.alternatives, key=lambda name: -least.alternatives[name])[:2]
    fits = [full.fit((*others, by_name[name])) for name in likeliest if name not in present.names]
    return (present, *(fit for fit in fits if fit is not None))


def shares_alone(
    full: FitCache, base: FittedModel, present: FittedModel, additions: Sequence[Addition]
) -> tuple[float, ...]:
    """What each effect explains alone, as a share of what all explain together; empty where nothing is to be doubted.

    Faults that have nothing in common explain together the sum of what each explains alone.  Where as
    many effects as are allowed do not, the signature of one lies over that of another, which hides it or cancels part
    of it: an imitation of something that the catalogue lacks is then as likely as that number of faults at once.
    """
    if len(additions) < full.options.max_effects:
        return ()
    alone = [full.fit((*base.effects, addition.effect)) for addition in additions]
    together = base.score - present.score
    shares = tuple(0.0 if one is None else max(base.score - one.score, 0.0) / together for one in alone)
    return () if abs(sum(shares) - 1.0) < full.options.max_overlap else shares


def of_vehicle(effect: Effect, records: Sequence[Record]) -> Effect:
    """The effect as it can be seen in these recordings.

    Beside a pitch sensor a slope is measured.  A channel that does not move shows no delay: one would only smooth its
    noise.  A low pass delays by its time constant: drives determine the sum of both, and hardly either.
    """
    if effect.late:
        late = {
            quantity: Late(names.delay)
            for quantity, names in effect.late.items()
            if any(record.training.moves(quantity) for record in records)
        }
        kept = {names.delay for names in late.values()}
        return replace(effect, late=late, parameters=tuple(p for p in effect.parameters if p.name in kept))
    with_pitch = all(record.training.with_pitch for record in records)
    return GRADE_BESIDE_PITCH if with_pitch and effect is GRADE else effect
