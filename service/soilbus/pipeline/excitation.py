"""Excitation: how much draft and slip varied in a window.

    sd = sqrt(max(sample variance - mean noise variance, 0))

An estimate of the soil needs variation of both: load determines the bearing modulus, slip the shear strength.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.window import Rig, Window
from soilbus.terra.vehicle import slip_ratio


class Excitation(NamedTuple):
    """Mean and standard deviation of draft [N] and of the wheels' mean slip over a window, less the sensors' noise.

    None where not known.
    """

    draft: float | None = None
    draft_sd: float | None = None
    slip: float | None = None
    slip_sd: float | None = None


def excitation_of(window: Window, rig: Rig, min_speed: float) -> Excitation:
    """Excitation of a forward window; slip only where the ground speed exceeds min_speed [m/s]."""
    ground = np.where(window.ground_speed > min_speed, window.ground_speed, np.nan)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        slip = np.where(rig.drives, slip_ratio(rig.radius, window.speed, ground), np.nan)
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
