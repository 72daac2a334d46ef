"""Effects that were named beside others than are there now, named anew: alone, one may have stood for two."""

from __future__ import annotations

from collections.abc import Sequence

from soilbus.diagnosis.candidates import (
    BEHIND_UNSETTLED,
    CLEAR,
    ROUGH,
    STEPS,
    Standing,
    fall_foretold,
    fitted_to_few,
    worth_trying,
)
from soilbus.diagnosis.completion import Completion
from soilbus.diagnosis.fits import Fits
from soilbus.diagnosis.naming import Addition, named
from soilbus.diagnosis.verdict import PAYS, hopeless, probabilities, temperatures
from soilbus.estimation.gauss_newton import Effort
from soilbus.terra.effects.effect import Effect

SAME = 1.0
"""Difference of -2 log evidence that is none."""


def reconsidered(
    whole: Fits,
    few: Fits,
    base: Completion,
    present: Completion,
    additions: Sequence[Addition],
    candidates: Sequence[Effect],
) -> tuple[list[Addition], Completion]:
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
        found = named(whole, few, told, left, base.evidence - told.evidence, addition.falls, present)
        if found is None and told.fits is whole and told.evidence < present.evidence + PAYS:
            present = told.known
            del chosen[place]
        elif found is not None and found[1].evidence < present.evidence + SAME:
            if present.evidence - found[1].evidence < PAYS:  # what stands beside is named as well beside the other
                chosen = [a.beside_another(addition.effect, found[0].effect) for a in chosen]
            chosen[place], present = found
    order = {name: i for i, name in enumerate(present.names)}
    return sorted(chosen, key=lambda addition: order[addition.effect.name]), present


def _without_it(
    whole: Fits,
    few: Fits,
    base: Completion,
    present: Completion,
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
        fitted = _without(whole, present, effect, Effort(STEPS))
        return None if fitted is None else Standing.of(fitted, whole, few)
    explained = base.evidence - present.evidence
    if _rivals(few, without, addition, candidates, here, explained, rows):
        return Standing.foretold(without, few, rows)
    (chance,) = probabilities({effect.name: fall}, explained - fall).values()
    others = _others(addition, present)
    return Addition(effect, chance, {}, {effect.name: fall}, others, effect.form_left, temperatures(explained))


def _rivals(
    few: Fits,
    without: Completion,
    addition: Addition,
    candidates: Sequence[Effect],
    here: Completion,
    explained: float,
    rows: int,
) -> bool:
    """Whether another effect may belong in the place of one, by fits to the few without it and with it (here)."""
    scores = few.scores(without, candidates), few.further_scores(without, candidates)
    found = worth_trying(*scores, addition.falls)
    for rival in candidates:
        if rival.name in found and rival.name != addition.effect.name:
            completion = fitted_to_few(few, without, found[rival.name], here.cost + BEHIND_UNSETTLED)
            if completion is not None and not hopeless(fall_foretold(completion, here, rows), explained):
                return True
    return False


def _others(addition: Addition, present: Completion) -> frozenset[str]:
    """Names of the present model's effects but that one's."""
    return frozenset(present.names) - {addition.effect.name}


def _without(fits: Fits, present: Completion, effect: Effect, effort: Effort) -> Completion | None:
    """The present model less one effect, fitted from where it stands but for the latents: they followed the effect."""
    left = [e for e in present.effects if e.name != effect.name]
    starts = [start._replace(near=False) for start in present.as_starts(left)]
    return fits.of(left, [starts], effort)
