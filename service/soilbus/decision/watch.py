"""The watch for immobilisation: one state machine, ten times a second, that says what it sees and warns.

    spins          v_s > max(v_min, s_max r omega)                   a wheel; no loss while others grip with torque left
    stalls         V < v_min, no wheel turns, and thrust exceeds what draft, slope and inertia ask, or all motors are
                   at their limits
    stops          P(q + h dq/dt > -ln(1 - s_max)) or P(V + h dV/dt < 0) > p while thrust holds, q = -ln(1 - s)
    weakens        C = P + max P_hat(s' > s) - P_hat(s) falls to the demand Q, beyond what a wrong curve explains
    outgrows       P(Q + h dQ/dt > C) > p, by the errors of earlier such extrapolations and the curve's width
    takes all      Q > 0.9 max P_hat, or s > s_max

P: pull given, P_hat: pull over slip of the last window (Kalman filter and regressions with exponential forgetting).
The first three need no soil: a local linear trend follows q, V and sinkage, and slip that shakes widens
it.  The others need the curve and some seconds of moments.  The moments are kept and seen along the newest curve: so a
new window is no new ground.  Slip that grows as the draft does is the draft's, not the ground's.  Without a ground
speed `stops` reckons one from acceleration and wheels, dV/dt = a + (r omega - V) / tau: it warns, but clears nothing.

Spinning or stalling for `spin_time` overrules a go of the estimate; without any way for `stuck_time` the vehicle is
stuck, until it has moved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Config, Traversability
from soilbus.config.model import Warning as Settings
from soilbus.decision.moments import Moment, Sample
from soilbus.decision.options import WATCH, WatchOptions
from soilbus.decision.trends import Extrapolation, Line, LocalTrend
from soilbus.estimation.assembly import DIFFERENTIAL_BIAS

if TYPE_CHECKING:
    from soilbus.decision.capability import OverSlip

__all__ = ["Alert", "Margin", "Stall", "Warnings", "Watch", "ended", "seen_at", "stalling", "watched"]

LONGEST_GAP = 1.0
"""Silence [s] after which the trends start afresh."""
SLOPE_WANDER = 0.03
"""How fast g sin(pitch) changes [m/s^2 per sqrt(s)]: by 1 % in 10 m, at 1 m/s."""


class Alert(StrEnum):
    """Warning of immobilisation."""

    UNKNOWN = "unknown"
    NONE = "none"
    IMMOBILISATION = "immobilisation"


class Stall(NamedTuple):
    """Signs of a stall in slip and speed alone; `stalling` makes the next one.

    Attributes
    ----------
    t, heard, since
        [s], of the last sample, of the last one with a slip, and of the first one since which the vehicle moves.
    slip, speed, depth
        Trends of the log speed ratio [1], of the ground speed [m/s] and of the sinkage [m].
    steady
        Trend of the ground speed [m/s] whose acceleration changes slowly: what a bump takes, it gives back.
    shake
        Mean square of what the log speed ratio differed from its trend.
    felt, climb
        [m/s], integral of the specific force, and trend of the ground speed less that.
    thrust, draft
        As a share of the weight, low-pass filtered.
    caused, ahead
        [s], when a stall was last seen ahead; whether that is no longer ago than `hold`.
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
    options
        Tuning values.

    Notes
    -----
    A cause counts only while a vehicle that has moved for some seconds loses speed under thrust: a start is no stall.
    A stall shows in both: wheels that a motor holds at their speed make slip run away; motors at their limit lose speed
    together with the vehicle.  In q a wheel that creeps, starts, or turns on a curve needs no case of its own: what the
    sensors cannot know there is in its variance (sd(V) / V)^2 + (sd(omega) / omega)^2.
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
            kept = math.exp(-step / options.shake_memory)
            shake = kept * shake + (1.0 - kept) * off
    slip = before.slip.after(step, ratio, ratio_var + shake, settings.slip_wander)
    speed = before.speed.after(step, sample.ground, sample.ground_var, settings.speed_wander)
    steady = before.steady.after(step, sample.ground, sample.ground_var, settings.steady_wander)
    depth = before.depth.after(step, sample.depth, sample.depth_var, settings.depth_wander)
    felt, climb = 0.0, LocalTrend()
    if math.isfinite(sample.felt):
        felt = before.felt + step * sample.felt
        climb = before.climb.after(step, sample.ground - felt, sample.ground_var, SLOPE_WANDER)
    thrust, draft = (
        _smoothed(mean, value, step, settings.thrust_time)
        for mean, value in ((before.thrust, sample.thrust), (before.draft, sample.draft))
    )
    pushes = sample.thrust > settings.least_thrust
    holds = sample.thrust > settings.thrust_held * thrust
    rises = sample.draft > draft + options.draft_rise
    limit = -math.log(1.0 - limits.max_slip)
    runs_away = slip.probability_above(limit, settings.slip_horizon) > settings.probability
    grows = slip.rate > -math.sqrt(slip.rate_var)
    slips = holds and grows and slip.value > -math.log(1.0 - settings.least_slip)
    moves_on = (
        speed.probability_above(0.0, settings.stop_horizon),
        steady.probability_above(0.0, settings.steady_horizon),
    )
    stands = 1.0 - min(moves_on) > settings.probability and (slips or sample.at_limit)
    stands_now = ground <= min_speed or sample.rim <= min_speed  # nor nan: what is not known stays as it was
    since = math.inf if stands_now else min(before.since, sample.t if moves else math.inf)
    settled = sample.t - since >= settings.settling_time
    loses_speed = speed.rate < 0.0 and math.isfinite(speed.var)
    sinks = depth.probability_above(limits.max_sinkage, settings.slip_horizon) > settings.probability
    caused = moves and settled and pushes and loses_speed and (sinks or (not rises and (runs_away or stands)))
    heard, last = sample.t if moves else before.heard, sample.t if caused else before.caused
    ahead = sample.t - last < settings.hold
    left = min(_time_to(slip, limit), _time_to(depth, limits.max_sinkage), _time_to(speed, 0.0)) if ahead else None
    trends = slip, speed, depth, steady, shake, felt, climb
    return Stall(sample.t, heard, since, *trends, thrust, draft, last, ahead, settled, left)


