"""The watch for immobilisation: one state machine, ten times a second, that says what it sees and warns.

    spins          r omega > v_min, v_s > max(v_min, s_max r omega)  a wheel; no loss while others grip with torque left
    stalls         V < v_min, no wheel turns, and thrust exceeds the pull, or all motors are at their limits
    `stall`        slip runs away, speed or depth leads to its limit: needs no soil
    `margin`       the curve of pull over slip and what is measured leave ever less, or too little

Without a ground speed `stall` reckons one from acceleration and wheels, dV/dt = a + (r omega - V) / tau: it warns, but
clears nothing.  Spinning or stalling for `spin_time` overrules a go of the estimate; without any way for `stuck_time`
the vehicle is stuck, until it has moved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple

from soilbus.config.model import Config
from soilbus.decision.margin import Margin, left_by
from soilbus.decision.moments import Moment, Sample
from soilbus.decision.options import WATCH, WatchOptions
from soilbus.decision.stall import LONGEST_GAP, Stall, smoothed, stalling
from soilbus.estimation.assembly import DIFFERENTIAL_BIAS

if TYPE_CHECKING:
    from soilbus.decision.capability import OverSlip


class Alert(StrEnum):
    """Warning of immobilisation."""

    UNKNOWN = "unknown"
    NONE = "none"
    IMMOBILISATION = "immobilisation"


class Watch(NamedTuple):
    """State of the watch; `watched` makes the next one.  All times in s.

    t: the last moment.  spins, sticks, moves: since when a wheel spins or the vehicle stalls, it does not move under
    thrust, it moves without spinning; inf where it does not.  spinning, slides, stuck: spinning or stalling has lasted
    for `spin_time`, so has spinning of half of the wheels or without any way, the vehicle is stuck and has not moved
    since.  last: the last moment that was spinning or stuck; older data do not describe the ground under the wheels.
    slip, pull [N]: low-pass filtered with `spin_time`, nan where not known.  engaged: which wheels drive.  reckoned,
    measured: ground speed [m/s], from acceleration and wheels where it is not measured, and when it was measured last.
    stall, margin, caused: what slip and speed say, what the curve leaves, and when it last gave a cause.  warning,
    cause, time_left: the output, what is seen, and the time that is left, None where it is not known.  is_caused:
    whether the warning has a cause no older than `warning.hold`; else it only lasts, until a decision is go.
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

    The trends start afresh after LONGEST_GAP, or when time goes back.  curve: pull over slip of the last window that
    had one, which counts while the same wheels drive.  config: `min_speed` [m/s], above which the vehicle moves;
    limits and times of `traversability` and `warning`.
    """
    now = _stalled(_moved(before, moment, config), before, moment, config, options)
    margin = before.margin if moment.engaged == before.engaged else before.margin.afresh()  # along another curve
    if curve is not None and curve.engaged != moment.engaged:
        curve = None
    if math.isfinite(moment.common + moment.given):
        asked = moment.given - moment.inertia + moment.mass * now.stall.slope
        if not len(margin.rows) or moment.t != margin.rows[-1, 0]:
            margin = left_by(margin, (moment.t, moment.common, moment.given, asked), curve, options)
    elif len(margin.rows) and not 0.0 <= moment.t - float(margin.rows[-1, 0]) <= LONGEST_GAP:
        margin = margin.afresh()
    fresh = before.caused if 0.0 <= moment.t - before.caused < options.forgetting_time else -math.inf
    caused = moment.t if margin.cause else fresh
    return seen_at(now._replace(engaged=moment.engaged, margin=margin, caused=caused), moment.t, config, options)


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
    if not acts and not since < options.forgetting_time:
        warning = Alert.NONE if now - stall.heard <= LONGEST_GAP else Alert.UNKNOWN
        return watch._replace(warning=warning, cause="", time_left=margin.time_left, is_caused=False)
    left = [time for time in (margin.time_left, stall.time_left) if time is not None]
    return watch._replace(
        warning=Alert.IMMOBILISATION,
        cause=acts or margin.cause or watch.cause,
        time_left=0.0 if watch.stuck else min(left, default=None),
        is_caused=bool(acts) or since < config.warning.hold,
    )


def curve_age(config: Config, options: WatchOptions = WATCH) -> float:
    """Return the age [s] up to which a window's curve counts: until what it was asked to foresee has come."""
    return config.estimator.window + options.warning_time


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
        rim > min_speed and rim - (moment.ground + more) > max(min_speed, settings.max_slip * rim)
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
    lasting, step = t - spins >= settings.spin_time, t - before.t
    return before._replace(
        t=t,
        spins=spins,
        sticks=sticks,
        moves=moves,
        spinning=lasting,
        slides=t - sticks >= settings.spin_time,
        stuck=stuck,
        last=t if lasting or stuck else before.last,
        slip=smoothed(before.slip, moment.slip, step, settings.spin_time),
        pull=smoothed(before.pull, moment.pull, step, settings.spin_time),
    )


def _stalled(now: Watch, before: Watch, moment: Moment, config: Config, options: WatchOptions) -> Watch:
    """The watch with the signs of a stall, by the measured ground speed or the reckoned one."""
    sample, stall = moment.last, before.stall
    if sample is None:
        return now._replace(reckoned=math.nan)
    reckoned = _reckoned(before, moment, sample, options)
    blind = math.isnan(sample.ground)
    if blind:
        sample = sample._replace(ground=reckoned, ground_var=sample.rim_var)
    elif not sample.t - before.measured <= LONGEST_GAP:  # what was reckoned so long is no trend
        stall = Stall()
    stall = stalling(stall, sample, config.estimator.min_speed, config.warning, config.traversability, options)
    if blind:  # what is reckoned is no all-clear
        return now._replace(stall=stall._replace(heard=before.stall.heard), reckoned=reckoned)
    return now._replace(stall=stall, reckoned=reckoned, measured=sample.t)


def _reckoned(before: Watch, moment: Moment, sample: Sample, options: WatchOptions) -> float:
    """Ground speed [m/s], else the last one and the acceleration since, drawn to the wheels; nan without one."""
    if math.isfinite(sample.ground):
        return sample.ground
    step = moment.t - before.t
    if not (math.isfinite(moment.pull) and math.isnan(sample.felt) and math.isfinite(sample.rim)):
        return math.nan
    rolls = sample.rim - sample.beside
    if not 0.0 <= step <= LONGEST_GAP or math.isnan(before.reckoned):
        return rolls
    kept = math.exp(-step / options.forgetting_time)
    return rolls + kept * (before.reckoned + step * moment.inertia / moment.mass - rolls)


def _others_grip(moment: Moment, spins: Sequence[bool]) -> bool:
    """Whether wheels grip with torque left, at more than (0.5 + b) / (0.5 - b) times the torque of those that spin."""
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
