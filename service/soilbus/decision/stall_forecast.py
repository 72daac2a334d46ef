"""Immobilisation ahead without any soil: the trends of slip and ground speed, extrapolated by a Kalman filter.

    q = ln(r omega / V) = -ln(1 - s)         log speed ratio of the driven wheels: grows without bound towards a stall
    x = (value, rate)                        of q, of V, and of the sinkage z
    x_k+1 = [1 dt; 0 1] x_k + noise          local linear trend; the rate is a random walk of intensity w
    P(q + h_s dq/dt > -ln(1 - s_max)) > p    slip passes its limit within the horizon h_s
    P(V + h_v dV/dt < 0) > p                 or the vehicle stands within h_v, while thrust holds and wheels slip more,
                                             or all motors are at their limit; by a trend that follows each change
                                             of its acceleration, or over a longer time by a steadier one
    P(z + h_s dz/dt > z_max) > p             or the deepest wheel passes the sinkage limit, where sinkage is measured
    d/dt (V - integral of f) = -g sin(pitch) the slope, where the specific force f is measured and the pitch is not

Each counts only while a vehicle that has moved for some seconds loses speed under thrust: a start is no stall, and one
in vain is seen by `traction_loss`.  A stall shows in both: wheels that a motor holds at their speed, with
torque left, make slip run away; motors at their limit lose speed together with the vehicle.  In q, a wheel that creeps,
starts, or turns on a curve needs no case of its own: what the sensors cannot know there is in the variance of q,
(sd(V) / V)^2 + (sd(omega) / omega)^2, and V is the mean ground speed of the very wheels whose speed is known.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from soilbus.config.model import Traversability
from soilbus.config.model import Warning as Settings

__all__ = ["LocalTrend", "Sample", "StallForecast", "forecast"]

LONGEST_GAP = 1.0
"""Silence [s] after which the trends start afresh."""
FIRST_RATE_STD = 1.0
"""Sd of a rate [1/s, m/s^2] before any sample: no vehicle brakes harder than it slides."""
SLOPE_WANDER = 0.03
"""How fast g sin(pitch) changes [m/s^2 per sqrt(s)]: by 1 % in 10 m, at 1 m/s."""


class LocalTrend(NamedTuple):
    """Kalman filter of a value and its rate [1/s], with their covariance."""

    value: float = 0.0
    rate: float = 0.0
    var: float = math.inf
    cov: float = 0.0
    rate_var: float = FIRST_RATE_STD**2

    def after(self, step: float, value: float, variance: float, wander: float) -> LocalTrend:
        """The trend after one more sample.

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
        """Probability that the value passes a level within a time [s]; 0 before any sample."""
        if math.isinf(self.var):
            return 0.0
        var = self.var + horizon * (2.0 * self.cov + horizon * self.rate_var)
        return 0.5 * math.erfc((level - self.value - horizon * self.rate) / math.sqrt(2.0 * var))


class Sample(NamedTuple):
    """One bin; nan where not known.

    Attributes
    ----------
    t
        [s].
    ground, ground_var
        [m/s], ground speed of the vehicle's middle, and its variance.
    rim, rim_var
        [m/s], mean rim speed of the driven wheels whose speed is known, and its variance.
    thrust
        Sum of torque over radius, as a share of the weight.
    beside
        [m/s], mean ground speed of those wheels less that of the middle: not zero on a curve with a side missing.
    at_limit
        Every motor whose limit is known is at its limit, and at least one limit is known.
    depth, depth_var
        [m], sinkage of the deepest wheel, and its variance.
    felt
        [m/s^2], dv/dt + g sin(pitch), where a specific force is measured and the pitch is not.
    """

    t: float
    ground: float
    ground_var: float
    rim: float
    rim_var: float
    thrust: float
    beside: float = 0.0
    at_limit: bool = False
    depth: float = math.nan
    depth_var: float = math.nan
    felt: float = math.nan


class StallForecast(NamedTuple):
    """State carried from one sample to the next by `forecast`.

    Attributes
    ----------
    t, heard, since
        [s], of the last sample, of the last one with a slip, and of the first one since which the vehicle moves.
    slip, speed, depth
        Trends of the log speed ratio [1], of the ground speed [m/s] and of the sinkage [m].
    steady
        Trend of the ground speed [m/s] whose acceleration changes slowly: what a bump takes, it gives back.
    felt, climb
        [m/s], integral of the specific force, and trend of the ground speed less that.
    thrust
        As a share of the weight, low-pass filtered.
    caused
        [s], when a stall was last seen ahead.
    stalls
        Whether that is no longer ago than `hold`.
    settled
        Whether the vehicle has moved for `settling_time`.
    time_left
        [s] until slip passes its limit or the vehicle stands, whichever is first; None where nothing is ahead.
    """

    t: float = -math.inf
    heard: float = -math.inf
    since: float = math.inf
    slip: LocalTrend = LocalTrend()
    speed: LocalTrend = LocalTrend()
    depth: LocalTrend = LocalTrend()
    steady: LocalTrend = LocalTrend()
    felt: float = 0.0
    climb: LocalTrend = LocalTrend()
    thrust: float = math.nan
    caused: float = -math.inf
    stalls: bool = False
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


