"""Find where model and data disagree, name the missing effect, add it, show the gap shrink."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from soilbus.diagnosis.completion import Completion, complete
from soilbus.diagnosis.learned import Correction, corrections
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.score import further_scores, scores
from soilbus.diagnosis.verdict import PAYS, PLAUSIBLE, SURE, Verdict, hopeless, is_real, pays, probabilities
from soilbus.diagnosis.where import Disagreement, disagreements
from soilbus.estimation.gauss_newton import Start
from soilbus.estimation.posterior import SoilPrior
from soilbus.terra.effects.effect import Effect

MAX_EFFECTS = 3
TRIED = 8
"""Candidates of a round, those of further starts besides, that are fitted to a few instants."""
FITTED = 6
"""Those of them that are fitted to all."""
THINNED = 4
CLEAR = 100.0
"""Foreseen fall of -2 log evidence from which a few instants tell which candidates to fit."""
BEHIND_UNSETTLED = 150.0
"""Cost on a few instants above the least one's from which a candidate is given up, converged or not."""
STEPS = 12
"""Steps of the soil, and then of everything, in which a candidate that explains much is fitted."""
WORTH_TRYING = -2.0
"""Foreseen change of -2 log evidence above which a candidate is not fitted."""
SAME = 1.0
"""Difference of -2 log evidence that is none."""


class NotFitted(Exception):
    """The present model cannot be fitted to the recordings at all."""


