"""Local cubics: a series of samples as a curve, as smooth as its spectrum and noise allow.

    y_j = x(t_j) + e_j,  var e_j known;  x(t) by local cubics through 2 m + 1 samples

Savitzky & Golay (Anal. Chem. 36:1627, 1964); m is the one of least estimated risk, Mallows' C_p
(Technometrics 15:661, 1973): mean of (y - x)^2 / var + 2 w0, where w0 is the weight that a sample has in its own
smoothed value.  A channel that varies slowly is averaged over many samples, one that varies fast over few.
"""

from __future__ import annotations

import math
from functools import cache, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array

HALF_WIDTHS = (2, 3, 4, 6, 9, 13, 19, 28)
"""Numbers of samples on each side that are tried; with two a cubic averages at all."""
PHASE_PARTS = 16
"""Parts of a step to which phases are rounded for the variance, which is kept for each."""


class Curve(NamedTuple):
    """Values, slopes [1/s] and second derivatives [1/s^2] at ascending times t [s] (K,), cubics between them."""

    t: Array
    value: Array
    slope: Array
    second: Array
    slope_gain: Array  # [1/s^2], variance of a slope over that of a sample
    step: float  # [s], the median one
    half_width: int  # number of samples on each side of a fitted cubic; 0: not smoothed
    parts: int = 1  # number of places of which it is the mean

    def averaged(self, length: float, parts: int) -> Curve:
        """Return the curve of means over a length [s] about each time, by a number of places evenly spread over it."""
        if parts < 2 or len(self.t) < 2:
            return self
        places = [self.t + length * ((i + 0.5) / parts - 0.5) for i in range(parts)]
        value, slope, second = np.mean([self.at(place) for place in places], axis=0)
        return self._replace(value=value, slope=slope, second=second, parts=parts)

    def times(self, factor: Array) -> Curve:
        """Return the curve of values that are multiplied by a factor (K,) that is constant but at jumps."""
        return self._replace(value=factor * self.value, slope=factor * self.slope, second=factor * self.second)

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Return value, slope and second derivative at times t (N,) [s], each interpolated on its own.

        Beyond the ends the curve goes on as a straight line; without samples the value is nan.

        Examples
        --------
        >>> import numpy as np
        >>> t = np.arange(10.0)
        >>> value, slope, _ = curve_of(t, 2.0 * t, np.ones(10)).at(np.array([4.5]))
        >>> round(float(value[0]), 6), round(float(slope[0]), 6)
        (9.0, 2.0)
        """
        if len(self.t) < 2:
            nothing = np.zeros(len(t))
            return np.full(len(t), self.value[0] if len(self.t) else np.nan), nothing, nothing
        inside = np.clip(t, self.t[0], self.t[-1])
        i = np.clip(np.searchsorted(self.t, inside, side="right") - 1, 0, len(self.t) - 2)
        h = self.t[i + 1] - self.t[i]
        u = (inside - self.t[i]) / h
        slope = _hermite(u, h, self.slope, self.second, i)
        value = _hermite(u, h, self.value, self.slope, i) + slope * (t - inside)
        second = np.where(t == inside, (1.0 - u) * self.second[i] + u * self.second[i + 1], 0.0)
        return value, slope, second


def curve_of(t: Array, value: Array, variance: Array) -> Curve:
    """The curve of least estimated risk through samples (K,) at ascending times [s] with these noise variances."""
    best, least = 0, 2.0  # of no smoothing w0 = 1
    _, runs = _runs(t)
    weight = 1.0 / np.where(variance > 0.0, variance, np.inf)
    for half in HALF_WIDTHS:
        off, long = np.zeros(len(t)), _long_enough(runs, half, len(t))
        if not long:
            break
        for run in long:
            off[run] = value[run] - _smoothed(value[run], half, 1)[0]
        risk = float((off**2 * weight).mean()) + 2.0 * float(_cubics(half)[0, half, half])
        if risk < least:
            best, least = half, risk
    return _curve(t, value, best)


def faithful(curve: Curve, value: Array) -> Curve:
    """A curve of the samples (K,) with half the half width: 1/16 of the bias, sqrt(2) times the noise.

    The curve of least risk has about as much bias as noise, and its bias would count as acceleration.
    """
    return _curve(curve.t, value, max(curve.half_width // 2, HALF_WIDTHS[0])) if curve.half_width else curve


def _runs(t: Array) -> tuple[float, list[slice]]:
    """Median step of times t (K,) [s], and the runs of samples of which none is missing."""
    steps = np.diff(t)
    step = float(np.median(steps)) if len(steps) else 0.0
    ends = [0, *(np.flatnonzero(steps > 1.5 * step) + 1).tolist(), len(t)]
    return step, [slice(*run) for run in pairwise(ends)]


def _long_enough(runs: list[slice], half: int, n: int) -> list[slice]:
    """The runs that hold a cubic through `half` samples on each side; none where less than half of n samples do."""
    found = [run for run in runs if run.stop - run.start > 2 * half]
    return found if half and 2 * sum(run.stop - run.start for run in found) >= max(n, 1) else []


def _curve(t: Array, value: Array, half: int) -> Curve:
    """The curve by cubics through `half` samples on each side; the samples themselves where runs are too short."""
    step, runs = _runs(t)
    slope = np.gradient(value, t) if len(t) > 1 and bool((np.diff(t) > 0.0).all()) else np.zeros(len(t))
    smooth, second, slope_gain = value.copy(), np.zeros(len(t)), _gradient_gain(t)
    runs = _long_enough(runs, half, len(t))
    if not runs:
        return Curve(t, value, slope, second, slope_gain, step, 0)
    gain = (_cubics(half)[1] ** 2).sum(axis=1) / step**2
    for run in runs:
        smooth[run], by_step, twice = _smoothed(value[run], half)
        slope[run], second[run] = by_step / step, twice / step**2
        slope_gain[run] = gain[half]
        slope_gain[run][:half], slope_gain[run][-half:] = gain[:half], gain[half + 1 :]
    return Curve(t, smooth, slope, second, slope_gain, step, half)


def _gradient_gain(t: Array) -> Array:
    """Variance of the slope between an instant's neighbours, at times t (K,) [s], over that of a sample."""
    if len(t) < 2:
        return np.full(len(t), np.inf)
    between = np.concatenate([t[:1], t, t[-1:]])
    span = between[2:] - between[:-2]
    return np.asarray(2.0 / np.maximum(span, np.finfo(float).tiny) ** 2)


