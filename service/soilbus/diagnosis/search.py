"""Stepwise search for missing effects by evidence.

    fall(e) = -2 log p(data | present model) + 2 log p(data | present model with effect e)
    add the most probable e while its fall >= required fall

One step narrows the candidates in three stages: a score test predicts the fall of each from one linearisation; the
best by score are fitted to each THINNING-th instant (trial fits), which predicts their fall on all instants; those
that are not dominated there are fitted to all instants and compared by evidence.  An effect that was added early may
stand for two that are missing.  So after each further addition every effect is compared once more with all candidates
in its place, and swapped where another explains more (stepwise selection with exchange).  FitCache keeps every fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from soilbus.diagnosis.delays import exceeds_sampling_delay
from soilbus.diagnosis.evidence import OwnParameters
from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.score import Score, further_scores, scores
from soilbus.diagnosis.verdict import (
    FALL_REQUIRED_ALONE,
    SET_PROBABILITY,
    SOIL_ERROR_SHARE,
    TEMPERATURE,
    dominated_deficit,
    gap_limit,
    is_dominated,
    least_required_fall,
    mean_soil_error_share,
    probabilities,
    required_fall,
    soil_error_share,
    temperatures,
)
from soilbus.estimation.multistart import COMPARED, Start
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.solver import SolverOptions
from soilbus.terra.effects.effect import Effect

# A value whose docstring states no source has no evidence recorded.
SCORE_THRESHOLD = -2.0
"""Predicted change of -2 log evidence above which a candidate is dropped."""
MAX_TRIALS_BY_SCORE, MAX_TRIALS_BY_FURTHER_SCORE = 4, 4
"""Candidates of a step that get a trial fit: the best by their scores, and by their scores at further starts.

Of 77 steps of seeds 112 and 113, and of 95 of seed 127, the effect that was named was among them.
"""
MAX_CANDIDATES, MAX_FULL_FITS = 6, 3
"""Candidates of a step that are compared, if only by prediction, and those that are fitted to all instants."""
THINNING = 4
"""A trial fit has one instant in this many."""
CLEAR_FALL = 100.0
"""Predicted fall of -2 log evidence from which trial fits, rather than scores, choose the candidates for full fits."""
DOMINATED_BY_EVIDENCE = 150.0
"""Predicted deficit of -2 log evidence, behind the best trial, from which a candidate gets no full fit.

Three deviations: of a difference d on each THINNING-th instant the deviation is 2 sqrt(d), and 2 sqrt(THINNING x)
of a predicted difference x.
"""
DOMINATED_BY_POSTERIOR = 250.0
"""-2 log posterior above the least of the trials from which a trial fit is given up, converged or not."""
FULL_FIT_SHARE = 0.2
"""Share of the required fall, and of the best predicted fall, from which a candidate gets a full fit where the
predicted falls are small: below it the score is as good."""

TRIAL_OPTIONS = replace(COMPARED, step_tolerance=0.1)
"""Descent of trial fits: looser, as they only choose the candidates for full fits."""
GIVE_UP_SHARE = 0.3
"""Share of the required fall that the training blocks must show, for a full fit after one that fell short of it."""
NEGLIGIBLE_FALL = 1.0
"""Fall of -2 log posterior up to which an effect explains nothing."""
EQUAL_EVIDENCE = 1.0
"""Difference of -2 log evidence up to which two models are equally good."""
MAX_REFINED_GAP = 3.0
"""Reduced chi-square of a model that misses so much that further descent steps decide nothing."""


@dataclass(frozen=True, slots=True)
class Addition:
    """One step: the effect added, and how it compares with the other candidates.

    Attributes
    ----------
    effect, probability
        The effect added.
    alternatives
        Probability by name of the other effects that belong to the set.
    falls
        Fall of -2 log evidence by name, fitted or predicted.
    beside
        Names of the effects beside which the candidates were compared.
    soil_error_share
        Share of the change of the soil's parameters that counts as a standard deviation: root mean square over the
        set, weighted by probability.
    temperatures
        What the falls are divided by before they become probabilities: usually, and with P_LARGE_FORMULA_ERROR (see
        `verdict`).
    """

    effect: Effect
    probability: float
    alternatives: dict[str, float]
    falls: dict[str, float]
    beside: frozenset[str] = frozenset()
    soil_error_share: float = SOIL_ERROR_SHARE
    temperatures: tuple[float, float] = (TEMPERATURE, TEMPERATURE)

    def with_neighbour_swapped(self, effect: Effect, other: Effect) -> Addition:
        """The same with one effect beside it in place of another."""
        if effect.name not in self.beside:
            return self
        return replace(self, beside=self.beside - {effect.name} | {other.name})


class PresentModel(NamedTuple):
    """A model that an effect may be added to, fitted to all instants or to the thinned ones.

    fitted is the model as fitted, cache the FitCache that it belongs to, trial the same effects fitted to the thinned
    instants.  The numbers are those of all instants, fitted or predicted: -2 log evidence, -2 log posterior, gap
    (reduced chi-square), and residuals of the held-out and of all blocks.
    """

    fitted: FittedModel
    cache: FitCache
    trial: FittedModel | None
    neg2_log_evidence: float
    neg2_log_posterior: float
    gap: float
    checked_rows: int
    rows: int

    @classmethod
    def of(cls, fitted: FittedModel, full: FitCache, thinned: FitCache) -> PresentModel:
        """A model fitted to all instants, and from its optimum to the thinned ones."""
        numbers = fitted.neg2_log_evidence, fitted.neg2_log_posterior, fitted.gap, fitted.checked_rows, fitted.rows
        trial = thinned.fit(fitted.effects, [fitted.as_starts()], TRIAL_OPTIONS)
        return cls(fitted, full, trial, *numbers)

    @classmethod
    def predicted(cls, trial: FittedModel, thinned: FitCache, rows: int) -> PresentModel:
        """A model fitted to the thinned instants only, with numbers predicted for `rows` residuals."""
        ratio = rows / trial.rows
        numbers = (
            trial.predicted_neg2_log_evidence(rows),
            ratio * trial.neg2_log_posterior,
            trial.gap,
            round(ratio * trial.checked_rows),
            rows,
        )
        return cls(trial, thinned, trial, *numbers)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects of the model."""
        return self.fitted.effects

    @property
    def names(self) -> frozenset[str]:
        """Names of the effects."""
        return frozenset(self.fitted.names)


