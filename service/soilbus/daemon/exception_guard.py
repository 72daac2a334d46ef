"""The estimator as the service uses it: a defect of ours costs one window, not the service."""

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
REPEATED = 3
"""Such windows in a row from which the service is in fault."""


class GuardedEstimator:
    """Solves windows with an estimator.

    `first` makes it, in the worker, when it is first needed; `again` makes another one, that knows nothing.
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
        """What the present estimator knows; None as long as there is none."""
        return None if self._estimator is None else self._estimator.tracker.newest_posterior

    @property
    def in_fault(self) -> bool:
        """Whether windows have failed by a defect so often in a row that the next will too."""
        return self._in_a_row >= REPEATED

    def solve(self, task: WindowTask) -> WindowResult:
        """The window's result, unwatched: the loop watches; an invalid one where the estimator raised.

        What the estimator knew stays, for it learns from whole windows only; not so after
        several failures in a row, for it may be what makes it fail.
        """
        try:
            result = self.estimator.solve_unwatched(task)
        except Exception as error:
            self._in_a_row += 1
            if self._in_a_row <= REPEATED:
                log.error("window %d failed: %s", task.index, _where(error))
            if self._in_a_row % REPEATED == 0:
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


def _where(error: Exception) -> str:
    """The error in one line, with the place in our code that raised it."""
    trace, place = error.__traceback__, ""
    while trace is not None:
        place = f"{trace.tb_frame.f_code.co_filename.rpartition('/')[2]}:{trace.tb_lineno}"
        trace = trace.tb_next
    return " ".join(f"{type(error).__name__}: {error} ({place})".split())
