"""Trends of measured values: a Kalman filter of value and rate, and a regression line that forgets.

x = (value, rate)      x_k+1 = [1 dt; 0 1] x_k + noise      the rate is a random walk
y = a + b x            weights e^(x / memory), x = 0 now
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.decision.options import WATCH, WatchOptions

__all__ = ["Extrapolation", "Line", "LocalTrend"]

FIRST_RATE_STD = 1.0
"""Sd of a rate [1/s, m/s^2] before any sample: no vehicle brakes harder than it slides."""


class LocalTrend(NamedTuple):
    """Kalman filter of a value and its rate [1/s], with their covariance (Harvey 1989)."""

    value: float = 0.0
    rate: float = 0.0
    var: float = math.inf
    cov: float = 0.0
    rate_var: float = FIRST_RATE_STD**2

    def after(self, step: float, value: float, variance: float, wander: float) -> LocalTrend:
        """Return the trend after one more sample.

        Parameters
        ----------
        step
            [s], since the last call.
        value, variance
            The sample; nan where not known.
        wander
            [1/s per sqrt(s)], intensity of the random walk of the rate.
        """
        known = math.isfinite(value) and math.isfinite(variance)
        if math.isinf(self.var):
            return LocalTrend(value, 0.0, variance) if known else self
        square = wander**2 * step
        predicted = self.value + step * self.rate
        var = self.var + step * (2.0 * self.cov + step * self.rate_var) + square * step**2 / 3.0
        cov = self.cov + step * self.rate_var + square * step / 2.0
        rate_var = self.rate_var + square
        if not known:
            return LocalTrend(predicted, self.rate, var, cov, rate_var)
        innovation, total = value - predicted, var + variance
        return LocalTrend(
            predicted + var / total * innovation,
            self.rate + cov / total * innovation,
            var * variance / total,
            cov * variance / total,
            rate_var - cov**2 / total,
        )

    def probability_above(self, level: float, horizon: float) -> float:
        """Return the probability that the value passes a level within a time [s]; 0 before any sample."""
        if math.isinf(self.var):
            return 0.0
        var = self.var + horizon * (2.0 * self.cov + horizon * self.rate_var)
        return 0.5 * math.erfc((level - self.value - horizon * self.rate) / math.sqrt(2.0 * var))


class Line(NamedTuple):
    """Regression line with exponential forgetting: value now, and slope [1/s]."""

    value: float
    slope: float

    @classmethod
    def through(cls, x: Array, y: Array, memory: float) -> Line:
        """Return the line through values y (N,) at times x [s] counted from now; nan is none."""
        known = np.isfinite(y)
        weight, y = np.exp(x / memory) * known, np.where(known, y, 0.0)
        total = float(weight.sum())
        if total <= 0.0:
            return cls(math.nan, 0.0)
        t, mean = float(weight @ x) / total, float(weight @ y) / total
        spread = float(weight @ (x - t) ** 2) / total
        slope = float((weight * (x - t)) @ y) / total / spread if spread > 1e-9 else 0.0
        return cls(mean - slope * t, slope)


class Extrapolation(NamedTuple):
    """A line that is carried on, and how far earlier ones have missed what came.

    Attributes
    ----------
    line
        The present one.
    foreseen
        Times [s] of earlier lines, and their values `check_lag` later.
    error, checks
        Sum of squares of what came less that, and their number, both with exponential forgetting.
    """

    line: Line = Line(math.nan, 0.0)
    foreseen: tuple[tuple[float, float], ...] = ()
    error: float = 0.0
    checks: float = 0.0

    def after(self, t: float, step: float, line: Line, age: float, options: WatchOptions = WATCH) -> Extrapolation:
        """Return the state after one more line; step: since the last one, age: of the first of its values [s]."""
        error, checks, lag = self.error, self.checks, options.check_lag
        past = [there for there in self.foreseen if t - there[0] >= lag - 0.5 * step]
        if past and age >= lag + options.settling_time:
            kept = math.exp(-step / options.check_memory)
            error, checks = kept * error + (line.value - past[-1][1]) ** 2, kept * checks + 1.0
        foreseen = (*self.foreseen[max(len(past) - 1, 0) :], (t, line.value + lag * line.slope))
        return Extrapolation(line, foreseen, error, checks)

    def probability_above(self, level: float, std: float, options: WatchOptions = WATCH) -> float:
        """Return the probability that the line passes a level of this sd within `warning_time`; 0 if it falls."""
        if not self.checks > 0.0 or self.line.slope <= 0.0:
            return 0.0
        error = math.sqrt(self.error / self.checks) * options.warning_time / options.check_lag
        spare = level - self.line.value - options.warning_time * self.line.slope
        return 0.5 * math.erfc(spare / (math.sqrt(2.0) * math.hypot(error, std, 1e-9)))

    def time_to(self, level: float) -> float:
        """Return the time [s] until a line that rises reaches a level."""
        return max(level - self.line.value, 0.0) / self.line.slope