class Shortlist(NamedTuple):
    """Candidates that are compared in one step.

    Attributes
    ----------
    to_fit
        Those that get a full fit, with its starts.
    predicted_falls
        Of others, the fall of -2 log evidence that their scores predict.
    deficits
        By how much -2 log evidence each is behind the best one, predicted from trial fits.
    own_parameters
        From trial fits, the likelihood of the parameters that later recordings have for themselves.
    """

    to_fit: Sequence[tuple[Effect, Sequence[Start]]]
    predicted_falls: dict[str, float]
    deficits: dict[str, float]
    own_parameters: dict[str, tuple[OwnParameters, ...]]


# One step: the best effect to add.


def best_addition(
    full: FitCache,
    thinned: FitCache,
    present: PresentModel,
    candidates: Sequence[Effect],
    explained: float,
    again: Collection[str] | None = None,
    at_hand: FittedModel | None = None,
) -> tuple[Addition, FittedModel] | None:
    """The most probable effect to add to the present model.

    Parameters
    ----------
    full, thinned
        Fits to all instants and to the thinned ones.
    present
        The present model.
    candidates
        Effects that it has not.
    explained
        Fall of -2 log evidence by the effects that it has.
    again
        Names that were compared in an earlier step for the same place.
    at_hand
        A model that has one effect more than the present one, if one is fitted already.

    Returns
    -------
    (Addition, FittedModel) or None
        The addition and the model with it; None where no candidate reaches the required fall.
    """
    if not candidates:
        return None
    chosen = shortlist(thinned, present, candidates, explained, again)
    required = required_fall(explained, present.gap, present.checked_rows, present.rows)
    fitted, bounds = full_fits(full, present, chosen, explained, required, at_hand)
    if not fitted:
        return None
    fitted = _comparable(full, present, fitted, explained)
    if present.gap <= gap_limit(present.checked_rows):  # nothing disagrees: a delay within a bus cycle is none
        fitted = {
            name: (effect, fit)
            for name, (effect, fit) in fitted.items()
            if not effect.late
            or exceeds_sampling_delay(
                full.records, full.prior, fit, effect, explained + present.neg2_log_evidence - fit.neg2_log_evidence
            )
        }
        if not fitted:
            return None
    falls = {name: present.neg2_log_evidence - fit.neg2_log_evidence for name, (_, fit) in fitted.items()}
    most = max(falls.values())
    if most < required:
        return None
    falls |= {name: min(fall, most) for name, fall in chosen.predicted_falls.items()}
    predicted = {name: most - deficit for name, deficit in chosen.deficits.items() if name not in fitted}
    falls |= {name: min(fall, bounds.get(name, fall)) for name, fall in predicted.items()}
    own = chosen.own_parameters | {name: fit.own_parameters(effect) for name, (effect, fit) in fitted.items()}
    chances = probabilities(falls, explained, own)
    best = next(name for name in chances if name in fitted and falls[name] >= required)
    others = {n: p for n, p in chances.items() if n != best and p >= SET_PROBABILITY}
    effect, fit = fitted[best]
    share = mean_soil_error_share({n: p for n, p in chances.items() if n == best or n in others})
    divisors = temperatures(explained + most)
    return Addition(effect, chances[best], others, falls, present.names, share, divisors), fit


