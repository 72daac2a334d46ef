"""The application core: frames in, window results out.

    CAN frames -> Intake (decode, bins, windows) -> WindowEstimator (soil, decision) -> WindowResult

The live bus, a replay and a test use the same code.  It has no bus and no clock: time is the frames' stamps.
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
    """Intake and estimator of one vehicle; ConfigError where configuration and the bus's messages do not fit.

    Feed frames in the order of their stamps, call `advance` with the present time (or `finish` at the end of a log)
    and take the results of the windows that have ended.  A live service may call `intake.due` instead and run
    `estimator.solve_unwatched` in a worker.
    """

    def __init__(self, config: Config, database: Database) -> None:
        self.config, self.database = config, database
        self._use(Intake(config, database))
        effects_and_parameters_of(config)  # its faults are raised now, and not when the estimator is made

    def _use(self, intake: Intake) -> None:
        self.intake, self.admission, self.feed = intake, intake.admission, intake.admission.feed

    def begin_recording(self) -> None:
        """Begin another recording; only the counts of windows, frames and refusals are carried over."""
        self._use(self.intake.of_another_recording())

    @cached_property
    def estimator(self) -> WindowEstimator:
        """The estimator, made at its first use by the worker that uses it."""
        return self.new_estimator()

    def new_estimator(self) -> WindowEstimator:
        """Return a new estimator without any state."""
        from soilbus.pipeline.estimator import WindowEstimator

        return WindowEstimator(self.config)

    def advance(self, now: float) -> list[WindowResult]:
        """Return the results of all windows that ended at or before `now` [s]."""
        return [self.estimator.solve(task) for task in self.intake.due(now)]

    def finish(self, now: float) -> list[WindowResult]:
        """Return the results of the windows still open at the end of a recording that lasts until `now` [s]."""
        return [self.estimator.solve(task) for task in self.intake.finish(now)]


__all__ = ["Pipeline", "WindowResult"]
