"""What the present task asks of the wheels, from the window's own measurements."""

from __future__ import annotations

import math

import numpy as np

from soilbus.decision.capability import Demand
from soilbus.estimation.posterior import Estimate
from soilbus.estimation.window import Window, pull_asked
from soilbus.terra.vehicle import GRAVITY, Chassis

EXACT = Estimate(0.0, 0.0)


def present_demand(window: Window, chassis: Chassis | None, hop: float, gain: Estimate = EXACT) -> Demand | None:
    """Draft and slope, over the last hop [s] or the whole window, whichever asks for more.

    A driver who has just lifted the implement because it was too much still wants it
    down.  The std is that of the sensors, noise and the draft's `gain` error: what the demand will
    do next is the margin's business.  None where the draft of the last hop is not known.
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