def full_fits(
    full: FitCache,
    present: PresentModel,
    chosen: Shortlist,
    explained: float,
    required: float,
    at_hand: FittedModel | None,
) -> tuple[dict[str, tuple[Effect, FittedModel]], dict[str, float]]:
    """Full fits of the shortlist by name, and upper bounds on the falls of those that were given up."""
    fitted: dict[str, tuple[Effect, FittedModel]] = {}
    bounds: dict[str, float] = {}
    dominated = insufficient = math.inf  # -2 log posterior above which a fit is given up
    for effect, starts in chosen.to_fit:
        if at_hand is not None and present.names | {effect.name} == set(at_hand.names):
            fit: FittedModel | None = at_hand
        else:
            options = replace(COMPARED, give_up_above=min(dominated, insufficient))
            fit = full.fit((*present.effects, effect), [starts], options)
        if fit is None:
            bounds[effect.name] = max(present.neg2_log_posterior - min(dominated, insufficient), 0.0)
            continue
        fitted[effect.name] = effect, fit
        fall = present.neg2_log_evidence - fit.neg2_log_evidence
        dominated = min(dominated, fit.neg2_log_posterior + dominated_deficit(explained + fall))
        insufficient = present.neg2_log_posterior - GIVE_UP_SHARE * required if fall < required else math.inf
    return fitted, bounds


def _comparable(
    full: FitCache, present: PresentModel, fitted: dict[str, tuple[Effect, FittedModel]], explained: float
) -> dict[str, tuple[Effect, FittedModel]]:
    """The same candidates, with converged fits of those that are not dominated."""
    least = min(fit.neg2_log_evidence for _, fit in fitted.values())
    within = dominated_deficit(explained + present.neg2_log_evidence - least)
    return {
        name: (
            effect,
            fitted_to_convergence(full, present.neg2_log_evidence, fit)
            if fit.neg2_log_evidence - least < within
            else fit,
        )
        for name, (effect, fit) in fitted.items()
    }


def fitted_to_convergence(full: FitCache, neg2_log_evidence: float, fitted: FittedModel) -> FittedModel:
    """A model fitted further if its fit stopped at its evaluations; the same where that does not improve it.

    Nor is a model fitted further whose evidence is worse than the given one, or whose gap exceeds MAX_REFINED_GAP.
    """
    if fitted.converged or fitted.neg2_log_evidence > neg2_log_evidence or fitted.gap > MAX_REFINED_GAP:
        return fitted
    further = full.fit(fitted.effects, [fitted.as_starts()])
    return fitted if further is None or further.neg2_log_evidence > fitted.neg2_log_evidence else further


# Swaps: effects added earlier, compared again beside those added later.


