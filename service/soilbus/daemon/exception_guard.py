"""Guarded estimator: an exception in the estimator costs one window, not the service.

    failures in a row = 3  ->  a new estimator without a prior, and the service reports a fault

A window at which the estimator raises becomes an invalid result with the reason "internal"; the error and its place in
the code are logged once for each of the first three. One solved window resets the count.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

from soilbus.decision.traversability import Status, Traversability
from soilbus.pipeline.intake import WindowTask
from soilbus.pipeline.result import WindowResult

if TYPE_CHECKING:
    from soilbus.estimation.gaussian import Gaussian
    from soilbus.pipeline.estimator import WindowEstimator

log = logging.getLogger(__name__)

INTERNAL = "internal"
"""Reason and kind of failure of a window at which the estimator raised."""
FAILURES_TO_FAULT = 3
"""Failed windows in a row from which the service is in fault."""


class GuardedEstimator:
    """Estimator whose exceptions are caught and counted.

    `first` makes it in the worker, when it is first needed; `again` makes one without a posterior of earlier windows.
    """

    def __init__(self, first: Callable[[], WindowEstimator], again: Callable[[], WindowEstimator]) -> None:
        self._first, self._again = first, again
        self._estimator: WindowEstimator | None = None
        self._in_a_row = 0

    @property
    def estimator(self) -> WindowEstimator:
        """The present estimator."""
        if self._estimator is None:
            self._estimator = self._first()
        return self._estimator

    @property
    def newest(self) -> Gaussian | None:
        """Posterior of the newest window; None as long as there is none."""
        return None if self._estimator is None else self._estimator.tracker.newest_posterior

    @property
    def in_fault(self) -> bool:
        """Whether the last FAILURES_TO_FAULT windows all raised."""
        return self._in_a_row >= FAILURES_TO_FAULT

    def solve(self, task: WindowTask) -> WindowResult:
        """Return a window's result without a warning of immobilisation; an invalid one where the estimator raised.

        One failure leaves the tracker's state as it was, because the tracker changes only with a whole window. After
        FAILURES_TO_FAULT in a row that state may be the cause, and a new estimator takes over.
        """
        try:
            result = self.estimator.solve_unwatched(task)
        except Exception as error:
            self._in_a_row += 1
            if self._in_a_row <= FAILURES_TO_FAULT:
                log.error("window %d failed: %s", task.index, _error_with_place(error))
            if self._in_a_row % FAILURES_TO_FAULT == 0:
                self._estimator = self._again()
            return _failed(task)
        self._in_a_row = 0
        return result


def _failed(task: WindowTask) -> WindowResult:
    return WindowResult(
        t=task.end,
        index=task.index,
        status=Status.INVALID,
        reason=INTERNAL,
        posterior=None,
        bearing=None,
        slip=task.slip,
        sinkage=dict.fromkeys(task.slip),
        traversability=Traversability(),
        chi2=None,
        samples=task.window.samples,
        rejected=task.rejected,
        failure=INTERNAL,
    )


def _error_with_place(error: Exception) -> str:
    """The error in one line, with the place in our code that raised it."""
    trace, place = error.__traceback__, ""
    while trace is not None:
        place = f"{trace.tb_frame.f_code.co_filename.rpartition('/')[2]}:{trace.tb_lineno}"
        trace = trace.tb_next
    return " ".join(f"{type(error).__name__}: {error} ({place})".split())