def _smoothed(mean: float, value: float, step: float, time: float) -> float:
    """Low-pass filtered mean after one more value, nan where not known."""
    if not math.isfinite(value):
        return mean
    return value if math.isnan(mean) else mean + (value - mean) * (1.0 - math.exp(-step / time))


def _time_to(trend: LocalTrend, level: float) -> float:
    """Time [s] until a trend that leads to a level reaches it."""
    if level > 0.0:
        return max(level - trend.value, 0.0) / trend.rate if trend.rate > 0.0 else math.inf
    return max(trend.value, 0.0) / -trend.rate if trend.rate < 0.0 else math.inf


class Margin(NamedTuple):
    """Share of the ground's capacity that is left, by the curve of pull over slip; `left_by` makes the next one.

    Attributes
    ----------
    rows
        (N, 4): time [s], common slip, pull given [N], demand of draft and slope [N] of the last moments.
    since
        [s], of the first moment without a gap.
    demand
        Line through the demand [N].
    lasts
        [s], for how long the demand has outgrown the ground, and the ground weakened.
    cause
        What is seen now; empty for nothing.
    time_left
        [s] until the capacity falls to the demand, inf where it does not; None where it is not known.
    """

    rows: Array = np.empty((0, 4))
    since: float = math.inf
    demand: Extrapolation = Extrapolation()
    lasts: tuple[float, ...] = (0.0, 0.0)
    cause: str = ""
    time_left: float | None = None


