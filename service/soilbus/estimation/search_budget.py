"""How much a tracker may search: a token bucket of evaluations of the model, so that a replay is reproducible.

A window that follows the one before needs a few evaluations.  One that does not is searched for from many
soils: that is due at a start, at a border, after a gap, and soon found.  Where the model does not describe
the data no search finds anything, window after window: then the bucket is empty, and a search
is tried again whenever enough has come together (Turner 1986, IEEE Communications 24(10):8, for networks).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class Work:
    """Instants at which the model was evaluated."""

    instants: int = 0


class SearchBudget:
    """Evaluations of whole windows: `rate` come with each window, at most `burst` are kept for later."""

    def __init__(self, rate: float, burst: float) -> None:
        self.work = Work()
        self._rate, self._burst = rate, burst
        self._left, self._window = burst, 1
        self.ended = False

    def next_window(self, instants: int, renewed: bool = False) -> None:
        """A window of so many instants begins; renewed: the model described data lately, and may again."""
        self._left = self._burst if renewed else min(self._left + self._rate, self._burst)
        self._window = max(instants, 1)
        self.ended = False

    def allows(self) -> bool:
        """Whether there is anything left for a search; where not, the window's search has ended."""
        self.ended = self.ended or self._left <= 0.0
        return self._left > 0.0

    def spend(self, begun: int) -> None:
        """A search has ended that began at so many instants of work; the last one may cost more than was left."""
        self._left -= (self.work.instants - begun) / self._window