def with_swaps(
    full: FitCache,
    thinned: FitCache,
    base: FittedModel,
    present: FittedModel,
    additions: Sequence[Addition],
    candidates: Sequence[Effect],
) -> tuple[list[Addition], FittedModel]:
    """The additions, each compared again with all candidates beside the effects that the model has now.

    Parameters
    ----------
    full, thinned
        Fits to all instants and to the thinned ones.
    base, present
        The model without any addition, and with all of them.
    additions
        In the order in which they were made.
    candidates
        All effects that may be added.

    Returns
    -------
    (list of Addition, FittedModel)
        In the order of the model's effects; an addition may have been swapped for another or dropped.
    """
    chosen, compared = list(additions), set[frozenset[str]]()
    while stale := [a for a in chosen if a.beside != (others := _others(a, present)) and others not in compared]:
        addition = stale[0]
        others = _others(addition, present)
        compared.add(others)
        index = chosen.index(addition)
        possible = [candidate for candidate in candidates if candidate.name not in others]
        without = _without_addition(full, thinned, base, present, addition, possible)
        if isinstance(without, Addition):
            chosen[index] = without
        if without is None or isinstance(without, Addition):
            continue
        explained = base.neg2_log_evidence - without.neg2_log_evidence
        found = best_addition(full, thinned, without, possible, explained, addition.falls, present)
        is_superfluous = without.neg2_log_evidence < present.neg2_log_evidence + FALL_REQUIRED_ALONE
        if found is None and without.cache is full and is_superfluous:
            present = without.fitted
            del chosen[index]
        elif found is not None and found[1].neg2_log_evidence < present.neg2_log_evidence + EQUAL_EVIDENCE:
            gained = present.neg2_log_evidence - found[1].neg2_log_evidence
            if gained < FALL_REQUIRED_ALONE:  # the comparison of the others holds beside the new effect as well
                chosen = [a.with_neighbour_swapped(addition.effect, found[0].effect) for a in chosen]
            chosen[index], present = found
    order = {name: i for i, name in enumerate(present.names)}
    return sorted(chosen, key=lambda addition: order[addition.effect.name]), present


def _without_addition(
    full: FitCache,
    thinned: FitCache,
    base: FittedModel,
    present: FittedModel,
    addition: Addition,
    candidates: Sequence[Effect],
) -> Addition | PresentModel | None:
    """The present model without one of its effects, or the renewed addition where trial fits show no competitor.

    Where the trial fits show clearly what the effect explains, the model without it is predicted from its trial fit;
    otherwise it is fitted to all instants.  None where a fit fails.
    """
    effect, rows = addition.effect, present.rows
    with_it = thinned.fit(present.effects, [present.as_starts()], TRIAL_OPTIONS)
    without = _fit_without(thinned, present, effect, TRIAL_OPTIONS)
    fall = 0.0 if with_it is None or without is None else predicted_fall(without, with_it, rows)
    if with_it is None or without is None or fall < CLEAR_FALL:
        fitted = _fit_without(full, present, effect, COMPARED)
        return None if fitted is None else PresentModel.of(fitted, full, thinned)
    explained = base.neg2_log_evidence - present.neg2_log_evidence
    if _has_competitor(thinned, without, addition, candidates, with_it, explained, rows):
        return PresentModel.predicted(without, thinned, rows)
    (chance,) = probabilities({effect.name: fall}, explained - fall).values()
    others = _others(addition, present)
    share = soil_error_share(effect.name)
    return Addition(effect, chance, {}, {effect.name: fall}, others, share, temperatures(explained))


def _has_competitor(
    thinned: FitCache,
    without: FittedModel,
    addition: Addition,
    candidates: Sequence[Effect],
    with_it: FittedModel,
    explained: float,
    rows: int,
) -> bool:
    """Whether another effect in the place of an addition is not dominated, by trial fits without it and with it."""
    found = trial_candidates(
        thinned.scores(without, candidates), thinned.further_scores(without, candidates), addition.falls
    )
    for other in candidates:
        if other.name in found and other.name != addition.effect.name:
            trial = trial_fit(thinned, without, found[other.name], with_it.neg2_log_posterior + DOMINATED_BY_POSTERIOR)
            if trial is not None and not is_dominated(predicted_fall(trial, with_it, rows), explained):
                return True
    return False


def _fit_without(cache: FitCache, present: FittedModel, effect: Effect, options: SolverOptions) -> FittedModel | None:
    """The present model less one effect, fitted from its optimum but for the latents, which followed that effect."""
    kept = [e for e in present.effects if e.name != effect.name]
    starts = [start._replace(near_optimum=False) for start in present.as_starts(kept)]
    return cache.fit(kept, [starts], options)


def _others(addition: Addition, present: FittedModel) -> frozenset[str]:
    """Names of the present model's effects other than that of the addition."""
    return frozenset(present.names) - {addition.effect.name}


# Which candidates are worth a full fit: score tests, then trial fits to thinned instants.


def shortlist(
    thinned: FitCache,
    present: PresentModel,
    candidates: Sequence[Effect],
    explained: float,
    again: Collection[str] | None,
) -> Shortlist:
    """The candidates to compare beside the present model.

    Trial fits choose them where the scores predict a clear fall.  Otherwise thinned instants say too little, and the
    scores choose.  Parameters as of best_addition().
    """
    trial, found = present.trial, present.cache.scores(present.fitted, candidates)
    if trial is not None:
        further = thinned.further_scores(trial, candidates)
        groups = ((present.rows / fit.rows, group) for fit, group in ((present.fitted, found), (trial, further)))
        most = max(ratio * -score.neg2_log_evidence for ratio, group in groups for score in group)
        if most >= CLEAR_FALL or present.fitted is trial:
            trials = _trials(thinned, trial, trial_candidates(found, further, again), present.rows)
            return _by_trials(trials, explained, present.rows)
    further = present.cache.further_scores(present.fitted, candidates)
    return _by_scores([*found, *further], least_required_fall(explained))


