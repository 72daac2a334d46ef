"""How many evaluations of the model a search for another soil may take."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class Work:
    """Counter of model evaluations, in instants."""

    instants: int = 0


class SearchBudget:
    """Token bucket of model evaluations (Turner 1986, IEEE Communications 24(10):8), counted in whole windows.

    rate: evaluations that each window adds; burst: most that are kept for later.  Where the model does not describe the
    data no search succeeds, window after window; the empty bucket then limits the cost, and a replay is reproducible.

    Examples
    --------
    >>> budget = SearchBudget(rate=4.0, burst=10.0)
    >>> budget.next_window(instants=200)
    >>> budget.allows()
    True
    >>> before = budget.work.instants
    >>> budget.work.instants += 2000  # ten evaluations of the window
    >>> budget.spend(before)
    >>> budget.allows()
    False
    """

    def __init__(self, rate: float, burst: float) -> None:
        self.work = Work()
        self._rate, self._burst = rate, burst
        self._remaining, self._window = burst, 1
        self.ended = False

    def next_window(self, instants: int, refill: bool = False) -> None:
        """Begin a window of N instants; `refill` fills the bucket, where the model described recent data."""
        self._remaining = self._burst if refill else min(self._remaining + self._rate, self._burst)
        self._window = max(instants, 1)
        self.ended = False

    def allows(self) -> bool:
        """Return whether evaluations remain for a search; if not, set `ended`."""
        self.ended = self.ended or self._remaining <= 0.0
        return self._remaining > 0.0

    def spend(self, work_before: int) -> None:
        """Take the evaluations since `work_before` [instants] from the bucket, which one search may overdraw."""
        self._remaining -= (self.work.instants - work_before) / self._window
