"""Models fitted to the same recordings: each set of effects once, however many questions lead to it."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence

from soilbus.diagnosis.completion import Completion, complete
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.score import Score, further_scores, scores
from soilbus.estimation.gauss_newton import THOROUGH, Effort, Start
from soilbus.estimation.posterior import SoilPrior
from soilbus.terra.effects.effect import Effect

_Scores = Callable[[Sequence[Record], SoilPrior, Completion, Sequence[Effect]], list[Score]]

NOTHING = 1.0
"""Fall of the cost by which an effect explains nothing."""


class Fits:
    """Recordings and the models fitted to them.

    None again that converged and is better than with fewer effects, or from where it was fitted before.
    """

    def __init__(self, records: Sequence[Record], prior: SoilPrior) -> None:
        self.records, self.prior = tuple(records), prior
        self._converged: dict[frozenset[str], Completion] = {}
        self._begun: dict[tuple[Hashable, ...], Completion | None] = {}
        self._scored: dict[Hashable, tuple[Completion, list[Score]]] = {}

    def of(
        self,
        effects: Sequence[Effect],
        starts: Sequence[Sequence[Start]] = (),
        effort: Effort = THOROUGH,
        foreseen: Sequence[float] = (),
    ) -> Completion | None:
        """The best fit with these effects from any of the starts (one Start for each recording), or from anywhere.

        None where all fits fail.  A start of which no better evidence is foreseen than a fit came to that converged
        is left out.
        """
        names = frozenset(effect.name for effect in effects)
        best = self._converged.get(names)
        if best is not None and not _explains_nothing(best, self._with_fewer(names)):
            return best
        for i, start in enumerate(starts or (None,)):
            if best is not None and best.converged and i < len(foreseen) and best.evidence <= foreseen[i]:
                continue
            best = _better(best, self._from(start, effects, effort))
        with_fewer = self._with_fewer(names)
        if with_fewer is not None and math.isinf(effort.hopeless) and _explains_nothing(best, with_fewer):
            best = _better(best, self._from(with_fewer.as_starts(effects), effects, effort))
        if best is not None and best.converged:
            self._converged[names] = best
        return best

    def scores(self, present: Completion, candidates: Sequence[Effect]) -> list[Score]:
        """As score.scores() of a model fitted to these recordings, once."""
        return self._once(scores, present, candidates)

    def further_scores(self, present: Completion, candidates: Sequence[Effect]) -> list[Score]:
        """As score.further_scores() of a model fitted to these recordings, once."""
        return self._once(further_scores, present, candidates)

    def _once(self, told: _Scores, present: Completion, candidates: Sequence[Effect]) -> list[Score]:
        key = told, id(present), tuple(effect.name for effect in candidates)
        if key not in self._scored:
            self._scored[key] = present, told(self.records, self.prior, present, candidates)
        return self._scored[key][1]

    def _from(self, start: Sequence[Start] | None, effects: Sequence[Effect], effort: Effort) -> Completion | None:
        """The fit from one start, at hand where it was asked for before."""
        begun = (frozenset(effect.name for effect in effects), _key(start), effort)
        if begun not in self._begun:
            self._begun[begun] = complete(self.records, self.prior, effects, start, effort)
        return self._begun[begun]

    def _with_fewer(self, names: frozenset[str]) -> Completion | None:
        """The fit that costs least of those with some of the effects: one with all of them can cost no more."""
        fits = [fit for less, fit in self._converged.items() if less < names]
        return min(fits, key=lambda fit: fit.cost, default=None)


def _explains_nothing(fit: Completion | None, with_fewer: Completion | None) -> bool:
    """Whether a model costs no less than one with some of its effects: from elsewhere they may find their place."""
    return with_fewer is not None and (fit is None or fit.cost > with_fewer.cost - NOTHING)


def _better(one: Completion | None, other: Completion | None) -> Completion | None:
    return one if other is None or (one is not None and one.evidence <= other.evidence) else other


def _key(starts: Sequence[Start] | None) -> Hashable:
    """Where a fit begins, as a key."""
    return starts and tuple((start.soil.tobytes(), start.gains.tobytes(), start.near) for start in starts)