def forecast(
    before: StallForecast, sample: Sample, min_speed: float, settings: Settings, limits: Traversability
) -> StallForecast:
    """The forecast after one more sample; samples in their order, at any rate.

    Parameters
    ----------
    before
        After the sample before; the trends start afresh after LONGEST_GAP or when time goes back.
    sample
        The wheels and the vehicle now; one of the time of the last is the same bin, seen again.
    min_speed
        [m/s], speeds of wheels and vehicle below which there is no slip.
    settings, limits
        Horizons, probability, noise; `max_slip` and `max_sinkage`.
    """
    step = sample.t - before.t
    if step == 0.0:
        return before
    if not 0.0 <= step <= LONGEST_GAP:
        before, step = StallForecast(sample.t), 0.0
    ground = sample.ground + sample.beside
    moves = ground > min_speed and sample.rim > min_speed  # nor nan
    ratio = math.log(sample.rim / ground) if moves else math.nan
    ratio_var = math.nan
    if moves:
        ratio_var = sample.ground_var / ground**2 + sample.rim_var / sample.rim**2 + settings.slip_noise**2
    slip = before.slip.after(step, ratio, ratio_var, settings.slip_wander)
    speed = before.speed.after(step, sample.ground, sample.ground_var, settings.speed_wander)
    steady = before.steady.after(step, sample.ground, sample.ground_var, settings.steady_wander)
    depth = before.depth.after(step, sample.depth, sample.depth_var, settings.depth_wander)
    felt, climb = 0.0, LocalTrend()
    if math.isfinite(sample.felt):
        felt = before.felt + step * sample.felt
        climb = before.climb.after(step, sample.ground - felt, sample.ground_var, SLOPE_WANDER)
    thrust = sample.thrust
    mean = before.thrust
    if math.isfinite(thrust):
        mean = thrust if math.isnan(mean) else mean + (thrust - mean) * (1.0 - math.exp(-step / settings.thrust_time))
    pushes = thrust > settings.least_thrust
    holds = thrust > settings.thrust_held * mean
    limit = -math.log(1.0 - limits.max_slip)
    runs_away = slip.probability_above(limit, settings.slip_horizon) > settings.probability
    slips = holds and slip.rate > 0.0 and slip.value > -math.log(1.0 - settings.least_slip)
    moves_on = (
        speed.probability_above(0.0, settings.stop_horizon),
        steady.probability_above(0.0, settings.steady_horizon),
    )
    stops = 1.0 - min(moves_on) > settings.probability
    stands = stops and (slips or sample.at_limit)
    stands_now = ground <= min_speed or sample.rim <= min_speed  # nor nan: what is not known stays as it was
    since = math.inf if stands_now else min(before.since, sample.t if moves else math.inf)
    settled = sample.t - since >= settings.settling_time
    loses_speed = speed.rate < 0.0 and math.isfinite(speed.var)
    sinks = depth.probability_above(limits.max_sinkage, settings.slip_horizon) > settings.probability
    ahead = moves and settled and pushes and loses_speed and (sinks or runs_away or stands)
    heard, caused = sample.t if moves else before.heard, sample.t if ahead else before.caused
    stalls = sample.t - caused < settings.hold
    return StallForecast(
        sample.t,
        heard,
        since,
        slip,
        speed,
        depth,
        steady,
        felt,
        climb,
        mean,
        caused,
        stalls,
        settled,
        _time_left(slip, speed, depth, limit, limits.max_sinkage) if stalls else None,
    )


def _time_left(slip: LocalTrend, speed: LocalTrend, depth: LocalTrend, max_ratio: float, max_depth: float) -> float:
    """Time [s] until slip or sinkage passes its limit, or the vehicle stands, by the trends."""
    to_limit = max(max_ratio - slip.value, 0.0) / slip.rate if slip.rate > 0.0 else math.inf
    to_stand = max(speed.value, 0.0) / -speed.rate if speed.rate < 0.0 else math.inf
    to_depth = max(max_depth - depth.value, 0.0) / depth.rate if depth.rate > 0.0 else math.inf
    return min(to_limit, to_stand, to_depth)
