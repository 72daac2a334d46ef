"""What the ground has left beyond what is asked of it, by the curve of pull over slip, and for how long.

    weakens        C = P + max P_hat(s' > s) - P_hat(s) falls to the demand Q, beyond what a wrong curve explains
    outgrows       P(Q + h dQ/dt > C) > p, by the errors of earlier such extrapolations and the curve's width
    takes all      Q > (1 - e) max P_hat, e: how wrong the curve may be, or s > s_max

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
    demand, _ = _line(x, rows[:, 3], options.slow_memory)
    _, rise = _line(x, rows[:, 3], options.forgetting_time)
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
    if slip >= slips[-1]:
        return now._replace(cause=f"wheels slip by {100.0 * slip:.0f} %", time_left=0.0)
    if most <= 0.0:
        return now
    compares = std < options.unknown * most
    if compares and float(rows[x > 0.5 * step - options.scatter_lag, 3].min()) > (1.0 - options.form_error) * most:
        now = now._replace(cause="draft and slope take nearly all that the ground gives")
    reserve = ahead[np.searchsorted(slips, rows[:, 1], "right")] - np.interp(rows[:, 1], slips, pulls)
    capacity = np.where(rows[:, 1] >= slips[0], rows[:, 2] + reserve, np.nan)
    lately = x > -options.slow_memory
    if 2 * np.count_nonzero(np.isfinite(capacity[lately])) <= np.count_nonzero(lately):
        return now

    limit = min(_line(x, capacity, options.slow_memory)[0], most)
    works = compares and age >= options.warning_time and demand > options.least_share * limit
    outgrows = math.inf
    if works and rise > 0.0 and checks:
        width = min(std, options.form_error * most)
        spare = limit - width - demand - options.warning_time * rise
        wrong = math.sqrt(error / checks) * options.warning_time / options.settling_time
        if 0.5 * math.erfc(spare / (math.sqrt(2.0) * math.hypot(wrong, width, 1e-9))) > options.outgrows:
            outgrows = max(limit - demand, 0.0) / rise
    weakens = _time_to_weaken(x, capacity, reserve, float(rows[:, 3].max()), options)
    now = now._replace(time_left=min(outgrows, weakens))
    if outgrows == math.inf and not weakens < options.warning_time:
        return now
    if t - before.calm < options.lasting - 0.5 * step:
        return now._replace(calm=before.calm)
    cause = f"draft and slope are to outgrow the ground in {outgrows:.0f} s"
    if weakens < options.warning_time:
        cause = f"the ground is to give less than is asked in {weakens:.0f} s"
    return now._replace(calm=before.calm, cause=cause)


def _line(x: Array, y: Array, memory: float) -> tuple[float, float]:
    """Value now and slope of the line through values (N,), nan where not known, at times x [s] from now."""
    known = np.isfinite(y)
    x, y = x[known], y[known]
    if not len(x):
        return math.nan, 0.0
    weight = np.exp(x / memory)
    weight /= weight.sum()
    t, mean = float(weight @ x), float(weight @ y)
    spread = float(weight @ (x - t) ** 2)
    slope = float((weight * (x - t)) @ y) / spread if spread > 1e-9 else 0.0
    return mean - slope * t, slope


@lru_cache(maxsize=2)
def _known(curve: OverSlip) -> tuple[Array, Array, Array, float]:
    """Slips and pulls [N] where the curve is known, the greatest pull beyond each number of slips, and its sd."""
    known = np.isfinite(curve.pull)
    pull = curve.pull[known]
    ahead = np.append(np.maximum.accumulate(pull[::-1])[::-1], pull[-1:])
    return curve.slip[known], pull, ahead, float(curve.pull_std[int(np.nanargmax(curve.pull))])


def _time_to_weaken(x: Array, capacity: Array, reserve: Array, peak: float, options: WatchOptions) -> float:
    """Time [s] until c + b x + e R + d dR/dt falls to the peak [N] of demand without d; inf if not sure.

    e: error of the reserve R; d [s]: how late the pull is beside the slip.
    """
    if len(x) < 4:
        return math.inf
    moves, known = np.gradient(reserve, x), np.isfinite(capacity)
    x, capacity, reserve, moves = x[known], capacity[known], reserve[known], moves[known]
    lag = options.scatter_lag
    changes = [
        (capacity - capacity[np.searchsorted(x, x - apart - 1e-6)])[x > x[0] + apart] for apart in (0.5 * lag, lag)
    ]
    if len(changes[-1]) < 4:
        return math.inf
    like = lag * (len(x) - 1) / (x[-1] - x[0])  # rows with the same scatter
    # over half the lag too: a bounce at 2 Hz does not show in changes over 0.5 s
    scatter = max(float(change @ change) / len(change) / 2.0 for change in changes)
    variance = max(scatter, 1.0) * like
    columns = np.stack([np.ones_like(x), x, reserve, moves])
    prior = np.diag([0.0, 0.0, options.form_error**-2, options.lateness**-2])
    left = math.inf
    for memory in (options.slow_memory, options.fast_memory):
        weighted = columns * np.exp(x / memory)
        covariance = np.linalg.inv(weighted @ columns.T / variance + prior)
        now, slope, error, _ = (covariance @ (weighted @ capacity) / variance).tolist()
        if slope < -options.significant_sd * math.sqrt(covariance[1, 1]):
            left = min(left, max(now + error * float(reserve[-1]) - peak, 0.0) / -slope)
    return left
