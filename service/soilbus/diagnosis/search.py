"""Models fitted to the same recordings: each set of effects once, however many questions lead to it.

Which effects are worth a fit to all data: foreseen by scores, tried on a few instants.

Which effect is missing beside a model: the promising ones fitted to all data, compared by evidence.

Effects that were named beside others than are there now, named anew: alone, one may have stood for two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from soilbus.diagnosis.delays import is_late
from soilbus.diagnosis.evidence import OwnParameters
from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.score import Score, further_scores, scores
from soilbus.diagnosis.verdict import (
    PAYS,
    PLAUSIBLE,
    TEMPERATURE,
    gap_limit,
    least_that_pays,
    out_of_reach,
    out_of_reach_from,
    price,
    probabilities,
    temperatures,
)
from soilbus.estimation.multistart import DEFAULT_OPTIONS, DescentOptions, Start
from soilbus.estimation.posterior import SoilPrior
from soilbus.terra.effects.effect import Effect

_Scores = Callable[[Sequence[Record], SoilPrior, FittedModel, Sequence[Effect]], list[Score]]

NOTHING = 1.0
"""Fall of the cost by which an effect explains nothing."""


class Fits:
    """Recordings and the models fitted to them.

    None again that converged and is better than with fewer effects, or from where it was fitted before.
    """

    def __init__(self, records: Sequence[Record], prior: SoilPrior) -> None:
        self.records, self.prior = tuple(records), prior
        self._converged: dict[frozenset[str], FittedModel] = {}
        self._begun: dict[tuple[Hashable, ...], FittedModel | None] = {}
        self._scored: dict[Hashable, tuple[FittedModel, list[Score]]] = {}

    def of(
        self,
        effects: Sequence[Effect],
        starts: Sequence[Sequence[Start]] = (),
        effort: DescentOptions = DEFAULT_OPTIONS,
        foreseen: Sequence[float] = (),
    ) -> FittedModel | None:
        """The best fit with these effects from any of the starts (one Start for each recording), or from anywhere.

        None where all fits fail.  A start of which no better evidence is foreseen than a fit came to that converged
        is left out.
        """
        names = frozenset(effect.name for effect in effects)
        best = self._converged.get(names)
        if best is not None and not _explains_nothing(best, self._with_fewer(names)):
            return best
        for i, start in enumerate(starts or (None,)):
            if best is not None and best.converged and i < len(foreseen) and best.neg2_log_evidence <= foreseen[i]:
                continue
            best = _better(best, self._from(start, effects, effort))
        with_fewer = self._with_fewer(names)
        if with_fewer is not None and math.isinf(effort.give_up_above) and _explains_nothing(best, with_fewer):
            best = _better(best, self._from(with_fewer.as_starts(effects), effects, effort))
        if best is not None and best.converged:
            self._converged[names] = best
        return best

    def scores(self, present: FittedModel, candidates: Sequence[Effect]) -> list[Score]:
        """As score.scores() of a model fitted to these recordings, once."""
        return self._once(scores, present, candidates)

    def further_scores(self, present: FittedModel, candidates: Sequence[Effect]) -> list[Score]:
        """As score.further_scores() of a model fitted to these recordings, once."""
        return self._once(further_scores, present, candidates)

    def _once(self, told: _Scores, present: FittedModel, candidates: Sequence[Effect]) -> list[Score]:
        key = told, id(present), tuple(effect.name for effect in candidates)
        if key not in self._scored:
            self._scored[key] = present, told(self.records, self.prior, present, candidates)
        return self._scored[key][1]

    def _from(
        self, start: Sequence[Start] | None, effects: Sequence[Effect], effort: DescentOptions
    ) -> FittedModel | None:
        """The fit from one start, at hand where it was asked for before."""
        begun = (frozenset(effect.name for effect in effects), _key(start), effort)
        if begun not in self._begun:
            self._begun[begun] = fit_model(self.records, self.prior, effects, start, effort)
        return self._begun[begun]

    def _with_fewer(self, names: frozenset[str]) -> FittedModel | None:
        """The fit that costs least of those with some of the effects: one with all of them can cost no more."""
        fits = [fit for less, fit in self._converged.items() if less < names]
        return min(fits, key=lambda fit: fit.neg2_log_posterior, default=None)


def _explains_nothing(fit: FittedModel | None, with_fewer: FittedModel | None) -> bool:
    """Whether a model costs no less than one with some of its effects: from elsewhere they may find their place."""
    return with_fewer is not None and (fit is None or fit.neg2_log_posterior > with_fewer.neg2_log_posterior - NOTHING)


def _better(one: FittedModel | None, other: FittedModel | None) -> FittedModel | None:
    return one if other is None or (one is not None and one.neg2_log_evidence <= other.neg2_log_evidence) else other


def _key(starts: Sequence[Start] | None) -> Hashable:
    """Where a fit begins, as a key."""
    return starts and tuple((start.soil.tobytes(), start.gains.tobytes(), start.near_optimum) for start in starts)


TRIED, FURTHER = 4, 4
"""Candidates of a round that are fitted to a few instants: the best by their scores, and by those of further starts.

