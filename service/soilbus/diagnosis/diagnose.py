"""Find where model and data disagree, name the missing effect, add it, show the gap shrink."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from soilbus.diagnosis.completion import Completion, complete
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.score import scores
from soilbus.diagnosis.verdict import PAYS, PLAUSIBLE, SURE, Verdict, gap_limit, probabilities
from soilbus.diagnosis.where import Disagreement, disagreements
from soilbus.estimation.posterior import SoilPrior
from soilbus.terra.effects.effect import Effect

MAX_EFFECTS = 3
TRIED = 6
"""Candidates of a round that are fitted."""
WORTH_TRYING = -2.0
"""Foreseen change of -2 log evidence above which a candidate is not fitted."""
NOTHING = "none"


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
    """What was found; base is the present model, completed the one with the effects added."""

    verdict: Verdict
    where: tuple[Disagreement, ...]
    additions: tuple[Addition, ...]
    base: Completion
    completed: Completion


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
        found = _round(records, prior, present, left)
        if found is None:
            break
        addition, present = found
        additions.append(addition)
    return Diagnosis(_verdict(base, present, additions), tuple(where), tuple(additions), base, present)


def _round(
    records: Sequence[Record], prior: SoilPrior, present: Completion, candidates: Sequence[Effect]
) -> tuple[Addition, Completion] | None:
    """The best effect to add to the present model; None where none pays."""
    tried: dict[str, tuple[Effect, Completion]] = {}
    for score in scores(records, prior, present, candidates)[:TRIED]:
        if score.evidence > WORTH_TRYING:
            break
        completion = complete(records, prior, (*present.effects, score.effect), score.starts)
        if completion is not None:
            tried[score.effect.name] = score.effect, completion
    if not tried:
        return None
    falls = {name: present.evidence - completion.evidence for name, (_, completion) in tried.items()}
    best = max(falls, key=lambda name: falls[name])
    if falls[best] < PAYS:
        return None
    chances = probabilities({NOTHING: 0.0} | {name: -fall for name, fall in falls.items()}, present.checked_rows)
    others = {n: p for n, p in chances.items() if n not in (best, NOTHING) and p >= PLAUSIBLE}
    effect, completion = tried[best]
    return Addition(effect, chances[best], others, falls), completion


def _verdict(base: Completion, completed: Completion, additions: Sequence[Addition]) -> Verdict:
    if completed.gap > gap_limit(completed.checked_rows):
        return Verdict.UNKNOWN
    if not additions:
        return Verdict.NONE
    return Verdict.NAMED if all(a.probability >= SURE for a in additions) else Verdict.AMBIGUOUS