def _by_scores(found: Iterable[Score], required: float) -> Shortlist:
    """The best score of each candidate; those not far below the required fall get a full fit."""
    best: dict[str, Score] = {}
    for score in sorted(found, key=lambda score: score.neg2_log_evidence):
        if score.neg2_log_evidence < SCORE_THRESHOLD:
            best.setdefault(score.effect.name, score)
    chosen = list(best.values())[:MAX_CANDIDATES]
    enough = FULL_FIT_SHARE * max([required, *(-s.neg2_log_evidence for s in chosen)])
    to_fit = [(s.effect, s.starts) for s in chosen if -s.neg2_log_evidence > enough]
    return Shortlist(to_fit, {s.effect.name: -s.neg2_log_evidence for s in chosen[len(to_fit) :]}, {}, {})


class _Trial(NamedTuple):
    """A candidate's trial fit, and the fall of -2 log evidence of all instants that it predicts."""

    effect: Effect
    fitted: FittedModel
    fall: float


def _by_trials(trials: Sequence[_Trial], explained: float, rows: int) -> Shortlist:
    """The candidates that are not dominated, the best first; the first ones without a clear deficit get a full fit."""
    best = trials[0].fall if trials else 0.0
    best_converged = bool(trials) and trials[0].fitted.converged
    kept = [t for t in trials if t.fall > 0.0 and not is_dominated(best - t.fall, explained + best)][:MAX_CANDIDATES]
    undecided = [
        t for t in kept if not (best_converged and t.fitted.converged and best - t.fall > DOMINATED_BY_EVIDENCE)
    ]
    to_fit = [(t.effect, t.fitted.as_starts()) for t in undecided[:MAX_FULL_FITS]]
    deficits = {t.effect.name: best - t.fall for t in kept}
    own = {t.effect.name: t.fitted.own_parameters(t.effect, rows / t.fitted.rows) for t in kept}
    return Shortlist(to_fit, {}, deficits, own)


def _trials(thinned: FitCache, present: FittedModel, found: Mapping[str, Sequence[Score]], rows: int) -> list[_Trial]:
    """The trial fits of the candidates, with the falls that they predict for `rows` residuals, the best first."""
    trials: list[_Trial] = []
    least = math.inf
    for of_one in found.values():
        fitted = trial_fit(thinned, present, of_one, least + DOMINATED_BY_POSTERIOR)
        if fitted is not None:
            trials.append(_Trial(of_one[0].effect, fitted, predicted_fall(present, fitted, rows)))
            least = min(least, fitted.neg2_log_posterior)
    return sorted(trials, key=lambda trial: -trial.fall)


def trial_candidates(
    found: Sequence[Score], further: Sequence[Score], again: Collection[str] | None
) -> dict[str, list[Score]]:
    """Scores of the candidates that get a trial fit, by name, the best first.

    found are the scores, the best first; further those at further starts; again as of best_addition().
    """
    first = found[:MAX_TRIALS_BY_SCORE]
    named = [score for score in found[len(first) :] if again is not None and score.effect.name in again]
    best_further = sorted(further, key=lambda score: score.neg2_log_evidence)[:MAX_TRIALS_BY_FURTHER_SCORE]
    chosen: dict[str, list[Score]] = {}
    for score in (*first, *named, *best_further):
        if score.neg2_log_evidence < SCORE_THRESHOLD:
            chosen.setdefault(score.effect.name, []).append(score)
    return chosen


def trial_fit(
    thinned: FitCache, present: FittedModel, found: Sequence[Score], give_up_above: float
) -> FittedModel | None:
    """The best fit of one candidate to the thinned instants, from the starts of its scores (see FitCache.fit)."""
    starts = [s.starts for s in found]
    predicted = [present.neg2_log_evidence + s.neg2_log_evidence for s in found]
    options = replace(TRIAL_OPTIONS, give_up_above=give_up_above)
    return thinned.fit((*present.effects, found[0].effect), starts, options, predicted)


