"""Windows of simulated channels as tasks for the service's own estimator."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soilbus.config.model import Config
from soilbus.estimation.assembly import motors_of
from soilbus.estimation.window import Rig, Window
from soilbus.pipeline.intake import ReportedLimits, WindowTask
from soilbus.pipeline.positions import PositionTrack


def torque_limits(config: Config, rig: Rig) -> NDArray[np.float64]:
    """Limits (W,) [N m] as the service has them where none is reported: each wheel's share of its motor's."""
    return ReportedLimits(motors_of(config, rig)).at(0.0)


def task_of(window: Window, end: float, config: Config, torque_limit: NDArray[np.float64], fresh: bool) -> WindowTask:
    """A window task without missing inputs.

    Parameters
    ----------
    window
        The data.
    end
        End of the window [s].
    config
        Window and hop.
    torque_limit
        (W,) [N m]; nan where unknown.
    fresh
        Whether nothing of the window before is carried over.
    """
    return WindowTask(
        index=0 if fresh else round((end - config.estimator.window) / config.estimator.hop),
        start=end - config.estimator.window,
        end=end,
        window=window,
        slip={wheel.name: None for wheel in config.wheel},
        missing=(),
        poor=(),
        torque_limit=torque_limit,
        track=PositionTrack({}),
        rejected={},
        fresh=fresh,
    )
