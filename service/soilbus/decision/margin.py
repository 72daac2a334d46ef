"""What the ground has left beyond what is asked of it, by the curve of pull over slip, and for how long.

    weakens        C = P + max P_hat(s' > s) - P_hat(s) falls to the demand Q, beyond what a wrong curve explains
    outgrows       P(Q + h dQ/dt > C - w) > p, by the errors of earlier such extrapolations; w: the curve's width
    takes all      P(Q > (1 - e) max P_hat) > p, e: how wrong the curve may be, or s > s_max

P: pull given, P_hat: pull over slip of the last window.  The moments are kept and seen along the newest curve: so a new
window is no new ground.  Trends are regressions whose rows count e^(x / memory), x: time [s] from now.  dQ/dt is a
slope over 5 s and more: a draft's swings of two or three seconds say nothing of a demand h later.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.decision.options import WATCH, WatchOptions
from soilbus.decision.stall import LONGEST_GAP

if TYPE_CHECKING:
    from soilbus.decision.capability import OverSlip


class Margin(NamedTuple):
    """Share of the ground's capacity that is left; `left_by` makes the next one.

    rows (N, 5): time [s], common slip, pull given [N], demand of draft and slope [N] of the last moments, and demand
    that they foresaw `settling_time` later.  since [s]: of the first moment without a gap.  error, checks: sum of
    squares of the errors of foreseen demands, and their number.  calm [s]: the last moment whose trend did not
    reach the limit.  cause: what is seen now, empty for nothing.
    time_left [s]: until the capacity falls to the demand, inf where it does not; None where it is not known.
    """

    rows: Array = np.empty((0, 5))
    since: float = math.inf
    error: float = 0.0
    checks: int = 0
    calm: float = -math.inf
    cause: str = ""
    time_left: float | None = None

    def afresh(self) -> Margin:
        """Return the margin without its rows, but with the errors of foreseen demands."""
        return Margin(error=self.error, checks=self.checks)


def left_by(
    before: Margin, row: tuple[float, float, float, float], curve: OverSlip | None, options: WatchOptions = WATCH
) -> Margin:
    """Return the margin after one more row of `Margin.rows`, less its last column, by a curve of pull over slip."""
    t, slip, *_ = row
    last = float(before.rows[-1, 0]) if len(before.rows) else -math.inf
    if not 0.0 < t - last <= LONGEST_GAP:
        before, last = before.afresh()._replace(since=t, calm=t), t
    step, age = t - last, t - before.since
    rows = np.vstack([before.rows[before.rows[:, 0] > t - options.warning_time], (*row, math.nan)])
    x = rows[:, 0] - t
    weights = np.exp(x / np.array([[options.slow_memory], [options.fast_memory], [options.forgetting_time]]))
    (demand, _), _, (_, rise) = _lines(weights, x, rows[:, 3])
    rows[-1, 4] = demand + options.settling_time * rise
    error, checks = before.error, before.checks
    past = rows[x <= 0.5 * step - options.settling_time]
    if len(past) and age >= 2.0 * options.settling_time:
        error, checks = error + (demand - float(past[-1, 4])) ** 2, checks + 1
    now = Margin(rows, before.since, error, checks, calm=t)
    if curve is None or age < options.settling_time:
        return now
    slips, pulls, ahead, std = _known(curve)
    most = float(ahead[0])
    recent = x > 0.5 * step - options.scatter_lag
    if slip >= slips[-1] and x[recent][0] < -0.5 * options.scatter_lag:  # it has not just started
        return now._replace(cause=f"wheels slip by {100.0 * slip:.0f} %", time_left=0.0)
    if most <= 0.0:
        return now
    least = float(rows[recent, 3].min())
    if above_zero(least / (1.0 - options.form_error) - most, std) > options.takes_all:
        now = now._replace(cause="draft and slope take nearly all that the ground gives")
    reserve = ahead[np.searchsorted(slips, rows[:, 1], "right")] - np.interp(rows[:, 1], slips, pulls)
    known = rows[:, 1] >= slips[0]
    lately = x > -options.slow_memory
    if 2 * np.count_nonzero(known[lately]) <= np.count_nonzero(lately):
        return now

    capacity, weights = (rows[:, 2] + reserve)[known], weights[:2, known]
    limit = min(_lines(weights[:1], x[known], capacity)[0][0], most)
    works = age >= options.warning_time and demand > options.least_share * limit
    outgrows = math.inf
    if works and rise > 0.0 and checks:
        width = min(std, options.form_error * most)
        wrong = math.sqrt(error / checks) * options.warning_time / options.settling_time
        beyond = demand + options.warning_time * rise + width - limit
        if above_zero(beyond, math.hypot(wrong, width)) > options.outgrows:
            outgrows = max(limit - demand, 0.0) / rise
    terms = np.stack([np.ones_like(x), x, reserve, _rate(reserve, x)])[:, known]
    lasts = max(round(options.scatter_lag * (len(x) - 1) / -x[0]), 1)
    peak = float(np.convolve(rows[:, 3], np.full(lasts, 1.0 / lasts), "valid").max())
    weakens = _time_to_weaken(terms, weights, capacity, peak, options)
    now = now._replace(time_left=min(outgrows, weakens))
    if outgrows == math.inf and not weakens < options.warning_time:
        return now
    if t - before.calm < options.lasting - 0.5 * step:
        return now._replace(calm=before.calm)
    cause = f"draft and slope are to outgrow the ground in {outgrows:.0f} s"
    if weakens < options.warning_time:
        cause = f"the ground is to give less than is asked in {weakens:.0f} s"
    return now._replace(calm=before.calm, cause=cause)


def _lines(weights: Array, x: Array, y: Array) -> list[tuple[float, float]]:
    """Value at 0 and slope of the line through y (N,) at x for each row of weights (M, N)."""
    sums = weights @ np.stack([np.ones_like(x), x, x * x, y, x * y], axis=1)
    lines = []
    for count, of_x, of_xx, of_y, of_xy in sums.tolist():
        spread = count * of_xx - of_x**2
        slope = (count * of_xy - of_x * of_y) / spread if spread > 1e-9 * count**2 else 0.0
        lines.append(((of_y - slope * of_x) / count, slope))
    return lines


def _rate(y: Array, x: Array) -> Array:
    """Central differences (N,) of y over x, one-sided at the ends; 0 for a single value."""
    if len(x) < 2:
        return np.zeros_like(y)
    steps = np.concatenate([[0], np.arange(len(x)), [len(x) - 1]])
    before, after = steps[:-2], steps[2:]
    return np.asarray((y[after] - y[before]) / (x[after] - x[before]))


@lru_cache(maxsize=2)
def _known(curve: OverSlip) -> tuple[Array, Array, Array, float]:
    """Slips and pulls [N] where the curve is known, the greatest pull beyond each number of slips, and its sd."""
    known = np.isfinite(curve.pull)
    pull = curve.pull[known]
    ahead = np.append(np.maximum.accumulate(pull[::-1])[::-1], pull[-1:])
    return curve.slip[known], pull, ahead, float(curve.pull_std[int(np.nanargmax(curve.pull))])


def _time_to_weaken(terms: Array, weights: Array, capacity: Array, peak: float, options: WatchOptions) -> float:
    """Time [s] until c + b x + e R + d dR/dt falls to the peak [N] of demand without d; inf if not sure.

    terms (4, N): 1, x, R, dR/dt.  weights (2, N): of a slow and a fast trend.  capacity (N,) [N].  e: error of the
    reserve R; d [s]: how late the pull is beside the slip.
    """
    x, lag, n = terms[1], options.scatter_lag, len(capacity)
    scatter = 1.0
    for apart in (lag, 0.5 * lag):  # over half the lag too: a bounce at 2 Hz does not show in changes over 0.5 s
        first = int(np.searchsorted(x, x[0] + apart, "right"))
        change = capacity[first:] - capacity[np.searchsorted(x, x[first:] - apart - 1e-6)]
        if len(change) < 4:
            return math.inf
        scatter = max(scatter, float(change @ change) / len(change) / 2.0)
    variance = scatter * lag * (n - 1) / (x[-1] - x[0])  # rows with the same scatter
    prior = np.diag([0.0, 0.0, options.form_error**-2, options.lateness**-2])
    weighted = weights[:, None] * terms / variance
    covariance = np.linalg.inv(weighted @ terms.T + prior)
    left = math.inf
    for found, spread in zip(covariance @ (weighted @ capacity)[..., None], covariance, strict=True):
        now, slope = float(found[0, 0] + terms[2, -1] * found[2, 0]), float(found[1, 0])
        if slope < -options.significant_sd * math.sqrt(spread[1, 1]):
            left = min(left, max(now - peak, 0.0) / -slope)
    return left


def above_zero(mean: float, std: float) -> float:
    """Return the probability that a Gaussian with this mean and std is above zero."""
    return 0.5 * math.erfc(-mean / (max(std, 1e-9) * math.sqrt(2.0)))