def predicted_fall(before: FittedModel, after: FittedModel, rows: int) -> float:
    """Fall of -2 log evidence between two trial fits, predicted for this number of residuals."""
    return before.predicted_neg2_log_evidence(rows) - after.predicted_neg2_log_evidence(rows)


# Fits and scores, each computed once.


_ScoreFunction = Callable[[Sequence[Record], SoilPrior, FittedModel, Sequence[Effect]], list[Score]]


class FitCache:
    """The models fitted to the same recordings, and the scores beside them.

    A set of effects whose fit converged is not fitted again, except where a model with fewer effects explains as much,
    and no fit is repeated from the same start.
    """

    def __init__(self, records: Sequence[Record], prior: SoilPrior) -> None:
        self.records, self.prior = tuple(records), prior
        self._converged: dict[frozenset[str], FittedModel] = {}
        self._by_start: dict[tuple[Hashable, ...], FittedModel | None] = {}
        self._scored: dict[Hashable, tuple[FittedModel, list[Score]]] = {}

    def fit(
        self,
        effects: Sequence[Effect],
        starts: Sequence[Sequence[Start]] = (),
        options: SolverOptions = COMPARED,
        predicted: Sequence[float] = (),
    ) -> FittedModel | None:
        """The best fit with these effects.

        Parameters
        ----------
        effects
            Of the model.
        starts
            Each a Start for each recording; none searches from several.
        options
            When a descent stops or is given up.
        predicted
            -2 log evidence predicted from each start: one that predicts no improvement on a converged fit is left out.

        Returns
        -------
        FittedModel or None
            None where all fits fail.
        """
        names = frozenset(effect.name for effect in effects)
        best = self._converged.get(names)
        if best is not None and not _explains_nothing(best, self._with_fewer(names)):
            return best
        for i, start in enumerate(starts or (None,)):
            if best is not None and best.converged and i < len(predicted) and best.neg2_log_evidence <= predicted[i]:
                continue
            best = _better(best, self._from(start, effects, options))
        with_fewer = self._with_fewer(names)
        if with_fewer is not None and math.isinf(options.give_up_above) and _explains_nothing(best, with_fewer):
            best = _better(best, self._from(with_fewer.as_starts(effects), effects, options))
        if best is not None and best.converged:
            self._converged[names] = best
        return best

    def scores(self, present: FittedModel, candidates: Sequence[Effect]) -> list[Score]:
        """score.scores() of a model fitted to these recordings."""
        return self._once(scores, present, candidates)

    def further_scores(self, present: FittedModel, candidates: Sequence[Effect]) -> list[Score]:
        """score.further_scores() of a model fitted to these recordings."""
        return self._once(further_scores, present, candidates)

    def _once(self, function: _ScoreFunction, present: FittedModel, candidates: Sequence[Effect]) -> list[Score]:
        key = function, id(present), tuple(effect.name for effect in candidates)
        if key not in self._scored:
            self._scored[key] = present, function(self.records, self.prior, present, candidates)
        return self._scored[key][1]

    def _from(
        self, start: Sequence[Start] | None, effects: Sequence[Effect], options: SolverOptions
    ) -> FittedModel | None:
        """The fit from one start, from the cache if it is there."""
        key = (frozenset(effect.name for effect in effects), start_key(start), options)
        if key not in self._by_start:
            self._by_start[key] = fit_model(self.records, self.prior, effects, start, options)
        return self._by_start[key]

    def _with_fewer(self, names: frozenset[str]) -> FittedModel | None:
        """Of the models with a subset of the effects, the one of least -2 log posterior: a bound for the full set."""
        fits = [fit for fewer, fit in self._converged.items() if fewer < names]
        return min(fits, key=lambda fit: fit.neg2_log_posterior, default=None)


def _explains_nothing(fit: FittedModel | None, with_fewer: FittedModel | None) -> bool:
    """Whether a model fits no better than one with a subset of its effects: from another start it may."""
    return with_fewer is not None and (
        fit is None or fit.neg2_log_posterior > with_fewer.neg2_log_posterior - NEGLIGIBLE_FALL
    )


def _better(one: FittedModel | None, other: FittedModel | None) -> FittedModel | None:
    return one if other is None or (one is not None and one.neg2_log_evidence <= other.neg2_log_evidence) else other


def start_key(starts: Sequence[Start] | None) -> Hashable:
    """A start as a hashable key."""
    return starts and tuple((start.soil.tobytes(), start.gains.tobytes(), start.near_optimum) for start in starts)
