"""The pull that draft and slope ask of the wheels now, from the window's own measurements.

    pull = mean(draft) / (1 + gain) + mean(weight * sine(pitch))          over the last hop or the whole window

The larger of the two means counts: a driver who has just lifted the implement still wants it down.  Where no pitch is
measured but a specific force, m g sine(pitch) = m (specific force - dV/dt).
"""

from __future__ import annotations

import math

import numpy as np

from soilbus.decision.capability import Demand
from soilbus.estimation.posterior import Estimate
from soilbus.estimation.window import Window, pull_asked
from soilbus.terra.vehicle import GRAVITY, Chassis

LEAST_BINS = 3
"""Bins from which a line through speeds has a slope whose error is that of its noise."""
NO_GAIN_ERROR = Estimate(0.0, 0.0)


def present_demand(
    window: Window, chassis: Chassis | None, hop: float, gain: Estimate = NO_GAIN_ERROR
) -> Demand | None:
    """Return the draft and slope over the last hop [s] or the whole forward window, whichever mean is larger.

    None where the draft of the last hop is not known, or no chassis.  The std is of sensor noise and the draft's
    relative gain error; later changes of the demand are covered by the configured margin.
    """
    if chassis is None or not len(window.t):
        return None
    known = np.isfinite(window.draft)
    recent = known & (window.t > window.t[-1] - hop)
    if not recent.any():
        return None
    last, mean = (_over(window.rows(part), chassis, gain) for part in (np.flatnonzero(recent), np.flatnonzero(known)))
    return last if last.pull >= mean.pull else mean


def _over(window: Window, chassis: Chassis, gain: Estimate) -> Demand:
    """Mean demand over a window without gaps in the draft."""
    weight, n = chassis.mass * GRAVITY, len(window.t)
    of_slope = np.where(np.isfinite(window.pitch), window.variance["pitch"], 0.0)
    variance = float((window.variance["draft"] + weight**2 * of_slope).sum()) / n**2
    slope = float((pull_asked(window, chassis) - window.draft).mean())
    if window.kinematic and not np.isfinite(window.pitch).any():
        along, of_along = _gravity_felt(window)
        slope, variance = chassis.mass * along, variance + chassis.mass**2 * of_along
    draft = float(window.draft.mean()) / (1.0 + gain.value)
    return Demand(draft + slope, math.hypot(math.sqrt(variance), draft * gain.std), slope / weight)


def _gravity_felt(window: Window) -> tuple[float, float]:
    """Mean g sin(pitch) [m/s^2] and its variance, 0 where not known: -d/dt (V - integral of specific force)."""
    known = np.isfinite(window.acceleration) & np.isfinite(window.ground_speed)
    if np.count_nonzero(known) < LEAST_BINS:
        return 0.0, 0.0
    t, f, V = window.t[known], window.acceleration[known], window.ground_speed[known]
    gained = np.concatenate([[0.0], np.cumsum((f[1:] + f[:-1]) / 2.0 * np.diff(t))])
    weights = (t - t.mean()) / ((t - t.mean()) ** 2).sum()
    of_speed = float(weights**2 @ window.variance["ground_speed"][known])
    of_force = float(window.variance["acceleration"][known].mean()) / len(t)
    return float(weights @ (gained - V)), of_speed + of_force
