"""Signs of a stall in slip and speed alone, without a soil: trends that lead to a limit, while thrust holds.

    runs away      P(q + h dq/dt > -ln(1 - s_max)) > p        q = -ln(1 - s), widened by what it shakes
    is to stand    P(V + h dV/dt < 0) > p                     while slip grows or all motors are at their limits
    sinks          P(z + h dz/dt > z_max) > p                 z: of the deepest wheel

A cause counts only while a vehicle that has moved for some seconds loses speed under thrust: a start is no stall.
Wheels that a motor holds at their speed make slip run away; motors at their limit lose speed together with the vehicle.
A wheel that creeps or starts needs no case of its own: q has the variance (sd(V) / V)^2 + (sd(omega) / omega)^2.  Slip
that grows as the draft does is the draft's, not the ground's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from soilbus.config.model import Traversability
from soilbus.config.model import Warning as Settings
from soilbus.decision.moments import Sample
from soilbus.decision.options import WATCH, WatchOptions

LONGEST_GAP = 1.0
"""Silence [s] after which the trends start afresh."""
FIRST_RATE_STD = 1.0
"""Sd of a rate [1/s, m/s^2] before any sample: no vehicle brakes harder than it slides."""
SLOPE_WANDER = 0.03
"""How fast g sin(pitch) changes [m/s^2 per sqrt(s)]: by 1 % in 10 m, at 1 m/s."""


class LocalTrend(NamedTuple):
    """Kalman filter of a value and its rate [1/s], with their covariance; the rate is a random walk (Harvey 1989)."""

    value: float = 0.0
    rate: float = 0.0
    var: float = math.inf
    cov: float = 0.0
    rate_var: float = FIRST_RATE_STD**2

    def after(self, step: float, value: float, variance: float, wander: float) -> LocalTrend:
        """Return the trend after one more sample.

        step [s]: since the last call.  value, variance: nan where not known.  wander [1/s per sqrt(s)]: of the rate.
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

    def time_to(self, level: float) -> float:
        """Return the time [s] until the value rises to a level above zero, or falls to zero; inf where it does not."""
        way = level - self.value if level > 0.0 else self.value
        rate = self.rate if level > 0.0 else -self.rate
        return max(way, 0.0) / rate if rate > 0.0 else math.inf


class Stall(NamedTuple):
    """Signs of a stall; `stalling` makes the next one.

    t, heard, since [s]: of the last sample, of the last one with a slip, and of the first one since which the vehicle
    moves.  slip, speed, steady, depth: trends of the log speed ratio [1], of the ground speed [m/s] freely and with an
    acceleration that changes slowly (what a bump takes, it gives back), and of the sinkage [m].  shake: mean square of
    what the log speed ratio differed from its trend.  felt, climb [m/s]: integral of the specific force, and trend of
    the ground speed less that.  thrust, draft: as shares of the weight, low-pass filtered.  caused [s]: when a stall
    was last seen ahead; ahead: whether that is no longer ago than `hold`; settled: whether the vehicle has moved for
    `settling_time`; time_left [s]: until slip or sinkage passes its limit or the vehicle stands, None without a cause.
    """

    t: float = -math.inf
    heard: float = -math.inf
    since: float = math.inf
    slip: LocalTrend = LocalTrend()
    speed: LocalTrend = LocalTrend()
    steady: LocalTrend = LocalTrend()
    depth: LocalTrend = LocalTrend()
    shake: float = 0.0
    felt: float = 0.0
    climb: LocalTrend = LocalTrend()
    thrust: float = math.nan
    draft: float = math.nan
    caused: float = -math.inf
    ahead: bool = False
    settled: bool = False
    time_left: float | None = None

    @property
    def gains_speed(self) -> bool:
        """Whether the ground speed rises, at a standstill by more than its rate's sd."""
        least = 0.0 if self.settled else math.sqrt(self.speed.rate_var)
        return self.speed.rate > least

    @property
    def slope(self) -> float:
        """g sin(pitch) [m/s^2] where only a specific force shows it, else 0."""
        return -self.climb.rate


