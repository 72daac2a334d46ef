"""Which effect is missing beside a model: the promising ones fitted to all data, compared by evidence."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from soilbus.diagnosis.candidates import STEPS, Promising, Standing, promising
from soilbus.diagnosis.completion import Completion
from soilbus.diagnosis.fits import Fits
from soilbus.diagnosis.late_posterior import is_late
from soilbus.diagnosis.verdict import (
    PLAUSIBLE,
    TEMPERATURE,
    gap_limit,
    hopeless_from,
    price,
    probabilities,
    temperatures,
)
from soilbus.estimation.gauss_newton import Effort
from soilbus.terra.effects.effect import Effect

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
    at_hand: Completion | None = None,
) -> tuple[Addition, Completion] | None:
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
            or is_late(whole.records, whole.prior, fit, effect, explained + present.evidence - fit.evidence)
        }
        if not fitted:
            return None
    falls = {name: present.evidence - completion.evidence for name, (_, completion) in fitted.items()}
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
    whole: Fits, present: Standing, fitted: dict[str, tuple[Effect, Completion]], explained: float
) -> dict[str, tuple[Effect, Completion]]:
    """The candidates with fits that can be compared: those among which the best one may be have converged."""
    least = min(fit.evidence for _, fit in fitted.values())
    within = hopeless_from(explained + present.evidence - least)
    return {
        name: (effect, converged(whole, present.evidence, fit) if fit.evidence - least < within else fit)
        for name, (effect, fit) in fitted.items()
    }


def _form_left(chances: Mapping[str, float], candidates: Iterable[Effect]) -> float:
    """Root mean square, by their probabilities, of what the formulas of these effects leave in the soil."""
    left = {effect.name: effect.form_left for effect in candidates}
    return math.sqrt(sum(p * left[name] ** 2 for name, p in chances.items()) / sum(chances.values()))


def _fitted(
    whole: Fits, present: Standing, counted: Promising, explained: float, asked: float, at_hand: Completion | None
) -> tuple[dict[str, tuple[Effect, Completion]], dict[str, float]]:
    """Candidates with their fits to all data by name, and falls of -2 log evidence that those given up stay below."""
    fitted: dict[str, tuple[Effect, Completion]] = {}
    at_most: dict[str, float] = {}
    behind = worthless = math.inf
    for effect, starts in counted.fits:
        if at_hand is not None and present.names | {effect.name} == set(at_hand.names):
            completion: Completion | None = at_hand
        else:
            completion = whole.of((*present.effects, effect), [starts], Effort(STEPS, min(behind, worthless)))
        if completion is None:
            at_most[effect.name] = max(present.cost - min(behind, worthless), 0.0)
            continue
        fitted[effect.name] = effect, completion
        fall = present.evidence - completion.evidence
        behind = min(behind, completion.cost + hopeless_from(explained + fall))
        worthless = present.cost - SHARE_OF_PRICE * asked if fall < asked else math.inf
    return fitted, at_most


def converged(whole: Fits, evidence: float, completion: Completion) -> Completion:
    """The same, or where further steps lead if they were too few, and it is better than that and not astray."""
    if completion.converged or completion.evidence > evidence or completion.gap > ASTRAY:
        return completion
    further = whole.of(completion.effects, [completion.as_starts()])
    return completion if further is None or further.evidence > completion.evidence else further
