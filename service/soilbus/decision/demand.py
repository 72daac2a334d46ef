"""The pull that draft and slope ask of the wheels now, from the window's own measurements.

    pull = mean(draft) / (1 + gain) + mean(weight * sine(pitch))          over the last hop or the whole window

The larger of the two means counts: a driver who has just lifted the implement still wants it down.
"""

from __future__ import annotations

import math

import numpy as np

from soilbus.decision.capability import Demand
from soilbus.estimation.posterior import Estimate
from soilbus.estimation.window import Window, pull_asked
from soilbus.terra.vehicle import GRAVITY, Chassis

NO_GAIN_ERROR = Estimate(0.0, 0.0)


def present_demand(
    window: Window, chassis: Chassis | None, hop: float, gain: Estimate = NO_GAIN_ERROR
) -> Demand | None:
    """Draft and slope over the last hop or the whole window, whichever mean is larger.

    Parameters
    ----------
    window
        A forward window.
    chassis
        Mass and geometry; None gives no demand.
    hop
        [s].
    gain
        Relative gain error of the draft sensor.

    Returns
    -------
    Demand
        None where the draft of the last hop is not known.  Its std is of sensor noise and gain error; later changes of
        the demand are covered by the configured margin.
    """
    if chassis is None or not len(window.t):
        return None
    pull = pull_asked(window, chassis)
    known = np.isfinite(pull)
    recent = known & (window.t > window.t[-1] - hop)
    if not recent.any():
        return None
    part = recent if pull[recent].mean() >= pull[known].mean() else known
    weight = chassis.mass * GRAVITY
    of_slope = np.where(np.isfinite(window.pitch), window.variance["pitch"], 0.0)
    variance = window.variance["draft"] + weight**2 * of_slope
    std = math.sqrt(float(variance[part].sum())) / np.count_nonzero(part)
    slope = float((pull - window.draft)[part].mean())
    draft = float(window.draft[part].mean()) / (1.0 + gain.value)
    return Demand(draft + slope, math.hypot(std, draft * gain.std), slope / weight)