def left_by(
    before: Margin, row: tuple[float, float, float, float], curve: OverSlip | None, options: WatchOptions = WATCH
) -> Margin:
    """Return the margin after one more row of `Margin.rows`, by a curve of pull over slip."""
    t, slip, *_ = row
    last = float(before.rows[-1, 0]) if len(before.rows) else -math.inf
    if not 0.0 < t - last <= LONGEST_GAP:
        before = Margin(since=t)
    step = t - last if len(before.rows) else 0.0
    rows = np.vstack([before.rows[before.rows[:, 0] > t - options.memory], row])
    x, age = rows[:, 0] - t, t - before.since
    demand = before.demand.after(t, step, Line.through(x, rows[:, 3], options.slow_memory), age, options)
    now = Margin(rows, before.since, demand)
    if curve is None or age < options.settling_time:
        return now
    slips, pulls, ahead = _known_pulls(curve)
    most, std = float(ahead[0]), _std_of_most(curve)
    if slip >= slips[-1]:
        return now._replace(cause=f"wheels slip by {100.0 * slip:.0f} %", time_left=0.0)
    if most <= 0.0:
        return now
    compares = std < options.unknown * most
    within = rows[:, 1]
    if compares and float(rows[x > -options.lasting - 0.5 * step, 3].min()) > options.near * most:
        now = now._replace(cause="draft and slope take nearly all that the ground gives")
    reserve = ahead[np.searchsorted(slips, within, "right")] - np.interp(within, slips, pulls)
    capacity = np.where(within >= slips[0], rows[:, 2] + reserve, np.nan)
    lately = x > -options.slow_memory
    if 2 * np.count_nonzero(np.isfinite(capacity[lately])) <= np.count_nonzero(lately):
        return now
    limit = min(Line.through(x, capacity, options.slow_memory).value, most)
    width = min(std, options.widest * most)
    works = compares and age >= options.memory and demand.line.value > options.least_share * limit
    leads = works and demand.probability_above(limit - width, width, options) > options.outgrows
    left = demand.time_to(limit) if leads else math.inf
    lasts = [so_far + step for so_far in before.lasts]
    now = _seen(now, 0, lasts[0] if leads else 0.0, left, "draft and slope are to outgrow the ground", options.lasting)
    left = _time_to_weaken(x, capacity, reserve, float(rows[:, 3].max()), options)
    weakens = left < options.warning_time
    cause = "the ground is to give less than is asked"
    now = _seen(now, 1, lasts[1] if weakens else 0.0, left, cause, options.lasting_fall)
    return now._replace(time_left=math.inf if now.time_left is None else now.time_left)


def _seen(now: Margin, place: int, lasts: float, left: float, cause: str, least: float) -> Margin:
    """Return the margin with a cause that has lasted for some time [s], and the time [s] that it leaves; inf: none."""
    now = now._replace(lasts=(*now.lasts[:place], lasts, *now.lasts[place + 1 :]))
    if math.isfinite(left):
        now = now._replace(time_left=left if now.time_left is None else min(left, now.time_left))
    return now._replace(cause=f"{cause} in {left:.0f} s") if lasts >= least else now


@lru_cache(maxsize=2)
def _known_pulls(curve: OverSlip) -> tuple[Array, Array, Array]:
    """Return slips and pulls [N] where the curve is known, and the greatest pull beyond each number of these slips."""
    known = np.isfinite(curve.pull)
    pull = curve.pull[known]
    return curve.slip[known], pull, np.append(np.maximum.accumulate(pull[::-1])[::-1], pull[-1:])


@lru_cache(maxsize=2)
def _std_of_most(curve: OverSlip) -> float:
    """Sd [N] of the curve's largest pull."""
    return float(curve.pull_std[int(np.nanargmax(curve.pull))])


def _time_to_weaken(x: Array, capacity: Array, reserve: Array, peak: float, options: WatchOptions) -> float:
    """Return the time [s] until the capacity falls to the greatest demand [N]; inf where it does not surely fall.

    Notes
    -----
    C = c + b x + e R: where the curve's reserve R is wrong by a share e of sd `form_error`, the capacity follows slip.
    """
    known = np.isfinite(capacity)
    x, capacity, reserve = x[known], capacity[known], reserve[known]
    before = capacity[np.searchsorted(x, x - options.scatter_lag - 1e-6)]
    changes = (capacity - before)[x > x[0] + options.scatter_lag]
    if len(changes) < 4:
        return math.inf
    like = options.scatter_lag * (len(x) - 1) / (x[-1] - x[0])  # rows with the same scatter
    variance = max(float(changes @ changes) / len(changes) / 2.0, 1.0) * like
    columns, prior = np.stack([np.ones_like(x), x, reserve]), np.diag([0.0, 0.0, options.form_error**-2])
    left = math.inf
    for memory in (options.slow_memory, options.fast_memory):
        weighted = columns * np.exp(x / memory)
        covariance = np.linalg.inv(weighted @ columns.T / variance + prior)
        now, slope, error = (covariance @ (weighted @ capacity) / variance).tolist()
        if slope < -options.significant_sd * math.sqrt(covariance[1, 1]):
            left = min(left, max(now + error * float(reserve[-1]) - peak, 0.0) / -slope)
    return left