def stalling(
    before: Stall, sample: Sample, min_speed: float, settings: Settings, limits: Traversability,
    options: WatchOptions = WATCH,
) -> Stall:  # fmt: skip
    """Return the signs of a stall after one more sample; samples in their order, at any rate.

    The trends start afresh after LONGEST_GAP or when time goes back.  sample: one of the time of the last is the same
    bin, seen again.  min_speed [m/s]: of wheels and vehicle, below which there is no slip.
    """
    step = sample.t - before.t
    if step == 0.0:
        return before
    if not 0.0 <= step <= LONGEST_GAP:
        before, step = Stall(sample.t), 0.0
    ground = sample.ground + sample.beside
    moves = ground > min_speed and sample.rim > min_speed  # nor nan
    ratio = ratio_var = math.nan
    shake = before.shake
    if moves:
        ratio = math.log(sample.rim / ground)
        ratio_var = sample.ground_var / ground**2 + sample.rim_var / sample.rim**2 + settings.slip_noise**2
        if math.isfinite(before.slip.var):
            off = (ratio - before.slip.value - step * before.slip.rate) ** 2
            shake = smoothed(shake, off, step, options.forgetting_time)
    slip = before.slip.after(step, ratio, ratio_var + shake, settings.slip_wander)
    speed = before.speed.after(step, sample.ground, sample.ground_var, settings.speed_wander)
    steady = before.steady.after(step, sample.ground, sample.ground_var, settings.steady_wander)
    depth = before.depth.after(step, sample.depth, sample.depth_var, settings.depth_wander)
    felt, climb = 0.0, LocalTrend()
    if math.isfinite(sample.felt):
        felt = before.felt + step * sample.felt
        climb = before.climb.after(step, sample.ground - felt, sample.ground_var, SLOPE_WANDER)
    thrust = smoothed(before.thrust, sample.thrust, step, settings.thrust_time)
    draft = smoothed(before.draft, sample.draft, step, settings.thrust_time)

    stands_now = ground <= min_speed or sample.rim <= min_speed  # nor nan: what is not known stays as it was
    since = math.inf if stands_now else min(before.since, sample.t if moves else math.inf)
    settled = sample.t - since >= settings.settling_time
    loses_speed = speed.rate < 0.0 and math.isfinite(speed.var)
    limit = -math.log(1.0 - limits.max_slip)
    runs_away = slip.probability_above(limit, settings.slip_horizon) > settings.probability
    sinks = depth.probability_above(limits.max_sinkage, settings.slip_horizon) > settings.probability
    moves_on = min(
        speed.probability_above(0.0, settings.stop_horizon), steady.probability_above(0.0, settings.steady_horizon)
    )
    holds = sample.thrust > settings.thrust_held * thrust
    grows = slip.rate > -math.sqrt(slip.rate_var) and slip.value > -math.log(1.0 - settings.least_slip)
    stands = 1.0 - moves_on > settings.probability and ((holds and grows) or sample.at_limit)
    pulls_more = sample.draft > draft + options.draft_rise
    pushes = sample.thrust > settings.least_thrust
    caused = moves and settled and pushes and loses_speed and (sinks or (not pulls_more and (runs_away or stands)))
    heard, last = sample.t if moves else before.heard, sample.t if caused else before.caused
    ahead = sample.t - last < settings.hold
    left = min(slip.time_to(limit), depth.time_to(limits.max_sinkage), speed.time_to(0.0)) if ahead else None
    trends = slip, speed, steady, depth, shake, felt, climb
    return Stall(sample.t, heard, since, *trends, thrust, draft, last, ahead, settled, left)


def smoothed(mean: float, value: float, step: float, time: float) -> float:
    """Return a low-pass filtered mean after one more value; the value where there is no mean, nan where it is nan."""
    return mean + (value - mean) * (1.0 - math.exp(-step / time)) if math.isfinite(mean) else value
