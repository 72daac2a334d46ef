"""The way and the time of a record: shares of it, curves through knots, stretches without a gap, low passes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.terra.dual import Dual, weighed_sum
from soilbus.terra.effects.effect import Knot, Parameter, Surroundings

_GAP = 3.0  # times the median step
_FORGOTTEN = 1e-15  # share of what was, that a low pass keeps


def share_of_way(around: Surroundings) -> Any:
    """Return the share of the way of a record, 0 to 1: by distance where its length is known, else by time."""
    if around.length > 0.0:
        return np.asarray(around.distance) / around.length
    if around.duration > 0.0:
        return np.asarray(around.t) / around.duration
    return np.zeros(np.shape(around.t))


def through_knots(share: Any, heights: Sequence[Any]) -> Any:
    """Return the natural cubic spline through heights at equally spaced shares 0..1 of the way, level beyond.

    Linear in the heights; twice as near to a smooth profile as straight lines between as many knots.
    """
    return weighed_sum(splines(share, len(heights)), heights)


def mean_height(heights: Sequence[Any]) -> Any:
    """Return the mean over the whole way of the curve through_knots(); linear in the heights."""
    return weighed_sum(_mean_splines(len(heights)), heights)


@cache
def _mean_splines(knots: int) -> Array:
    """The mean over the way (knots,) of each of splines(): trapezoids, less what the curvature takes off."""
    interval = 1.0 / (knots - 1)
    ends = np.full(knots, interval)
    ends[[0, -1]] /= 2.0
    return np.asarray(ends - 0.5 * (ends @ _bending(knots)))


def curve_of(name: str, unit: str, knots: range, intervals: int, std: float, most: float) -> tuple[Parameter, ...]:
    """Return the heights of a curve at these of its knots, as parameters name_1, ..., each with this prior std."""
    return tuple(Parameter(f"{name}_{i}", unit, 0.0, std, -most, most, knot=Knot(name, i, intervals)) for i in knots)


def splines(share: Any, knots: int) -> Array:
    """Return the splines (knots, ...) that are one at one knot and zero at all others."""
    shares = np.asarray(share, float)
    return _splines(shares.tobytes(), knots).reshape(knots, *shares.shape)


@lru_cache(maxsize=16)
def _splines(shares: bytes, knots: int) -> Array:
    """The same (knots, N) at shares as bytes: a fit asks for those of the same few records a thousand times."""
    place = np.clip(np.frombuffer(shares), 0.0, 1.0) * (knots - 1)
    left = np.minimum(np.nan_to_num(place).astype(int), knots - 2)
    to_left = place - left
    to_right = 1.0 - to_left
    bend = _bending(knots)
    curved = (to_right**3 - to_right) * bend.T[:, left] + (to_left**3 - to_left) * bend.T[:, left + 1]
    straight = np.eye(knots)
    return np.asarray(curved + to_right * straight[:, left] + to_left * straight[:, left + 1])


@cache
def _bending(knots: int) -> Array:
    """What makes a sixth of the second derivatives at knots one apart from the heights there; none at the ends."""
    differences = np.zeros((knots, knots))
    system = np.eye(knots)
    for i in range(1, knots - 1):
        differences[i, i - 1 : i + 2] = 1.0, -2.0, 1.0
        system[i, i - 1 : i + 2] = 1.0, 4.0, 1.0
    return np.asarray(np.linalg.solve(system, differences))


def instants(values: Any) -> Any:
    """Return one value for each instant (N,) of a quantity that all wheels share: (N,), (N, 1) or (N, W)."""
    array = values if isinstance(values, Dual) else np.asarray(values, float)
    return array[:, 0] if array.ndim == 2 else array


def stretches(t: Array) -> tuple[NDArray[np.intp], ...]:
    """Return the indices of times [s] (N,) in runs that go forward without a gap."""
    return _stretches(np.asarray(t, float).tobytes())


@lru_cache(maxsize=16)
def _stretches(times: bytes) -> tuple[NDArray[np.intp], ...]:
    """As stretches(), of times as bytes; kept as splines are."""
    t = np.frombuffer(times)
    step = np.diff(t)
    forward = step[step > 0.0]
    usual = float(np.median(forward)) if len(forward) else 0.0
    cuts: NDArray[np.intp] = np.flatnonzero((step <= 0.0) | (step > _GAP * usual)) + 1
    return tuple(np.split(np.arange(len(t)), cuts.tolist()))


def earlier(t: Array, delay: float) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Return two instants of its run for each one (N,), and the share (N,) of the way between them at which
    the moment so long [s] before it lies.

    Negative before a run's first instant: on the straight line through its first two.
    """
    first, second, part = np.arange(len(t)), np.arange(len(t)), np.zeros(len(t))
    for run in stretches(t):
        if len(run) >= 2:
            then = t[run] - delay
            first[run] = run[0] + np.clip(np.searchsorted(t[run], then, side="right") - 1, 0, len(run) - 2)
            second[run] = first[run] + 1
            part[run] = (then - t[first[run]]) / (t[second[run]] - t[first[run]])
    return first, second, part


def through_low_pass(t: Array, values: Array, time_constant: float) -> Array:
    """Return values (N, W) at times (N,) [s] after a first-order lag [s] that has settled before each run.

    Exact where they go in straight lines from one time to the next.
    """
    if time_constant <= 0.0:
        return values
    begins = [int(run[0]) for run in stretches(t)]
    span = np.ones((len(t), 1))
    with np.errstate(over="ignore"):
        span[1:, 0] = np.diff(t) / time_constant
    span[begins] = 1.0
    of_last, mean = np.exp(-span), -np.expm1(-span) / span
    before = np.concatenate([values[:1], values[:-1]])
    out = before * (mean - of_last) + values * (1.0 - mean)
    out[begins], of_last[begins] = values[begins], 0.0
    reach = 1
    while (of_last[reach:] > _FORGOTTEN).any():  # what each instant keeps of the one `reach` before it: few rounds
        out[reach:] += of_last[reach:] * out[:-reach]
        of_last[reach:] = of_last[reach:] * of_last[:-reach]
        reach *= 2
    return out