class Watch(NamedTuple):
    """State of the watch; `watched` makes the next one.  All times in s.

    Attributes
    ----------
    t
        The last moment.
    spins, sticks, moves
        Since when a wheel spins or the vehicle stalls; it does not move under thrust; it moves without spinning.  inf
        where it does not.
    spinning, slides, stuck
        Spinning or stalling has lasted for `spin_time`; so has spinning of half of the wheels or without any way; the
        vehicle is stuck and has not moved since.
    last
        The last moment that was spinning or stuck: older data do not describe the ground under the wheels.
    slip, pull
        Slip, and pull [N], low-pass filtered with the time constant `spin_time`; nan where not known.
    engaged
        Which wheels drive.
    reckoned, measured
        [m/s], ground speed, from acceleration and wheels where it is not measured, nan where neither is; when it was
        measured last.
    stall, margin
        What slip and speed say, and what the curve leaves.
    caused
        When the curve last gave a cause.
    warning, cause, time_left
        The output: the warning, what is seen, and the time [s] that is left, None where it is not known.
    is_caused
        Whether the warning has a cause no older than `warning.hold`; else it only lasts, until a decision is go.
    """

    t: float = -math.inf
    spins: float = math.inf
    sticks: float = math.inf
    moves: float = math.inf
    spinning: bool = False
    slides: bool = False
    stuck: bool = False
    last: float = -math.inf
    slip: float = math.nan
    pull: float = math.nan
    engaged: tuple[bool, ...] = ()
    reckoned: float = math.nan
    measured: float = -math.inf
    stall: Stall = Stall()
    margin: Margin = Margin()
    caused: float = -math.inf
    warning: Alert = Alert.UNKNOWN
    cause: str = ""
    time_left: float | None = None
    is_caused: bool = False


def watched(
    before: Watch, moment: Moment, curve: OverSlip | None, config: Config, options: WatchOptions = WATCH
) -> Watch:
    """Return the watch after one more moment; moments in their order, at any rate.

    Parameters
    ----------
    before
        The watch after the moment before; its trends start afresh after LONGEST_GAP, or when time goes back.
    moment
        The wheels and the vehicle now.
    curve
        Pull over slip of the last window that had one.
    config
        `min_speed` [m/s], above which the vehicle moves; limits and times of `traversability` and `warning`.
    options
        Tuning values.
    """
    limits, stall, reckoned, measured = config.traversability, before.stall, math.nan, before.measured
    if (sample := moment.last) is not None:
        reckoned = _reckoned(before, moment, sample, options)
        if blind := math.isnan(sample.ground):
            sample = sample._replace(ground=reckoned, ground_var=sample.rim_var)
        elif not sample.t - measured <= LONGEST_GAP:  # what was reckoned so long is no trend
            stall = Stall()
        stall = stalling(stall, sample, config.estimator.min_speed, config.warning, limits, options)
        if blind:  # what is reckoned is no all-clear
            stall = stall._replace(heard=before.stall.heard)
        else:
            measured = sample.t
    now, margin = _moved(before, moment, config), before.margin
    now = now._replace(stall=stall, engaged=moment.engaged, reckoned=reckoned, measured=measured)
    if moment.engaged != before.engaged:  # another drive has another curve
        margin = Margin()
    if math.isfinite(moment.common + moment.given):
        asked = moment.given - moment.inertia + moment.mass * stall.slope
        if not len(margin.rows) or moment.t != margin.rows[-1, 0]:
            margin = left_by(margin, (moment.t, moment.common, moment.given, asked), curve, options)
    elif len(margin.rows) and not 0.0 <= moment.t - float(margin.rows[-1, 0]) <= LONGEST_GAP:
        margin = Margin()
    fresh = before.caused if 0.0 <= moment.t - before.caused < options.hold else -math.inf
    return seen_at(now._replace(margin=margin, caused=moment.t if margin.cause else fresh), moment.t, config)


def seen_at(watch: Watch, now: float, config: Config, options: WatchOptions = WATCH) -> Watch:
    """Return the watch as reported at `now` [s]; without slip for LONGEST_GAP its warning is unknown."""
    stall, margin = watch.stall, watch.margin
    acts = ""
    if watch.slides and not stall.gains_speed:
        acts = "half of the wheels spin"
    if stall.ahead:
        acts = "slip runs away, or the vehicle is to stand"
    if watch.stuck:
        acts = "the vehicle is stuck"
    since = now - watch.caused
    if not acts and not since < options.hold:
        known = now - stall.heard <= LONGEST_GAP
        return watch._replace(
            warning=Alert.NONE if known else Alert.UNKNOWN, cause="", time_left=margin.time_left, is_caused=False
        )
    left = [time for time in (margin.time_left, stall.time_left) if time is not None]
    return watch._replace(
        warning=Alert.IMMOBILISATION,
        cause=acts or margin.cause or watch.cause,
        time_left=0.0 if watch.stuck else min(left, default=None),
        is_caused=bool(acts) or since < config.warning.hold,
    )


