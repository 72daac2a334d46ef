"""The entry angle at which the soil carries a wheel's load: the load integral (eq. 20 of Xi et al. 2024) inverted."""

from __future__ import annotations

from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.wheel import MAX_ENTRY_ANGLE, MIN_ENTRY_ANGLE, WheelModel, WheelState, carried_and_slope


def entry_angle_for_load(load: Any, state: WheelState, model: WheelModel, tolerance: float = 1e-12) -> Array:
    """Return the entry angle [rad], in the broadcast shape, at which the soil carries the load [N].

    Newton on logarithms, where the curve is nearly straight, inside a bracket that
    bisection shrinks whenever Newton leaves it; where it leads beyond MAX_ENTRY_ANGLE, that
    is tried first.  state.entry_angle is the first guess where it is finite and positive.
    A load that MAX_ENTRY_ANGLE does not carry (wheel buried), or that is not a positive
    number, gives nan.

    Examples
    --------
    >>> from soilbus.terra.soils import soil_named
    >>> from soilbus.terra.wheel import sinkage, state_on
    >>> guess = state_on(soil_named("loam"), entry_angle=0.3, slip=0.1, radius=0.5, width=0.3)
    >>> angle = entry_angle_for_load(6000.0, guess, WheelModel())
    >>> round(1e3 * float(sinkage(angle, 0.5)))  # mm
    45
    """
    given = state if np.any(state.length) else state[:-1]
    rows = np.array(np.broadcast_arrays(load, *given), float)
    shape = rows.shape[1:]
    load, guess, *_ = rows = rows.reshape(len(rows), -1)
    rest = rows[2:]
    low = np.full(load.shape, np.log(MIN_ENTRY_ANGLE))
    top = np.log(MAX_ENTRY_ANGLE)
    high = np.full(load.shape, top)
    usable = np.isfinite(load) & (load > 0.0)
    target = np.log(np.where(usable, load, 1.0))
    with np.errstate(all="ignore"):
        at = np.where((guess > 0.0) & np.isfinite(guess), np.log(np.abs(guess)), _first_guess(load, rest))
    at = np.clip(np.where(np.isfinite(at), at, np.log(0.3)), low, high)
    todo = np.flatnonzero(usable)
    for _ in range(80):
        if not len(todo):
            break
        part = WheelState(np.exp(at[todo]), *rest[:, todo])
        W, slope = carried_and_slope(part, model)
        miss = np.where(W > 0.0, np.log(np.maximum(W, 1e-300)), -690.0) - target[todo]
        above = miss > 0.0
        high[todo] = np.where(above, at[todo], high[todo])
        low[todo] = np.where(above, low[todo], at[todo])
        with np.errstate(all="ignore"):
            step = at[todo] - miss / (slope * part.entry_angle / W)
        inside = (step > low[todo]) & (step < high[todo]) & (W > 0.0)
        untried = (step >= top) & (high[todo] == top) & (at[todo] < top)
        new = np.where(inside, step, np.where(untried, top, (low[todo] + high[todo]) / 2.0))
        done = (np.abs(miss) < tolerance) | (high[todo] - low[todo] < 1e-14)
        at[todo] = np.where(np.abs(miss) < tolerance, at[todo], new)
        todo = todo[~done]
    angle = np.exp(at)
    angle[~usable | (at > top - 1e-9)] = np.nan
    return angle.reshape(shape)


def _first_guess(load: Array, rest: Array) -> Array:
    """log entry angle for the load K_L b r^(n+1) theta^(2n+1) / (n + 1.5), or of tracks K_L b L (r theta^2 / 2)^n."""
    _, radius, width, K_L, n, *_ = rest
    scale = 0.6 * width * K_L * radius ** (n + 1.0)
    of_wheel = np.log(load * (n + 1.5) / scale) / (2.0 * n + 1.0)
    if len(rest) < len(WheelState._fields) - 1:
        return np.asarray(of_wheel)
    length = rest[-1]
    of_track = (np.log(load / (width * length * K_L)) / n + np.log(2.0 / radius)) / 2.0
    return np.asarray(np.where(length > 0.0, of_track, of_wheel))
