"""The way and the time of a record: shares of it, curves through knots, stretches without a gap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soilbus.terra.effects.effect import Surroundings
from soilbus.terra.stress import Array

_GAP = 3.0  # times the median step


def share_of_way(around: Surroundings) -> Any:
    """0 at the start of the record, 1 at its end: by distance where its length is known, by time otherwise."""
    if around.length > 0.0:
        return np.asarray(around.distance) / around.length
    if around.duration > 0.0:
        return np.asarray(around.t) / around.duration
    return np.zeros(np.shape(around.t))


def through_knots(share: Any, heights: Sequence[float]) -> Array:
    """Straight lines between heights at equally spaced shares 0..1 of the way, level beyond."""
    return np.asarray(np.interp(share, np.linspace(0.0, 1.0, len(heights)), heights))


def instants(values: Any) -> Array:
    """One value for each instant (N,) of what all wheels share: (N,), (N, 1) or (N, W)."""
    array: Array = np.asarray(values, float)
    return array[:, 0] if array.ndim == 2 else array


def stretches(t: Array) -> list[NDArray[np.intp]]:
    """Indices of times [s] (N,) in runs that go forward without a gap."""
    step = np.diff(t)
    forward = step[step > 0.0]
    usual = float(np.median(forward)) if len(forward) else 0.0
    cuts: NDArray[np.intp] = np.flatnonzero((step <= 0.0) | (step > _GAP * usual)) + 1
    return np.split(np.arange(len(t)), cuts.tolist())
