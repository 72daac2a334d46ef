"""Models fitted to the same recordings: each set of effects once, however many questions lead to it."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

from soilbus.diagnosis.completion import Completion, complete
from soilbus.diagnosis.records import Record
from soilbus.estimation.gauss_newton import THOROUGH, Effort, Start
from soilbus.estimation.posterior import SoilPrior
from soilbus.terra.effects.effect import Effect


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
        if best is not None and not self._explains_nothing(names):
            return best
        for i, start in enumerate(starts or (None,)):
            if best is not None and best.converged and i < len(foreseen) and best.evidence <= foreseen[i]:
                continue
            begun = (names, _key(start), effort)
            if begun not in self._begun:
                self._begun[begun] = complete(self.records, self.prior, effects, start, effort)
            found = self._begun[begun]
            if found is not None and (best is None or found.evidence < best.evidence):
                best = found
        if best is not None and best.converged:
            self._converged[names] = best
        return best

    def _explains_nothing(self, names: frozenset[str]) -> bool:
        """Whether a model costs no less than one with some of its effects: from elsewhere it may find its place."""
        cost = self._converged[names].cost
        return any(less < names and fit.cost < cost + NOTHING for less, fit in self._converged.items())


def _key(starts: Sequence[Start] | None) -> Hashable:
    """Where a fit begins, as a key."""
    return starts and tuple((start.soil.tobytes(), start.gains.tobytes(), start.near) for start in starts)
