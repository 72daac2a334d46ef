"""Windows of simulated channels as the service's own estimator takes them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soilbus.config.model import Config
from soilbus.estimation.window import Window
from soilbus.pipeline.intake import WindowTask
from soilbus.pipeline.positions import PositionTrack


def task_of(window: Window, end: float, config: Config, torque_limit: NDArray[np.float64], fresh: bool) -> WindowTask:
    """A window that ends at `end` [s] of which nothing is missing; torque_limit (W,) [N m], nan where unknown."""
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