@cache
def variance_of_one(half: int, n: int, parts: int) -> float:
    """Variance of the value at an instant by n samples and the curve, over the variance of a sample.

    The value is the mean of the samples less the curve's mean there, plus the curve at the
    instant, which is `parts` / `PHASE_PARTS` steps after the middle of the samples.
    """
    rest, value = _weights(half, n, parts / PHASE_PARTS, half + n + 2)
    return float(((rest + value) ** 2).sum())


@lru_cache(256)
def kept_noise(half: int, n: int, phase: float, of_value: int, parts: int, ahead: float) -> float:
    """Return the factor c by which a shift along a curve s leaves the noise of instants y as large as it is.

        var(c (y - s(0)) + s(ahead)) = var(y)        ahead in steps

    An instant, `phase` steps after the middle of n samples, has the mean of `parts` places, evenly spread over them, by
    a curve of half width `of_value`.  With 1 the curve's noise adds to that of y or cancels some of it, and some shift
    seems to fit better.
    """
    reach = max(half, of_value) + n + 2 + math.ceil(abs(phase) + abs(ahead))
    rest, now = _weights(of_value, n, phase, reach, parts)
    (_, here), (_, moved) = (_weights(half, n, at, reach, parts) for at in (phase, phase + ahead))
    off, total = rest + now - here, rest + now
    own, shared, rise = (float(x) for x in (off @ off, off @ moved, moved @ moved - total @ total))
    return (math.sqrt(max(shared**2 - own * rise, 0.0)) - shared) / own


def _weights(half: int, n: int, ahead: float, reach: int, parts: int = 1) -> tuple[Array, Array]:
    """Weights of samples in what n of them, from index `reach` on, have beside their curve, and in its value."""
    # the value is `ahead` steps after the middle of the n samples, or the mean over parts spread over n steps there
    weights, nothing = _cubics(half)[:, half], np.zeros((3, 2 * reach + n))

    def weights_of(index: int) -> Array:
        """Weights (3, samples) in the curve's value, slope and second derivative at one sample."""
        weights_at = np.zeros_like(nothing)
        weights_at[:, reach + index - half : reach + index + half + 1] = weights
        return weights_at

    own, value = np.zeros((2, nothing.shape[1]))
    own[reach : reach + n] = 1.0 / n
    for part in range(parts):
        middle = (n - 1) / 2.0 + ahead + n * ((part + 0.5) / parts - 0.5)
        index = math.floor(middle)
        share, one, first = np.full(len(own), middle - index), np.ones(len(own)), np.zeros(1, np.intp)
        both = np.stack([weights_of(index), weights_of(index + 1)])
        value += _hermite(share, one, both[:, 0], both[:, 1], first)[0] / parts
    return own - np.mean([weights_of(i)[0] for i in range(n)], axis=0), value


def _hermite(u: Array, h: Array, value: Array, slope: Array, i: NDArray[np.intp]) -> Array:
    """Cubic Hermite interpolation from knot i to the next, h away, at shares u of h, all (N,)."""
    left, right, rise = slope[i], slope[i + 1], (value[i + 1] - value[i]) / h
    square, cube = 3.0 * rise - 2.0 * left - right, left + right - 2.0 * rise
    return np.asarray(value[i] + h * u * (left + u * (square + u * cube)))


@cache
def _cubics(half: int) -> Array:
    """Weights of value and two derivatives at each of M samples (3, M, M)."""
    offsets = np.arange(-half, half + 1.0)
    basis = offsets[:, None] ** np.arange(4.0)
    fit = np.linalg.pinv(basis)
    by_step, twice = np.zeros(basis.shape), np.zeros(basis.shape)
    by_step[:, 1:] = basis[:, :3] * np.arange(1.0, 4.0)
    twice[:, 2:] = basis[:, :2] * np.array([2.0, 6.0])
    return np.asarray(np.stack([basis, by_step, twice]) @ fit)


def _smoothed(values: Array, half: int, n: int = 3) -> Array:
    """Smoothed values and their first two derivatives by the step number, n of them (n, K), K > 2 half."""
    out = np.empty((n, len(values)))
    for smooth, weights_at in zip(out, _cubics(half), strict=False):
        smooth[half : len(values) - half] = np.convolve(values, weights_at[half][::-1], "valid")
        smooth[:half] = weights_at[:half] @ values[: 2 * half + 1]
        smooth[len(values) - half :] = weights_at[half + 1 :] @ values[-2 * half - 1 :]
    return out