Of 77 rounds of seeds 112 and 113, and of 95 of seed 127, the one that was named was among them.
"""
COUNTED, FITTED = 6, 3
"""Those of them that count, if only by what few instants foretell, and those that are fitted to all."""
THINNED = 4
"""Every so manieth instant is one of the few."""
CLEAR = 100.0
"""Foreseen fall of -2 log evidence from which a few instants tell which candidates to fit."""
BEHIND = 150.0
"""-2 log evidence by which a candidate is behind for good, foreseen from a few instants: it is not fitted to all.

Three deviations: of a difference d on every THINNED-th instant the deviation is 2 sqrt(d), and 2 sqrt(THINNED x)
of x foreseen.
"""
BEHIND_UNSETTLED = 250.0
"""Cost on a few instants above the least one's from which a candidate is given up, converged or not."""
STEPS = 12
"""Steps of the soil, and then of everything, in which a candidate that explains much is fitted."""
ROUGH = DescentOptions(STEPS, step_tolerance=0.1, relative_tolerance=5e-3)
"""The same where few instants tell which candidates to fit to all."""
WORTH_TRYING = -2.0
"""Foreseen change of -2 log evidence above which a candidate does not count."""
WORTH_FITTING = 0.2
"""Share of what an effect must explain, and of what the best is foreseen to, from which it is fitted where little
is foreseen: of less the score is as good."""


class Standing(NamedTuple):
    """A model that an effect may be added to: as fitted, the fits it is one of, and the same fitted to few instants.

    The numbers are of all instants, or as the few foretell them: -2 log evidence, cost and gap, residuals held out
    and in all.
    """

    known: FittedModel
    fits: Fits
    few: FittedModel | None
    neg2_log_evidence: float
    neg2_log_posterior: float
    gap: float
    checked_rows: int
    rows: int

    @classmethod
    def of(cls, known: FittedModel, whole: Fits, few: Fits) -> Standing:
        """A model fitted to all, and from there to the few."""
        told = known.neg2_log_evidence, known.neg2_log_posterior, known.gap, known.checked_rows, known.rows
        return cls(known, whole, few.of(known.effects, [known.as_starts()], ROUGH), *told)

    @classmethod
    def foretold(cls, known: FittedModel, few: Fits, rows: int) -> Standing:
        """A model fitted to the few alone, of so many residuals in all."""
        times = rows / known.rows
        told = (
            known.foreseen(rows),
            times * known.neg2_log_posterior,
            known.gap,
            round(times * known.checked_rows),
            rows,
        )
        return cls(known, few, known, *told)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """What the model has already."""
        return self.known.effects

    @property
    def names(self) -> frozenset[str]:
        """Names of the effects."""
        return frozenset(self.known.names)


class Promising(NamedTuple):
    """Candidates worth a fit of all data, with where it starts.

    Falls of -2 log evidence that scores foretell of others, and how far behind the best one a few instants put each,
    with what these foretell of the parameters that further recordings have for themselves.
    """

    fits: Sequence[tuple[Effect, Sequence[Start]]]
    foreseen: dict[str, float]
    behind: dict[str, float]
    further: dict[str, tuple[OwnParameters, ...]]


def promising(
    few: Fits, present: Standing, candidates: Sequence[Effect], explained: float, again: Collection[str] | None
) -> Promising:
    """The few candidates that count beside the present model, which explains so much (fall of -2 log evidence).

    Foreseen by scores, tried on a few instants; where little is foreseen these tell nothing, and scores are as good
    as fits.  `again` are names that were fitted in an earlier round for the same place.
    """
    before, foreseen = present.few, present.fits.scores(present.known, candidates)
    if before is not None:
        further = few.further_scores(before, candidates)
        of_all = ((present.rows / fit.rows, found) for fit, found in ((present.known, foreseen), (before, further)))
        most = max(times * -score.neg2_log_evidence for times, found in of_all for score in found)
        if most >= CLEAR or present.known is before:
            trials = _trials(few, before, worth_trying(foreseen, further, again), present.rows)
            return _of_trials(trials, explained, present.rows)
    return _of_scores([*foreseen, *present.fits.further_scores(present.known, candidates)], least_that_pays(explained))


