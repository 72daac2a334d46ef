"""A series of samples as a smooth curve, as smooth as its own spectrum and noise allow.

    y_j = x(t_j) + e_j,  var e_j known;  x(t) by local cubics through 2 m + 1 samples

Savitzky & Golay (Anal. Chem. 36:1627, 1964); m is the one of least estimated risk, Mallows' C_p
(Technometrics 15:661, 1973): mean of (y - x)^2 / var + 2 w0, where w0 is the weight that a sample has in its own
smoothed value.  A channel that wanders slowly is averaged over many samples, one that shakes over few.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array

HALF_WIDTHS = (2, 3, 4, 6, 9, 13, 19, 28)
"""Samples on each side that are tried; two are the fewest that leave a cubic anything to average."""
GAP = 1.5
"""Median steps from which two samples belong to different stretches."""
PARTS = 16
"""Parts of a step to which phases are rounded for the variance."""


class Curve(NamedTuple):
    """Values, slopes [1/s] and second derivatives [1/s^2] at times t [s] ascending (K,), cubics between them.

    step [s] is the median one and half_width the samples on each side through which each cubic was laid (0: none).
    """

    t: Array
    value: Array
    slope: Array
    second: Array
    step: float
    half_width: int

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Value, slope and second derivative at times (N,) [s]; straight on beyond the ends, nan of no curve.

        Each is interpolated by itself: the second derivative of cubics through smoothed values
        would be mostly what the smoothing left of the noise.
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


class Series(NamedTuple):
    """A channel's curve of least risk, for slopes and low passes, and the faithful one, for delays."""

    smooth: Curve
    faithful: Curve

    @classmethod
    def of(cls, t: Array, value: Array, variance: Array) -> Series:
        """As curve_of()."""
        smooth = curve_of(t, value, variance)
        return cls(smooth, faithful(smooth, value))

    def later(self, by: float) -> Series:
        """The same with times that are greater [s]."""
        return Series(*(curve._replace(t=curve.t + by) for curve in self))


def curve_of(t: Array, value: Array, variance: Array) -> Curve:
    """The curve of least risk of samples at times t [s], ascending, with these variances, all (K,)."""
    best, least = _curve(t, value, 0), 2.0  # of no smoothing w0 = 1
    for half in HALF_WIDTHS if len(t) else ():
        curve = _curve(t, value, half)
        if not curve.half_width:
            break
        weighed = (value - curve.value) ** 2 / np.where(variance > 0.0, variance, np.inf)
        risk = float(weighed.mean()) + 2.0 * _cubics(half).own
        if risk < least:
            best, least = curve, risk
    return best


def faithful(curve: Curve, value: Array) -> Curve:
    """The curve through half as many of the samples (K,): its bias is a sixteenth, below noise, its noise sqrt(2).

    What is late shows in how the curve moves; least risk leaves as much bias as noise, which would be a delay.
    """
    return _curve(curve.t, value, max(curve.half_width // 2, HALF_WIDTHS[0])) if curve.half_width else curve


def _curve(t: Array, value: Array, half: int) -> Curve:
    """Cubics through so many samples on each side; through the samples themselves where stretches are too short."""
    steps = np.diff(t)
    step = float(np.median(steps)) if len(steps) else 0.0
    slope = np.gradient(value, t) if len(t) > 1 and bool((steps > 0.0).all()) else np.zeros(len(t))
    plain = Curve(t, value, slope, np.zeros(len(t)), step, 0)
    runs = np.split(np.arange(len(t)), np.flatnonzero(steps > GAP * step) + 1)
    runs = [run for run in runs if len(run) > 2 * half]
    if not half or 2 * sum(map(len, runs)) < len(t):
        return plain
    smooth, slope, second = value.copy(), slope.copy(), plain.second.copy()
    for run in runs:
        smooth[run], by_step, twice = _through(value[run], half)
        slope[run], second[run] = by_step / step, twice / step**2
    return Curve(t, smooth, slope, second, step, half)


@cache
def variance_of_one(half: int, n: int, parts: int) -> float:
    """Variance of a value at one instant by n samples: their mean less the curve's there, plus the curve's there.

    In variances of a sample; the instant is so many PARTS of a step behind their middle.
    """
    weights, reach = _cubics(half).weights[:, half], half + n + 2
    nothing = np.zeros((3, 2 * reach + n))

    def around(place: int) -> Array:
        """Weights of the samples in the curve's value, slope and second derivative at one of them."""
        of_place = np.zeros_like(nothing)
        of_place[:, reach + place - half : reach + place + half + 1] = weights
        return of_place

    own = np.zeros(nothing.shape[1])
    own[reach : reach + n] = 1.0 / n
    middle = (n - 1) / 2.0 + parts / PARTS
    place = int(np.floor(middle))
    share = np.full(len(own), middle - place)
    both = np.stack([around(place), around(place + 1)])
    there = _hermite(share, np.ones(len(own)), both[:, 0], both[:, 1], np.zeros(1, np.intp))[0]
    left = own - np.mean([around(i)[0] for i in range(n)], axis=0)
    return float(((left + there) ** 2).sum())


def powers(steps: Array) -> Array:
    """1, s, s^2, s^3 (N, 4) of s (N,)."""
    return np.asarray(steps[:, None] ** np.arange(4.0))


def _hermite(u: Array, h: Array, value: Array, slope: Array, i: NDArray[np.intp]) -> Array:
    """Cubics from place i to the next one, h away, at shares u of the way, all (N,)."""
    left, right, rise = slope[i], slope[i + 1], (value[i + 1] - value[i]) / h
    square, cube = 3.0 * rise - 2.0 * left - right, left + right - 2.0 * rise
    return np.asarray(value[i] + h * u * (left + u * (square + u * cube)))


class _Cubics(NamedTuple):
    """Weights of values and two derivatives at each of M places (3, M, M), and a sample's own at the middle one."""

    weights: Array
    own: float


@cache
def _cubics(half: int) -> _Cubics:
    places = np.arange(-half, half + 1.0)
    basis = powers(places)
    fit = np.linalg.pinv(basis)
    by_step, twice = np.zeros(basis.shape), np.zeros(basis.shape)
    by_step[:, 1:] = basis[:, :3] * np.arange(1.0, 4.0)
    twice[:, 2:] = basis[:, :2] * np.array([2.0, 6.0])
    return _Cubics(np.stack([basis, by_step, twice]) @ fit, float((basis @ fit)[half, half]))


def _through(values: Array, half: int) -> Array:
    """Smoothed values and their first two derivatives by step (3, K), K > 2 half."""
    out = np.empty((3, len(values)))
    for smooth, of_place in zip(out, _cubics(half).weights, strict=True):
        smooth[half : len(values) - half] = np.convolve(values, of_place[half][::-1], "valid")
        smooth[:half] = of_place[:half] @ values[: 2 * half + 1]
        smooth[len(values) - half :] = of_place[half + 1 :] @ values[-2 * half - 1 :]
    return out
