"""How much draft and slip varied in a window: what an estimate of the soil lives on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.window import Rig, Window
from soilbus.terra.vehicle import slip_ratio


class Excitation(NamedTuple):
    """Mean and standard deviation over a window's bins, without the sensors' noise; None where unknown.

    draft [N]; slip is that of the wheels' mean.
    """

    draft: float | None = None
    draft_sd: float | None = None
    slip: float | None = None
    slip_sd: float | None = None


def excitation_of(window: Window, rig: Rig, min_speed: float) -> Excitation:
    """Of a forward window, its slip where the vehicle is faster than min_speed [m/s]."""
    ground = np.where(window.ground_speed > min_speed, window.ground_speed, np.nan)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        slip = slip_ratio(rig.radius, window.speed, ground)
        noise = window.variance["speed"] / window.speed**2 + window.variance["ground_speed"][:, None] / ground**2
        noise *= (1.0 - slip) ** 2
        wheels = np.isfinite(slip + noise).sum(axis=1)
        mean = np.where(wheels > 0, np.nansum(slip, axis=1) / wheels, np.nan)
        variance = np.nansum(noise, axis=1) / wheels**2
    return Excitation(*_spread(window.draft, window.variance["draft"]), *_spread(mean, variance))


def _spread(value: Array, variance: Array) -> tuple[float | None, float | None]:
    known = np.isfinite(value) & np.isfinite(variance)
    if np.count_nonzero(known) < 2:
        return None, None
    value, variance = value[known], variance[known]
    return float(value.mean()), float(np.sqrt(max(value.var(ddof=1) - variance.mean(), 0.0)))