class _Trial(NamedTuple):
    """A candidate's fit to a few instants, and the fall of -2 log evidence of all that it foretells."""

    effect: Effect
    completion: FittedModel
    fall: float


def _trials(few: Fits, before: FittedModel, found: Mapping[str, Sequence[Score]], rows: int) -> list[_Trial]:
    """The fits to the few of those found, the best first, with falls foretold of so many residuals."""
    trials: list[_Trial] = []
    least = math.inf
    for of_one in found.values():
        completion = fitted_to_few(few, before, of_one, least + BEHIND_UNSETTLED)
        if completion is not None:
            trials.append(_Trial(of_one[0].effect, completion, fall_foretold(before, completion, rows)))
            least = min(least, completion.neg2_log_posterior)
    return sorted(trials, key=lambda trial: -trial.fall)


def _of_trials(trials: Sequence[_Trial], explained: float, rows: int) -> Promising:
    """Those that count, the best first; to be fitted to all are the first ones that are not behind for good."""
    best = trials[0].fall if trials else 0.0
    settled = bool(trials) and trials[0].completion.converged
    kept = [t for t in trials if t.fall > 0.0 and not out_of_reach(best - t.fall, explained + best)][:COUNTED]
    open_still = [t for t in kept if not (settled and t.completion.converged and best - t.fall > BEHIND)]
    fits = [(t.effect, t.completion.as_starts()) for t in open_still[:FITTED]]
    behind = {t.effect.name: best - t.fall for t in kept}
    return Promising(
        fits,
        {},
        behind,
        {t.effect.name: t.completion.further_parameters(t.effect, rows / t.completion.rows) for t in kept},
    )


def _of_scores(found: Iterable[Score], least: float) -> Promising:
    """The best score of each candidate that counts; those that come near what they must explain are fitted."""
    best: dict[str, Score] = {}
    for score in sorted(found, key=lambda score: score.neg2_log_evidence):
        if score.neg2_log_evidence < WORTH_TRYING:
            best.setdefault(score.effect.name, score)
    chosen = list(best.values())[:COUNTED]
    enough = WORTH_FITTING * max([least, *(-s.neg2_log_evidence for s in chosen)])
    fitted = [(s.effect, s.starts) for s in chosen if -s.neg2_log_evidence > enough]
    return Promising(fitted, {s.effect.name: -s.neg2_log_evidence for s in chosen[len(fitted) :]}, {}, {})


def fall_foretold(before: FittedModel, after: FittedModel, rows: int) -> float:
    """Fall of -2 log evidence between two fits to the few, foretold of so many residuals."""
    return before.foreseen(rows) - after.foreseen(rows)


def worth_trying(
    foreseen: Sequence[Score], further: Sequence[Score], again: Collection[str] | None
) -> dict[str, list[Score]]:
    """Scores of the candidates that count by name, the best foreseen first; `again` as of promising()."""
    first = foreseen[:TRIED]
    named = [score for score in foreseen[len(first) :] if again is not None and score.effect.name in again]
    found: dict[str, list[Score]] = {}
    for score in (*first, *named, *sorted(further, key=lambda score: score.neg2_log_evidence)[:FURTHER]):
        if score.neg2_log_evidence < WORTH_TRYING:
            found.setdefault(score.effect.name, []).append(score)
    return found


def fitted_to_few(few: Fits, present: FittedModel, found: Sequence[Score], give_up_above: float) -> FittedModel | None:
    """The best fit of one candidate to a few instants; from further starts only where more is foreseen of them."""
    starts, foreseen = [s.starts for s in found], [present.neg2_log_evidence + s.neg2_log_evidence for s in found]
    return few.of((*present.effects, found[0].effect), starts, ROUGH._replace(give_up_above=give_up_above), foreseen)


ASTRAY = 3.0
"""Gap of a model that is off by so much that further steps of a fit decide nothing."""
SHARE_OF_PRICE = 0.3
"""Share of what an effect must explain that its fit to the blocks learned from must, after one that did not."""


@dataclass(frozen=True, slots=True)
class Addition:
    """One round: the effect added, its probability, and the other names with theirs; falls of -2 log evidence.

    beside are the names of the effects beside which it was named; form_left is that of all these effects, by their
    probabilities (root mean square).  divided_by is what the falls are divided by before they become probabilities,
    usually and at times (see `verdict`).
    """

    effect: Effect
    probability: float
    alternatives: dict[str, float]
    falls: dict[str, float]
    beside: frozenset[str] = frozenset()
    form_left: float = Effect.form_left
    divided_by: tuple[float, float] = (TEMPERATURE, TEMPERATURE)

    def beside_another(self, effect: Effect, other: Effect) -> Addition:
        """The same with one effect beside it in place of another."""
        if effect.name not in self.beside:
            return self
        return replace(self, beside=self.beside - {effect.name} | {other.name})


