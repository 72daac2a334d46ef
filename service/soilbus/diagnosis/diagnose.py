"""Find where model and data disagree, name the missing effect, add it, show the gap shrink."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from soilbus.diagnosis.candidates import (
    BEHIND_UNSETTLED,
    CLEAR,
    ROUGH,
    STEPS,
    THINNED,
    Promising,
    fitted_to_few,
    promising,
    worth_trying,
)
from soilbus.diagnosis.completion import Completion
from soilbus.diagnosis.fits import Fits
from soilbus.diagnosis.gap import Gap, gap_of
from soilbus.diagnosis.learned import Correction, corrections
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.score import further_scores, scores
from soilbus.diagnosis.verdict import (
    PAYS,
    PLAUSIBLE,
    SURE,
    Verdict,
    hopeless,
    hopeless_from,
    is_real,
    price,
    probabilities,
)
from soilbus.diagnosis.where import Disagreement, disagreements
from soilbus.estimation.gauss_newton import Effort
from soilbus.estimation.posterior import Posterior, SoilPrior
from soilbus.terra.effects.effect import Effect

MAX_EFFECTS = 3
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
    counted = promising(whole, few, present, candidates, explained, again)
    asked = price(explained, present.gap, present.checked_rows, present.rows)
    fitted, at_most = _fitted(whole, present, counted, explained, asked)
    if not fitted:
        return None
    best = min(fitted, key=lambda name: fitted[name][1].evidence)
    if present.evidence - fitted[best][1].evidence < asked:
        fitted[best] = fitted[best][0], _converged(whole, present, fitted[best][1])
    falls = {name: present.evidence - completion.evidence for name, (_, completion) in fitted.items()}
    best = max(falls, key=lambda name: falls[name])
    if falls[best] < asked:
        return None
    falls |= {name: min(fall, falls[best]) for name, fall in counted.foreseen.items()}
    foretold = {name: falls[best] - behind for name, behind in counted.behind.items() if name not in fitted}
    falls |= {name: min(fall, at_most.get(name, fall)) for name, fall in foretold.items()}
    chances = probabilities(falls, explained)
    others = {n: p for n, p in chances.items() if n != best and p >= PLAUSIBLE}
    effect, completion = fitted[best]
    form_left = _form_left({n: p for n, p in chances.items() if n == best or n in others}, candidates)
    return Addition(effect, chances[best], others, falls, frozenset(present.names), form_left), completion


def _form_left(chances: Mapping[str, float], candidates: Iterable[Effect]) -> float:
    """Root mean square, by their probabilities, of what the formulas of these effects leave in the soil."""
    left = {effect.name: effect.form_left for effect in candidates}
    return math.sqrt(sum(p * left[name] ** 2 for name, p in chances.items()) / sum(chances.values()))


def _fitted(
    whole: Fits, present: Completion, counted: Promising, explained: float, asked: float
) -> tuple[dict[str, tuple[Effect, Completion]], dict[str, float]]:
    """Candidates with their fits to all data by name, and falls of -2 log evidence that those given up stay below."""
    fitted: dict[str, tuple[Effect, Completion]] = {}
    at_most: dict[str, float] = {}
    behind = worthless = math.inf
    for effect, starts in counted.fits:
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
    found = worth_trying(scores(*of), further_scores(*of), addition.falls)
    for rival in candidates:
        if rival.name in found and rival.name != effect.name:
            completion = fitted_to_few(few, without, found[rival.name], here.cost + BEHIND_UNSETTLED)
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
