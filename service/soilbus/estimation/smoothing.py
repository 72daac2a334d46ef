"""Series freed of noise without a shift in time."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from soilbus.terra.effects.along import stretches

Array = NDArray[np.float64]

SMOOTHED = 9
"""Instants through which a parabola goes."""


def smoothed(t: Array, values: Array) -> Array:
    """Values (N, W) at times t [s] (N,) by a parabola through the SMOOTHED nearest instants of the same stretch.

    Savitzky & Golay 1964 (Anal. Chem. 36:1627); shorter stretches stay as they are.
    """
    out = np.array(values, float)
    half, through = SMOOTHED // 2, _parabolas()
    for run in stretches(t):
        if len(run) < SMOOTHED:
            continue
        first, last = run[0], run[-1] + 1  # runs have no holes
        middle = out[first + half : last - half]
        middle[:] = 0.0
        for place, weight in enumerate(through[half].tolist()):
            middle += weight * values[first + place : last - 2 * half + place]
        out[first : first + half] = through[:half] @ values[first : first + SMOOTHED]
        out[last - half : last] = through[half + 1 :] @ values[last - SMOOTHED : last]
    return out


@cache
def _parabolas() -> Array:
    """What makes a least-squares parabola through SMOOTHED equal steps from the values there (SMOOTHED, SMOOTHED)."""
    powers = (np.arange(SMOOTHED)[:, None] - SMOOTHED // 2) ** np.arange(3)
    return np.asarray(powers @ np.linalg.pinv(powers))