def named(
    whole: Fits,
    few: Fits,
    present: Standing,
    candidates: Sequence[Effect],
    explained: float,
    again: Collection[str] | None = None,
    at_hand: FittedModel | None = None,
) -> tuple[Addition, FittedModel] | None:
    """The best effect to add to the present model, which explains so much, and the model with it; None where none pays.

    `again` are names that were fitted in an earlier round for the same place; at_hand is the model with one of them.
    """
    if not candidates:
        return None
    counted = promising(few, present, candidates, explained, again)
    asked = price(explained, present.gap, present.checked_rows, present.rows)
    fitted, at_most = _fitted(whole, present, counted, explained, asked, at_hand)
    if not fitted:
        return None
    fitted = _compared(whole, present, fitted, explained)
    if present.gap <= gap_limit(present.checked_rows):  # nothing disagrees: a delay within a cycle of the bus is none
        fitted = {
            name: (effect, fit)
            for name, (effect, fit) in fitted.items()
            if not effect.late
            or is_late(
                whole.records, whole.prior, fit, effect, explained + present.neg2_log_evidence - fit.neg2_log_evidence
            )
        }
        if not fitted:
            return None
    falls = {name: present.neg2_log_evidence - completion.neg2_log_evidence for name, (_, completion) in fitted.items()}
    most = max(falls.values())
    if most < asked:
        return None
    falls |= {name: min(fall, most) for name, fall in counted.foreseen.items()}
    foretold = {name: most - behind for name, behind in counted.behind.items() if name not in fitted}
    falls |= {name: min(fall, at_most.get(name, fall)) for name, fall in foretold.items()}
    further = counted.further | {name: fit.further_parameters(effect) for name, (effect, fit) in fitted.items()}
    chances = probabilities(falls, explained, further)
    best = next(name for name in chances if name in fitted and falls[name] >= asked)
    others = {n: p for n, p in chances.items() if n != best and p >= PLAUSIBLE}
    effect, completion = fitted[best]
    form_left = _form_left({n: p for n, p in chances.items() if n == best or n in others}, candidates)
    heat = temperatures(explained + most)
    return Addition(effect, chances[best], others, falls, present.names, form_left, heat), completion


def _compared(
    whole: Fits, present: Standing, fitted: dict[str, tuple[Effect, FittedModel]], explained: float
) -> dict[str, tuple[Effect, FittedModel]]:
    """The candidates with fits that can be compared: those among which the best one may be have converged."""
    least = min(fit.neg2_log_evidence for _, fit in fitted.values())
    within = out_of_reach_from(explained + present.neg2_log_evidence - least)
    return {
        name: (
            effect,
            converged(whole, present.neg2_log_evidence, fit) if fit.neg2_log_evidence - least < within else fit,
        )
        for name, (effect, fit) in fitted.items()
    }


def _form_left(chances: Mapping[str, float], candidates: Iterable[Effect]) -> float:
    """Root mean square, by their probabilities, of what the formulas of these effects leave in the soil."""
    left = {effect.name: effect.form_left for effect in candidates}
    return math.sqrt(sum(p * left[name] ** 2 for name, p in chances.items()) / sum(chances.values()))


def _fitted(
    whole: Fits, present: Standing, counted: Promising, explained: float, asked: float, at_hand: FittedModel | None
) -> tuple[dict[str, tuple[Effect, FittedModel]], dict[str, float]]:
    """Candidates with their fits to all data by name, and falls of -2 log evidence that those given up stay below."""
    fitted: dict[str, tuple[Effect, FittedModel]] = {}
    at_most: dict[str, float] = {}
    behind = worthless = math.inf
    for effect, starts in counted.fits:
        if at_hand is not None and present.names | {effect.name} == set(at_hand.names):
            completion: FittedModel | None = at_hand
        else:
            completion = whole.of((*present.effects, effect), [starts], DescentOptions(STEPS, min(behind, worthless)))
        if completion is None:
            at_most[effect.name] = max(present.neg2_log_posterior - min(behind, worthless), 0.0)
            continue
        fitted[effect.name] = effect, completion
        fall = present.neg2_log_evidence - completion.neg2_log_evidence
        behind = min(behind, completion.neg2_log_posterior + out_of_reach_from(explained + fall))
        worthless = present.neg2_log_posterior - SHARE_OF_PRICE * asked if fall < asked else math.inf
    return fitted, at_most