def ended(watch: Watch, config: Config) -> Watch:
    """Return the watch once a decision is go: a warning without a cause ends."""
    return seen_at(watch._replace(caused=-math.inf), watch.t, config)


def _moved(before: Watch, moment: Moment, config: Config) -> Watch:
    """Return the watch with what wheels and vehicle do at a moment, reset after LONGEST_GAP or when time goes back."""
    settings, min_speed, t = config.traversability, config.estimator.min_speed, moment.t
    if not 0.0 <= t - before.t <= LONGEST_GAP:
        fresh = before if t > before.t else Watch()
        before = fresh._replace(spins=math.inf, sticks=math.inf, moves=math.inf)
    beside = moment.beside or [0.0] * len(moment.rim)
    known = [rim for rim in moment.rim if math.isfinite(rim)]
    if not known or not math.isfinite(moment.ground):
        return before._replace(t=t, slip=math.nan, pull=math.nan)
    spin_now = [
        rim - (moment.ground + more) > max(min_speed, settings.max_slip * rim)
        for rim, more in zip(moment.rim, beside, strict=True)  # nor nan
    ]
    spinning, stands = sum(spin_now), moment.ground < min_speed
    forced = moment.at_limit or moment.resistance > settings.stall_resistance  # nan: not known
    stalls = stands and forced and max(known) < settings.standstill
    slips = (spinning > 0 and stands) or 2 * spinning >= len(known)
    no_way = stalls or (slips and not _others_grip(moment, spin_now))
    spins = min(before.spins, t) if spinning or stalls else math.inf
    sticks = min(before.sticks, t) if no_way else math.inf
    moves = min(before.moves, t) if not stands and not spinning else math.inf
    stuck = t - sticks >= settings.stuck_time or (before.stuck and t - moves < settings.spin_time)
    lasting = t - spins >= settings.spin_time
    kept = math.exp(-(t - before.t) / settings.spin_time) if math.isfinite(before.slip + before.pull) else 0.0
    return before._replace(
        t=t,
        spins=spins,
        sticks=sticks,
        moves=moves,
        spinning=lasting,
        slides=t - sticks >= settings.spin_time,
        stuck=stuck,
        last=t if lasting or stuck else before.last,
        slip=moment.slip + kept * (before.slip - moment.slip) if kept else moment.slip,
        pull=moment.pull + kept * (before.pull - moment.pull) if kept else moment.pull,
    )


def _reckoned(before: Watch, moment: Moment, sample: Sample, options: WatchOptions) -> float:
    """Return the ground speed [m/s], else the last one and acceleration since, drawn to the wheels; nan without one."""
    if math.isfinite(sample.ground):
        return sample.ground
    step = moment.t - before.t
    if not (math.isfinite(moment.pull) and math.isnan(sample.felt) and math.isfinite(sample.rim)):
        return math.nan
    rolls = sample.rim - sample.beside
    if not 0.0 <= step <= LONGEST_GAP or math.isnan(before.reckoned):
        return rolls
    kept = math.exp(-step / options.reckoning_time)
    return rolls + kept * (before.reckoned + step * moment.inertia / moment.mass - rolls)


def _others_grip(moment: Moment, spins: Sequence[bool]) -> bool:
    """Whether the wheels that do not spin grip with torque left: more than an open differential could hand them.

    mean torque of wheels that grip > (0.5 + b) / (0.5 - b) times that of wheels that spin
    """
    wheels = list(zip(moment.torque, spins, moment.reserve, strict=False))
    spinning = [torque for torque, spin, _ in wheels if spin and math.isfinite(torque)]
    gripping = [torque for torque, spin, below in wheels if below and not spin]
    if not spinning or not gripping:
        return False
    b = DIFFERENTIAL_BIAS["open"]
    return (0.5 - b) * sum(gripping) / len(gripping) > (0.5 + b) * max(sum(spinning) / len(spinning), 0.0)


class Warnings(NamedTuple):
    """Times [s] at which warnings began: the present one (None without), and those since the last window."""

    since: float | None = None
    begun: tuple[float, ...] = ()

    def after(self, t: float, warning: Alert) -> Warnings:
        """Return the log after the reported warning at t [s]."""
        if warning is not Alert.IMMOBILISATION:
            return self._replace(since=None)
        return self if self.since is not None else Warnings(t, (*self.begun, t))
