"""Frames in, window results out: the same code for the live bus, a replay and a test.

No bus and no clock in here.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from cantools.database.can import Database

from soilbus.config.model import Config
from soilbus.estimation.assembly import effects_and_parameters_of
from soilbus.pipeline.intake import Intake
from soilbus.pipeline.result import WindowResult

if TYPE_CHECKING:
    from soilbus.pipeline.estimator import WindowEstimator


class Pipeline:
    """Intake and estimator of one vehicle.

    Feed frames in the order of their stamps, call `advance` with the present time (or
    `finish` at the end of a log) and take the windows that have ended.  A live service
    may instead take `intake.due` and have `estimator.solve_unwatched` work elsewhere.  Raises
    ConfigError where configuration and database do not fit.
    """

    def __init__(self, config: Config, database: Database) -> None:
        self.config, self.database = config, database
        self._hear_with(Intake(config, database))
        effects_and_parameters_of(config)  # its faults are raised now, and not when the estimator is made

    def _hear_with(self, intake: Intake) -> None:
        self.intake, self.admission, self.feed = intake, intake.admission, intake.admission.feed

    def begin_recording(self) -> None:
        """What is fed from now on is of another recording: nothing is carried over to it but the counts."""
        self._hear_with(self.intake.of_another_recording())

    @cached_property
    def estimator(self) -> WindowEstimator:
        """Made when it is first asked for, by the worker that uses it."""
        return self.new_estimator()

    def new_estimator(self) -> WindowEstimator:
        """Another one, that knows nothing."""
        from soilbus.pipeline.estimator import WindowEstimator

        return WindowEstimator(self.config)

    @property
    def next_end(self) -> float:
        """When the next window ends [s]; infinite before the first sample."""
        return self.intake.next_end

    def advance(self, now: float) -> list[WindowResult]:
        """Results of every window that ended at or before `now` [s]."""
        return [self.estimator.solve(task) for task in self.intake.due(now)]

    def finish(self, now: float) -> list[WindowResult]:
        """Windows still open at the end of a recording that lasts until `now` [s]."""
        return [self.estimator.solve(task) for task in self.intake.finish(now)]


__all__ = ["Pipeline", "WindowResult"]