def converged(whole: Fits, neg2_log_evidence: float, completion: FittedModel) -> FittedModel:
    """The same, or where further steps lead if they were too few, and it is better than that and not astray."""
    if completion.converged or completion.neg2_log_evidence > neg2_log_evidence or completion.gap > ASTRAY:
        return completion
    further = whole.of(completion.effects, [completion.as_starts()])
    return completion if further is None or further.neg2_log_evidence > completion.neg2_log_evidence else further


SAME = 1.0
"""Difference of -2 log evidence that is none."""


def reconsidered(
    whole: Fits,
    few: Fits,
    base: FittedModel,
    present: FittedModel,
    additions: Sequence[Addition],
    candidates: Sequence[Effect],
) -> tuple[list[Addition], FittedModel]:
    """The additions and the model with them, each effect named beside those that are there now."""
    chosen, looked = list(additions), set[frozenset[str]]()
    while stale := [a for a in chosen if a.beside != (others := _others(a, present)) and others not in looked]:
        addition = stale[0]
        others = _others(addition, present)
        looked.add(others)
        place = chosen.index(addition)
        left = [candidate for candidate in candidates if candidate.name not in others]
        told = _without_it(whole, few, base, present, addition, left)
        if isinstance(told, Addition):
            chosen[place] = told
        if told is None or isinstance(told, Addition):
            continue
        found = named(whole, few, told, left, base.neg2_log_evidence - told.neg2_log_evidence, addition.falls, present)
        if found is None and told.fits is whole and told.neg2_log_evidence < present.neg2_log_evidence + PAYS:
            present = told.known
            del chosen[place]
        elif found is not None and found[1].neg2_log_evidence < present.neg2_log_evidence + SAME:
            if (
                present.neg2_log_evidence - found[1].neg2_log_evidence < PAYS
            ):  # what stands beside is named as well beside the other
                chosen = [a.beside_another(addition.effect, found[0].effect) for a in chosen]
            chosen[place], present = found
    order = {name: i for i, name in enumerate(present.names)}
    return sorted(chosen, key=lambda addition: order[addition.effect.name]), present


def _without_it(
    whole: Fits,
    few: Fits,
    base: FittedModel,
    present: FittedModel,
    addition: Addition,
    candidates: Sequence[Effect],
) -> Addition | Standing | None:
    """The model without one of its effects, or that addition where a few instants tell that it belongs there alone.

    Where they tell clearly what it explains they foretell the model without it as well.  None where there is no fit.
    """
    effect, rows = addition.effect, present.rows
    here, without = few.of(present.effects, [present.as_starts()], ROUGH), _without(few, present, effect, ROUGH)
    fall = 0.0 if here is None or without is None else fall_foretold(without, here, rows)
    if here is None or without is None or fall < CLEAR:
        fitted = _without(whole, present, effect, DescentOptions(STEPS))
        return None if fitted is None else Standing.of(fitted, whole, few)
    explained = base.neg2_log_evidence - present.neg2_log_evidence
    if _rivals(few, without, addition, candidates, here, explained, rows):
        return Standing.foretold(without, few, rows)
    (chance,) = probabilities({effect.name: fall}, explained - fall).values()
    others = _others(addition, present)
    return Addition(effect, chance, {}, {effect.name: fall}, others, effect.form_left, temperatures(explained))


def _rivals(
    few: Fits,
    without: FittedModel,
    addition: Addition,
    candidates: Sequence[Effect],
    here: FittedModel,
    explained: float,
    rows: int,
) -> bool:
    """Whether another effect may belong in the place of one, by fits to the few without it and with it (here)."""
    scores = few.scores(without, candidates), few.further_scores(without, candidates)
    found = worth_trying(*scores, addition.falls)
    for rival in candidates:
        if rival.name in found and rival.name != addition.effect.name:
            completion = fitted_to_few(few, without, found[rival.name], here.neg2_log_posterior + BEHIND_UNSETTLED)
            if completion is not None and not out_of_reach(fall_foretold(completion, here, rows), explained):
                return True
    return False


def _others(addition: Addition, present: FittedModel) -> frozenset[str]:
    """Names of the present model's effects but that one's."""
    return frozenset(present.names) - {addition.effect.name}


def _without(fits: Fits, present: FittedModel, effect: Effect, effort: DescentOptions) -> FittedModel | None:
    """The present model less one effect, fitted from where it stands but for the latents: they followed the effect."""
    left = [e for e in present.effects if e.name != effect.name]
    starts = [start._replace(near_optimum=False) for start in present.as_starts(left)]
    return fits.of(left, [starts], effort)