@dataclass(frozen=True, slots=True)
class Addition:
    """One round: the effect added, its probability, and the other names with theirs; falls of -2 log evidence."""

    effect: Effect
    probability: float
    alternatives: dict[str, float]
    falls: dict[str, float]


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What was found; base is the present model, completed the one with the effects added.

    additions are in the order of what they explain beside each other, the most first.
    learned describes what is left where the verdict is unknown.
    """

    verdict: Verdict
    where: tuple[Disagreement, ...]
    additions: tuple[Addition, ...]
    base: Completion
    completed: Completion
    learned: tuple[Correction, ...]


def diagnose(
    records: Sequence[Record],
    prior: SoilPrior,
    catalogue: Sequence[Effect],
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """The whole of it; NotFitted where already the present model cannot be fitted."""
    progress("fitting the present model")
    base = complete(records, prior, records[0].learned.effects)
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
        found = _round(records, prior, present, left, base.evidence - present.evidence)
        if found is None:
            break
        addition, present = found
        additions.append(addition)
        if len(additions) > 1:
            additions, present = _reconsidered(records, prior, base, present, additions, candidates)
    additions.sort(key=lambda addition: -addition.falls[addition.effect.name])
    verdict = _verdict(base, present, additions)
    learned = corrections(list(records), present) if verdict is Verdict.UNKNOWN else []
    return Diagnosis(verdict, tuple(where), tuple(additions), base, present, tuple(learned))


def _round(
    records: Sequence[Record], prior: SoilPrior, present: Completion, candidates: Sequence[Effect], explained: float
) -> tuple[Addition, Completion] | None:
    """The best effect to add to the present model, which explains so much; None where none pays."""
    tried: dict[str, tuple[Effect, Completion]] = {}
    for effect, starts in _promising(records, prior, present, candidates, explained):
        completion = complete(records, prior, (*present.effects, effect), starts, STEPS)
        if completion is not None:
            tried[effect.name] = effect, completion
    if not tried:
        return None
    best = min(tried, key=lambda name: tried[name][1].evidence)
    tried[best] = tried[best][0], _converged(records, prior, tried[best][1])
    falls = {name: present.evidence - completion.evidence for name, (_, completion) in tried.items()}
    best = max(falls, key=lambda name: falls[name])
    if not pays(falls[best], explained, present.gap, present.checked_rows, present.rows):
        return None
    chances = probabilities(falls, explained)
    others = {n: p for n, p in chances.items() if n != best and p >= PLAUSIBLE}
    effect, completion = tried[best]
    return Addition(effect, chances[best], others, falls), completion


def _converged(records: Sequence[Record], prior: SoilPrior, completion: Completion) -> Completion:
    """The same, or where further steps from there lead if they were too few."""
    if completion.converged:
        return completion
    further = complete(records, prior, completion.effects, completion.as_starts())
    return completion if further is None or further.evidence > completion.evidence else further


def _promising(
    records: Sequence[Record], prior: SoilPrior, present: Completion, candidates: Sequence[Effect], explained: float
) -> list[tuple[Effect, Sequence[Start]]]:
    """The few candidates worth a fit of all data, and where it starts: foreseen by scores, tried on a few instants.

    Where little is foreseen a few instants tell nothing, and scores are as good as fits.
    """
    few = [record.thinned(THINNED) for record in records]
    before = complete(few, prior, present.effects, present.as_starts(), STEPS)
    foreseen = scores(records, prior, present, candidates)
    further = [] if before is None else [s for e in candidates for s in further_scores(few, prior, before, e)[:1]]
    share = 1.0 if before is None else before.rows / present.rows
    most = max(-score.evidence / part for part, of in ((1.0, foreseen), (share, further)) for score in of)
    if before is None or most < CLEAR:
        foreseen += [s for e in candidates for s in further_scores(records, prior, present, e)[:1]]
        return _first_of_each(
            (s.effect, s.starts)
            for s in sorted(foreseen, key=lambda score: score.evidence)
            if s.evidence < WORTH_TRYING
        )
    tried: list[tuple[float, Effect, Sequence[Start]]] = []
    least = math.inf
    for score in [s for s in (*foreseen[:TRIED], *further) if s.evidence < WORTH_TRYING]:
        with_it = (*present.effects, score.effect)
        completion = complete(few, prior, with_it, score.starts, STEPS, least + BEHIND_UNSETTLED)
        if completion is not None:
            tried.append((before.evidence - completion.evidence, score.effect, completion.as_starts()))
            least = min(least, completion.cost)
    tried.sort(key=lambda item: -item[0])
    best = tried[0][0] / share if tried else 0.0
    return _first_of_each(
        (effect, starts) for fall, effect, starts in tried
        if fall > 0.0 and not hopeless(best - fall / share, explained + best)
    )  # fmt: skip


def _first_of_each(promising: Iterable[tuple[Effect, Sequence[Start]]]) -> list[tuple[Effect, Sequence[Start]]]:
    """No effect twice, and no more than FITTED."""
    best: dict[str, tuple[Effect, Sequence[Start]]] = {}
    for effect, starts in promising:
        best.setdefault(effect.name, (effect, starts))
    return list(best.values())[:FITTED]


def _reconsidered(
    records: Sequence[Record],
    prior: SoilPrior,
    base: Completion,
    present: Completion,
    additions: Sequence[Addition],
    candidates: Sequence[Effect],
) -> tuple[list[Addition], Completion]:
    """Each earlier effect named anew beside the later ones: alone, it may have stood for two."""
    chosen = list(additions)
    for i in range(len(additions) - 1):
        without = _without(records, prior, present, chosen[i].effect)
        if without is None:
            continue
        left = [effect for effect in candidates if effect.name not in without.names]
        found = _round(records, prior, without, left, base.evidence - without.evidence)
        if found is None and without.evidence < present.evidence + PAYS:
            present = without
        elif found is not None and found[1].evidence < present.evidence + SAME:
            chosen[i], present = found
    order = {name: i for i, name in enumerate(present.names)}
    kept = [addition for addition in chosen if addition.effect.name in order]
    return sorted(kept, key=lambda addition: order[addition.effect.name]), present


def _without(records: Sequence[Record], prior: SoilPrior, present: Completion, effect: Effect) -> Completion | None:
    """The present model less one effect, fitted from where it stands."""
    n_sensors = records[0].learned.n_sensors
    kept = [n_sensors + i for i, f in enumerate(present.free) if f.effect != effect.name]
    starts = [
        start._replace(gains=np.concatenate([start.gains[:n_sensors], start.gains[kept]]))
        for start in present.as_starts()
    ]
    return complete(records, prior, [e for e in present.effects if e.name != effect.name], starts, STEPS)


def _verdict(base: Completion, completed: Completion, additions: Sequence[Addition]) -> Verdict:
    if is_real(base.gap, completed.gap, completed.checked_rows):
        return Verdict.UNKNOWN
    if not additions:
        return Verdict.NONE
    return Verdict.NAMED if all(a.probability >= SURE for a in additions) else Verdict.AMBIGUOUS
