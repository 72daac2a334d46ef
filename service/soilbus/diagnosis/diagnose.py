"""Find where model and data disagree, name the missing effect, add it, show the gap shrink."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from soilbus.diagnosis.completion import Completion
from soilbus.diagnosis.fits import Fits
from soilbus.diagnosis.gap import Gap, gap_of
from soilbus.diagnosis.learned import Correction, corrections
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.score import Score, further_scores, scores
from soilbus.diagnosis.verdict import (
    PAYS,
    PLAUSIBLE,
    SURE,
    Verdict,
    hopeless,
    hopeless_from,
    is_real,
    least_that_pays,
    price,
    probabilities,
)
from soilbus.diagnosis.where import Disagreement, disagreements
from soilbus.estimation.gauss_newton import Effort, Start
from soilbus.estimation.posterior import Posterior, SoilPrior
from soilbus.terra.effects.effect import Effect

MAX_EFFECTS = 3
TRIED, FURTHER = 6, 4
"""Candidates of a round that are fitted to a few instants: the best by their scores, and by those of further starts.

Of 77 rounds of the tune halves of seeds 112 and 113 the one that was named was among the best four or three.
"""
TRIED_AGAIN = 4
"""The same of a round that names an effect anew, besides those that were fitted when it was named first."""
COUNTED, FITTED = 6, 3
"""Those of them that count, if only by what few instants foretell, and those that are fitted to all."""
THINNED = 4
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
ROUGH = Effort(STEPS, enough=0.02, little=5e-3)
"""The same where few instants tell which candidates to fit to all."""
WORTH_TRYING = -2.0
"""Foreseen change of -2 log evidence above which a candidate does not count."""
WORTH_FITTING = 0.2
"""Share of what an effect must explain, and of what the best is foreseen to, from which it is fitted where little
is foreseen: of less the score is as good."""
ASTRAY = 3.0
"""Gap of a model that is off by so much that further steps of a fit decide nothing."""
SHARE_OF_PRICE = 0.3
"""Share of what an effect must explain that its fit to the blocks learned from must, after one that did not."""
SAME = 1.0
"""Difference of -2 log evidence that is none."""


class NotFitted(Exception):
    """The present model cannot be fitted to the recordings at all."""


@dataclass(frozen=True, slots=True)
class Addition:
    """One round: the effect added, its probability, and the other names with theirs; falls of -2 log evidence.

    beside are the names of the effects beside which it was named; form_left is that of all these effects, by their
    probabilities (root mean square).
    """

    effect: Effect
    probability: float
    alternatives: dict[str, float]
    falls: dict[str, float]
    beside: frozenset[str] = frozenset()
    form_left: float = Effect.form_left

    def beside_another(self, effect: Effect, other: Effect) -> Addition:
        """The same with one effect beside it in place of another."""
        if effect.name not in self.beside:
            return self
        return replace(self, beside=self.beside - {effect.name} | {other.name})


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
        found = _round(whole, few, present, left, base.evidence - present.evidence)
        if found is None:
            break
        addition, present = found
        additions.append(addition)
        if len(additions) > 1 and present.gap < ASTRAY:
            additions, present = _reconsidered(whole, few, base, present, additions, candidates)
    present = _converged(whole, base, present)
    additions.sort(key=lambda addition: -addition.falls[addition.effect.name])
    progress("holding out every block in turn")
    before = gap_of(records, prior, base)
    after = gap_of(records, prior, present) if additions else before
    verdict = _verdict(before, after, additions)
    learned = corrections(list(records), present) if verdict is Verdict.UNKNOWN else []
    return Diagnosis(verdict, tuple(where), tuple(additions), base, present, tuple(learned), before, after)


def _round(
    whole: Fits,
    few: Fits,
    present: Completion,
    candidates: Sequence[Effect],
    explained: float,
    again: Collection[str] | None = None,
) -> tuple[Addition, Completion] | None:
    """The best effect to add to the present model, which explains so much; None where none pays.

    `again` are names that were fitted in an earlier round for the same place.
    """
    promising = _promising(whole, few, present, candidates, explained, again)
    asked = price(explained, present.gap, present.checked_rows, present.rows)
    tried, at_most = _fitted(whole, present, promising, explained, asked)
    if not tried:
        return None
    best = min(tried, key=lambda name: tried[name][1].evidence)
    if present.evidence - tried[best][1].evidence < asked:
        tried[best] = tried[best][0], _converged(whole, present, tried[best][1])
    falls = {name: present.evidence - completion.evidence for name, (_, completion) in tried.items()}
    best = max(falls, key=lambda name: falls[name])
    if falls[best] < asked:
        return None
    falls |= {name: min(fall, falls[best]) for name, fall in promising.foreseen.items()}
    foretold = {name: falls[best] - behind for name, behind in promising.behind.items() if name not in tried}
    falls |= {name: min(fall, at_most.get(name, fall)) for name, fall in foretold.items()}
    chances = probabilities(falls, explained)
    others = {n: p for n, p in chances.items() if n != best and p >= PLAUSIBLE}
    effect, completion = tried[best]
    form_left = _form_left({n: p for n, p in chances.items() if n == best or n in others}, candidates)
    return Addition(effect, chances[best], others, falls, frozenset(present.names), form_left), completion


def _form_left(chances: Mapping[str, float], candidates: Iterable[Effect]) -> float:
    """Root mean square, by their probabilities, of what the formulas of these effects leave in the soil."""
    left = {effect.name: effect.form_left for effect in candidates}
    return math.sqrt(sum(p * left[name] ** 2 for name, p in chances.items()) / sum(chances.values()))


def _fitted(
    whole: Fits, present: Completion, promising: _Promising, explained: float, asked: float
) -> tuple[dict[str, tuple[Effect, Completion]], dict[str, float]]:
    """Candidates with their fits to all data by name, and falls of -2 log evidence that those given up stay below."""
    fitted: dict[str, tuple[Effect, Completion]] = {}
    at_most: dict[str, float] = {}
    behind = worthless = math.inf
    for effect, starts in promising.fits:
        completion = whole.of((*present.effects, effect), [starts], Effort(STEPS, min(behind, worthless)))
        if completion is None:
            at_most[effect.name] = max(present.cost - min(behind, worthless), 0.0)
            continue
        fitted[effect.name] = effect, completion
        fall = present.evidence - completion.evidence
        behind = min(behind, completion.cost + hopeless_from(explained + fall))
        worthless = present.cost - SHARE_OF_PRICE * asked if fall < asked else math.inf
    return fitted, at_most


def _converged(whole: Fits, present: Completion, completion: Completion) -> Completion:
    """The same, or where further steps lead if they were too few, and it is better than the present and not astray."""
    if completion.converged or completion.evidence > present.evidence or completion.gap > ASTRAY:
        return completion
    further = whole.of(completion.effects, [completion.as_starts()])
    return completion if further is None or further.evidence > completion.evidence else further


class _Promising(NamedTuple):
    """Candidates worth a fit of all data, with where it starts.

    Falls of -2 log evidence that scores foretell of others, and how far behind the best one a few instants put each.
    """

    fits: Sequence[tuple[Effect, Sequence[Start]]]
    foreseen: dict[str, float]
    behind: dict[str, float]


def _promising(
    whole: Fits,
    few: Fits,
    present: Completion,
    candidates: Sequence[Effect],
    explained: float,
    again: Collection[str] | None,
) -> _Promising:
    """The few candidates that count: foreseen by scores, tried on a few instants.

    Where little is foreseen a few instants tell nothing, and scores are as good as fits.
    """
    before = few.of(present.effects, [present.as_starts()], ROUGH)
    foreseen = scores(whole.records, whole.prior, present, candidates)
    further = [] if before is None else further_scores(few.records, few.prior, before, candidates)
    times = 1.0 if before is None else present.rows / before.rows
    most = max(part * -score.evidence for part, of in ((1.0, foreseen), (times, further)) for score in of)
    if before is None or most < CLEAR:
        return _of_scores(
            [*foreseen, *further_scores(whole.records, whole.prior, present, candidates)], least_that_pays(explained)
        )
    tried: list[tuple[float, Effect, Completion]] = []
    least = math.inf
    for found in _worth_trying(foreseen, further, again).values():
        completion = _tried(few, before, found, least + BEHIND_UNSETTLED)
        if completion is not None:
            fall = before.foreseen(present.rows) - completion.foreseen(present.rows)
            tried.append((fall, found[0].effect, completion))
            least = min(least, completion.cost)
    tried.sort(key=lambda item: -item[0])
    best = tried[0][0] if tried else 0.0
    settled = all(completion.converged for _, _, completion in tried[:1])
    kept = [
        (fall, effect, completion) for fall, effect, completion in tried
        if fall > 0.0 and not hopeless(best - fall, explained + best)
    ][:COUNTED]  # fmt: skip
    for_good = {e.name for fall, e, c in kept if settled and c.converged and best - fall > BEHIND}
    fits = [(e, c.as_starts()) for _, e, c in kept if e.name not in for_good]
    return _Promising(fits[:FITTED], {}, {e.name: best - fall for fall, e, _ in kept})


def _of_scores(found: Iterable[Score], least: float) -> _Promising:
    """The best score of each candidate that counts; those that come near what they must explain are fitted."""
    best: dict[str, Score] = {}
    for score in sorted(found, key=lambda score: score.evidence):
        if score.evidence < WORTH_TRYING:
            best.setdefault(score.effect.name, score)
    chosen = list(best.values())[:COUNTED]
    enough = WORTH_FITTING * max([least, *(-s.evidence for s in chosen)])
    fitted = [(s.effect, s.starts) for s in chosen if -s.evidence > enough]
    return _Promising(fitted, {s.effect.name: -s.evidence for s in chosen[len(fitted) :]}, {})


def _worth_trying(
    foreseen: Sequence[Score], further: Sequence[Score], again: Collection[str] | None
) -> dict[str, list[Score]]:
    """Scores of the candidates that count by name, the best foreseen first; `again` as of _round()."""
    tried = foreseen[: TRIED if again is None else TRIED_AGAIN]
    named = [score for score in foreseen[len(tried) :] if again is not None and score.effect.name in again]
    found: dict[str, list[Score]] = {}
    for score in (*tried, *named, *sorted(further, key=lambda score: score.evidence)[:FURTHER]):
        if score.evidence < WORTH_TRYING:
            found.setdefault(score.effect.name, []).append(score)
    return found


def _tried(few: Fits, present: Completion, found: Sequence[Score], hopeless: float) -> Completion | None:
    """The best fit of one candidate to a few instants; from further starts only where more is foreseen of them."""
    starts, foreseen = [s.starts for s in found], [present.evidence + s.evidence for s in found]
    return few.of((*present.effects, found[0].effect), starts, ROUGH._replace(hopeless=hopeless), foreseen)


def _reconsidered(
    whole: Fits,
    few: Fits,
    base: Completion,
    present: Completion,
    additions: Sequence[Addition],
    candidates: Sequence[Effect],
) -> tuple[list[Addition], Completion]:
    """Effects named anew that were named beside others than are there now: alone, one may have stood for two."""
    chosen, looked = list(additions), set[frozenset[str]]()
    while stale := [a for a in chosen if a.beside != (others := _others(a, present)) and others not in looked]:
        addition = stale[0]
        place, others = chosen.index(addition), _others(addition, present)
        looked.add(others)
        left = [effect for effect in candidates if effect.name not in others]
        stays = _stays(few, base, present, addition, left)
        if stays is not None:
            chosen[place] = stays
            continue
        without = _without(whole, present, addition.effect)
        if without is None:
            continue
        found = _round(whole, few, without, left, base.evidence - without.evidence, addition.falls)
        if found is None and without.evidence < present.evidence + PAYS:
            present = without
            del chosen[place]
        elif found is not None and found[1].evidence < present.evidence + SAME:
            if present.evidence - found[1].evidence < PAYS:  # what stands beside is named as well beside the other
                chosen = [a.beside_another(addition.effect, found[0].effect) for a in chosen]
            chosen[place], present = found
    order = {name: i for i, name in enumerate(present.names)}
    return sorted(chosen, key=lambda addition: order[addition.effect.name]), present


def _stays(
    few: Fits, base: Completion, present: Completion, addition: Addition, candidates: Sequence[Effect]
) -> Addition | None:
    """The addition beside the present others, where a few instants tell that it, and no other, belongs there."""
    effect, others = addition.effect, _others(addition, present)
    here, without = few.of(present.effects, [present.as_starts()], ROUGH), _without(few, present, effect)
    if here is None or without is None:
        return None
    fall = without.foreseen(present.rows) - here.foreseen(present.rows)
    explained = base.evidence - present.evidence
    if fall < CLEAR:
        return None
    of = few.records, few.prior, without, candidates
    found = _worth_trying(scores(*of), further_scores(*of), addition.falls)
    for rival in candidates:
        if rival.name in found and rival.name != effect.name:
            completion = _tried(few, without, found[rival.name], here.cost + BEHIND_UNSETTLED)
            if completion is None:
                continue
            if not hopeless(completion.foreseen(present.rows) - here.foreseen(present.rows), explained):
                return None
    (chance,) = probabilities({effect.name: fall}, explained - fall).values()
    return Addition(effect, chance, {}, {effect.name: fall}, others, effect.form_left)


def _others(addition: Addition, present: Completion) -> frozenset[str]:
    """Names of the present model's effects but that one's."""
    return frozenset(present.names) - {addition.effect.name}


def _without(fits: Fits, present: Completion, effect: Effect) -> Completion | None:
    """The present model less one effect, fitted from where it stands."""
    n_sensors = fits.records[0].learned.n_sensors
    kept = [n_sensors + i for i, f in enumerate(present.free) if f.effect != effect.name]
    starts = [
        start._replace(gains=np.concatenate([start.gains[:n_sensors], start.gains[kept]]))
        for start in present.as_starts()
    ]
    return fits.of([e for e in present.effects if e.name != effect.name], [starts], Effort(STEPS))


def _verdict(before: Gap, after: Gap, additions: Sequence[Addition]) -> Verdict:
    if is_real(before.value, after.value, min(before.rows, after.rows)):
        return Verdict.UNKNOWN
    if not additions:
        return Verdict.NONE
    return Verdict.NAMED if all(a.probability >= SURE for a in additions) else Verdict.AMBIGUOUS
