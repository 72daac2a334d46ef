"""Loss of traction from the sensors alone: wheels that spin, and a vehicle that does not move.

    slip velocity of a wheel   v_s = r omega - V
    it spins where             v_s > max(v_min, s_max r omega)
    the vehicle stalls where   V < v_min and no wheel turns, while the wheels' thrust sum(T / r) exceeds what draft,
                               slope and inertia ask by `stall_resistance`, or all motors are at their limits

Wheels that spin are no loss of the vehicle's traction while others grip with torque left.

Slip 1 - V/(r omega) is not defined at standstill, its velocity is: so one rule holds from standstill to full speed.
Either one that lasts for `spin_time` overrules a go of the estimate.  A vehicle that spins or stalls without moving for
`stuck_time` is stuck.  It stays stuck until it has moved, for the ground is the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.config.model import Config, NoiseOfChannels
from soilbus.config.model import Traversability as Settings
from soilbus.decision.options import WATCH
from soilbus.decision.stall_forecast import LONGEST_GAP, Sample, StallForecast, forecast
from soilbus.estimation.assembly import DIFFERENTIAL_BIAS
from soilbus.estimation.posterior import Estimate
from soilbus.estimation.window import Rig, Window, pairs, pull_given
from soilbus.sensors.options import CONSISTENCY
from soilbus.terra.vehicle import GRAVITY

if TYPE_CHECKING:
    from soilbus.decision.capability import OverSlip


class Motion(NamedTuple):
    """One moment of wheels and vehicle; nan where not known.

    Attributes
    ----------
    t
        [s].
    ground, rim, beside
        [m/s], ground speed of the vehicle's middle, rim speed of each wheel that a motor can drive, and ground speed of
        each of these less that of the middle (on a curve).
    resistance
        Thrust less draft, slope and inertia, as a share of the weight.
    at_limit
        Every motor whose limit is known is at its limit, and at least one limit is known.
    slip
        Torque-weighted mean of the driving wheels.
    pull
        [N], of draft, slope and inertia; nan where the acceleration is not measured.
    last
        The last bin by itself, for the forecast of a stall.
    torque, reserve
        [N m], of each of these wheels; whether it is known to be below its limit.
    """

    t: float
    ground: float
    rim: Sequence[float]
    resistance: float
    at_limit: bool
    slip: float = math.nan
    pull: float = math.nan
    last: Sample | None = None
    beside: Sequence[float] = ()
    torque: Sequence[float] = ()
    reserve: Sequence[bool] = ()


class TractionLoss(NamedTuple):
    """State carried from one moment to the next by `observed`.  All times in s.

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
    ahead
        Forecast of a stall from slip and speed.
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
    ahead: StallForecast = StallForecast()

    @property
    def warns(self) -> bool:
        """Whether the vehicle is stuck, a stall is ahead, or half of its wheels spin while it gains no speed."""
        return self.stuck or self.ahead.stalls or (self.slides and not self.ahead.gains_speed)


NO_LOSS = TractionLoss()


def observed(before: TractionLoss, motion: Motion, config: Config) -> TractionLoss:
    """The loss of traction after one more moment; moments in their order, at any rate.

    Parameters
    ----------
    before
        The state after the moment before; reset after LONGEST_GAP, or when time goes back.
    motion
        The wheels and the vehicle now.
    config
        `min_speed` [m/s], above which the vehicle moves; `max_slip`, `spin_time`, `stuck_time`, `standstill`,
        `stall_resistance`; of the warning.

    Returns
    -------
    TractionLoss
        With `spinning` and `stuck` as of now.
    """
    settings, min_speed, ahead = config.traversability, config.estimator.min_speed, before.ahead
    if motion.last is not None:
        ahead = forecast(ahead, motion.last, min_speed, config.warning, settings)
    if not 0.0 <= motion.t - before.t <= LONGEST_GAP:
        fresh = before if motion.t > before.t else TractionLoss()
        before = fresh._replace(spins=math.inf, sticks=math.inf, moves=math.inf)
    beside = motion.beside or [0.0] * len(motion.rim)
    known = [rim for rim in motion.rim if math.isfinite(rim)]
    if not known or not math.isfinite(motion.ground):
        return before._replace(t=motion.t, slip=math.nan, pull=math.nan, ahead=ahead)
    ground, max_slip = motion.ground, settings.max_slip
    spin_now = [
        rim - (ground + more) > max(min_speed, max_slip * rim)
        for rim, more in zip(motion.rim, beside, strict=True)  # nor nan
    ]
    spinning, stands = sum(spin_now), motion.ground < min_speed
    forced = motion.at_limit or motion.resistance > settings.stall_resistance  # nan: not known
    stalls = stands and forced and max(known) < settings.standstill
    slips = (spinning > 0 and stands) or 2 * spinning >= len(known)
    no_way = stalls or (slips and not _others_grip(motion, spin_now))
    t = motion.t
    spins = min(before.spins, t) if spinning or stalls else math.inf
    sticks = min(before.sticks, t) if no_way else math.inf
    moves = min(before.moves, t) if not stands and not spinning else math.inf
    stuck = t - sticks >= settings.stuck_time or (before.stuck and t - moves < settings.spin_time)
    lasting = t - spins >= settings.spin_time
    slides = t - sticks >= settings.spin_time
    kept = math.exp(-(t - before.t) / settings.spin_time) if math.isfinite(before.slip + before.pull) else 0.0
    slip = motion.slip + kept * (before.slip - motion.slip) if kept else motion.slip
    pull = motion.pull + kept * (before.pull - motion.pull) if kept else motion.pull
    last = t if lasting or stuck else before.last
    return TractionLoss(t, spins, sticks, moves, lasting, slides, stuck, last, slip, pull, ahead)


def _others_grip(motion: Motion, spins: Sequence[bool]) -> bool:
    """Whether the wheels that do not spin grip with torque left: more than an open differential could hand them.

    mean torque of wheels that grip > (0.5 + b) / (0.5 - b) times that of wheels that spin
    """
    wheels = list(zip(motion.torque, spins, motion.reserve, strict=False))
    spinning = [torque for torque, spin, _ in wheels if spin and math.isfinite(torque)]
    gripping = [torque for torque, spin, below in wheels if below and not spin]
    if not spinning or not gripping:
        return False
    b = DIFFERENTIAL_BIAS["open"]
    return (0.5 - b) * sum(gripping) / len(gripping) > (0.5 + b) * max(sum(spinning) / len(spinning), 0.0)


def slope_felt(loss: TractionLoss, rig: Rig) -> float:
    """Force [N] of a slope that only a specific force shows, which counts as inertia in `inertia_of`; else 0."""
    return 0.0 if rig.chassis is None else rig.chassis.mass * loss.ahead.slope


def missing_pull(loss: TractionLoss, curve: OverSlip, noise: NoiseOfChannels, deviations: float) -> float:
    """Pull [N] that the estimate predicts at the present slip and the wheels significantly do not give; else 0.

    Parameters
    ----------
    loss
        With the present slip and pull.
    curve
        Predicted pull over slip.
    noise
        Gain errors of the speed, ground speed and draft sensors.
    deviations
        Standard deviations of the innovation that are subtracted.

    Notes
    -----
    The innovation is P(s) - P.  Its variance is that of the curve, of the slip (gain errors of both speeds) and of the
    draft's gain error.
    """
    known = np.isfinite(curve.pull)
    if not known.any() or not math.isfinite(loss.slip + loss.pull) or loss.slip < curve.slip[0]:
        return 0.0
    slips, pulls, stds = curve.slip[known], curve.pull[known], curve.pull_std[known]
    predicted, std = float(np.interp(loss.slip, slips, pulls)), float(np.interp(loss.slip, slips, stds))
    slope = float(np.interp(loss.slip, slips, np.gradient(pulls, slips))) if len(slips) > 1 else 0.0
    of_slip = slope * (1.0 - loss.slip) * math.hypot(noise.speed.gain, noise.ground_speed.gain)
    sd = math.hypot(std, of_slip, noise.draft.gain * loss.pull)
    return max(predicted - loss.pull - deviations * sd, 0.0)


def excess_slip(loss: TractionLoss, predicted: Estimate, config: Config, deviations: float) -> float:
    """Slip beyond the predicted one, as far as it is significant; else 0.

    Parameters
    ----------
    loss
        With the present slip.
    predicted
        Slip that the present pull needs (`slip_needed`), or where that is not known the present demand.
    config
        Gain errors of both speeds; slip by uneven ground.
    deviations
        Standard deviations of the innovation that are subtracted.
    """
    if not math.isfinite(loss.slip):
        return 0.0
    of_gains = (1.0 - loss.slip) * math.hypot(config.noise.speed.gain, config.noise.ground_speed.gain)
    sd = math.hypot(predicted.std, of_gains, config.warning.slip_noise)
    return max(loss.slip - predicted.value - deviations * sd, 0.0)


def slip_needed(pull: float, curve: OverSlip, noise: NoiseOfChannels) -> Estimate | None:
    """The least slip that gives a pull [N]; None where none does, or where slip hardly changes the pull.

    Notes
    -----
    ds = dP / (dP/ds), with the curve's std and the draft's gain error in dP.
    """
    known = np.isfinite(curve.pull)
    slips, pulls, stds = curve.slip[known], curve.pull[known], curve.pull_std[known]
    if len(slips) < 2 or not pull < pulls.max():
        return None
    i = max(int(np.argmax(pulls > pull)), 1)
    slope = float((pulls[i] - pulls[i - 1]) / (slips[i] - slips[i - 1]))
    if slope <= 0.0:
        return None
    slip = max(float(slips[i] - (pulls[i] - pull) / slope), 0.0)
    return Estimate(slip, math.hypot(float(np.interp(slip, slips, stds)), noise.draft.gain * pull) / slope)


def idle(window: Window, rig: Rig, since: float, before: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which wheels do not drive: without torque while another one pulls, for most of the time after `since`.

    Parameters
    ----------
    window
        A forward window.
    rig
        Radius of each wheel.
    since
        [s].
    before
        (W,), the result before, kept where no wheel pulls or a torque is not known.

    Returns
    -------
    NDArray
        (W,).  Such a wheel rolls, even if its motor reports a torque limit.

    Notes
    -----
    Behind a shaft that drives both axles no torque of one axle is measured: there speeds say whether it is engaged.
    """
    window = window.rows(np.flatnonzero(window.t > since))
    of_shaft, apart = _disengaged(window, rig, before)
    return np.where(of_shaft, apart, _without_torque(window, rig, before))


def shared_out(limit: NDArray[np.float64], apart: NDArray[np.bool_], rig: Rig) -> NDArray[np.float64]:
    """Return the torque limits (W,) [N m] where a motor's whole torque goes to the wheels that it still turns.

    limit: as the motors share it out among all their wheels; apart: disengaged wheels (W,).
    """
    if rig.instrumentation is None or not apart.any():
        return limit
    limit = limit.copy()
    for motor in rig.instrumentation.motors:
        wheels, weight = np.array(motor.wheels), np.array(motor.weight)
        on = ~apart[wheels]
        whole, left = float(weight @ limit[wheels]), float((weight * limit[wheels])[on].sum())
        if left > 0.0:
            limit[wheels[on]] *= whole / left
    limit[apart] = 0.0
    return limit


def _without_torque(window: Window, rig: Rig, before: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which wheels (W,) have no torque while another one pulls, most of the time; else as before."""
    with np.errstate(invalid="ignore", divide="ignore"):
        traction = window.torque / (rig.radius * window.load)
        pulls = (traction > CONSISTENCY.driving_traction).any(axis=1)
        still = np.abs(traction[pulls]) < CONSISTENCY.idle_traction
    known = np.isfinite(traction[pulls])
    if 2 * pulls.sum() <= len(traction):
        return before
    return np.where(2 * known.sum(axis=0) > len(known), 2 * still.sum(axis=0) > known.sum(axis=0), before)


def disengaged(window: Window, rig: Rig, since: float, before: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which wheels (W,) a shaft of both axles does not turn after `since` [s], by speeds; else as before."""
    of_shaft, apart = _disengaged(window.rows(np.flatnonzero(window.t > since)), rig, before)
    return of_shaft & apart


def _disengaged(window: Window, rig: Rig, before: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Wheels (W,) on a locked shaft to both axles, and which of them it does not turn; as before where it drives none.

    A shaft that drives turns both axles alike.  The axle that it does not turn is slower, and not faster than the
    ground, for it is pushed.
    """
    of_shaft, apart = np.zeros(len(rig.wheels), bool), before.copy()
    given = rig.instrumentation
    if given is None:
        return of_shaft, apart
    turns = np.where(given.without_speed, np.nan, given.ratio * window.speed)
    rolls = rig.radius * window.speed - window.ground_speed[:, None]
    for coupling in given.couplings:
        wheels = [*coupling.one, *coupling.other]
        if coupling.of_axle or not coupling.locked or not any(set(wheels) <= set(m.wheels) for m in given.motors):
            continue
        of_shaft[wheels] = True
        one, other = (turns[:, list(part)].mean(axis=1) for part in (coupling.one, coupling.other))
        drives = np.isfinite(one + other) & (window.torque[:, wheels].sum(axis=1) > 0.0)
        if 2 * drives.sum() <= len(drives):
            continue
        for part, own, others in ((coupling.one, one, other), (coupling.other, other, one)):
            pushed = rolls[:, list(part)].mean(axis=1) <= 0.0
            slower = own < (1.0 - CONSISTENCY.gear_slack) * others
            apart[list(part)] = 2 * (pushed & slower & drives).sum() > drives.sum()
    return of_shaft, apart


def motion_of(window: Window, rig: Rig, torque_limit: NDArray[np.float64], settings: Settings) -> Motion | None:
    """The mean motion over a short forward window; None without a bin or a chassis.  Parameters as of `motions`."""
    bins = len(window.t)
    found = motions(window, rig, torque_limit, settings, np.arange(bins)[-1:], bins)
    return found[0] if found else None


def bins_of_a_moment(bin_length: float) -> int:
    """Number of bins of a length [s] over which a moment's means go."""
    return max(round(WATCH.moment_span / bin_length), 1)


def motions(
    window: Window,
    rig: Rig,
    torque_limit: NDArray[np.float64],
    settings: Settings,
    chosen: NDArray[np.intp],
    bins: int,
) -> list[Motion]:
    """The mean motions over the last bins at each of some bins of a forward window.

    Parameters
    ----------
    window
        A forward window.
    rig
        With a chassis and wheels, else there are no motions.
    torque_limit
        (W,) [N m], nan where not known.
    settings
        `full_torque`, share of the limit from which a motor is at its limit.
    chosen
        (M,), the bins at which each mean ends.
    bins
        Over how many each mean goes, fewer at the window's begin.
    """
    if not len(chosen) or rig.chassis is None or not rig.wheels:
        return []
    drives, radius, weight = rig.drives, rig.radius, rig.chassis.mass * GRAVITY
    columns = np.column_stack(
        [window.ground_speed, pull_given(window, rig.chassis), radius * window.speed, window.torque, window.yaw_rate]
    )
    place = chosen[:, None] + np.arange(1 - bins, 1)
    there, place = place >= 0, np.maximum(place, 0)
    known = np.isfinite(columns)
    values, counts = np.where(known, columns, 0.0)[place], known[place]
    accelerates = (np.isfinite(window.acceleration)[place] & there).any(axis=1)
    if not there.all():
        values[~there], counts[~there] = 0.0, False
    with np.errstate(invalid="ignore", divide="ignore"):
        means = values.sum(axis=1) / counts.sum(axis=1)
        ground, asked, yaw_rate = means[:, 0], means[:, 1], means[:, -1]
        rim, torque = means[:, 2 : 2 + len(radius)], means[:, 2 + len(radius) : -1]
        beside = _side(rig) * np.where(np.isfinite(yaw_rate), yaw_rate, 0.0)[:, None]
        limited = np.isfinite(torque_limit) & (torque_limit > 0.0)
        full = torque >= settings.full_torque * torque_limit
        at_limit = limited.any() & (full | ~limited).all(axis=1)
        resistance = ((torque / radius).sum(axis=1) - asked) / weight
        weights = np.where((torque > 0.0) & (rim > 0.0) & drives, torque, 0.0)
        slips = np.where(weights > 0.0, weights * (1.0 - (ground[:, None] + beside) / rim), 0.0)
        slip = slips.sum(axis=1) / weights.sum(axis=1)
    pull = np.where(accelerates, asked, np.nan)
    of_wheels = (values[:, drives].tolist() for values in (rim, beside, torque, limited & ~full))
    scalars = (values.tolist() for values in (window.t[chosen], ground, resistance, at_limit, slip, pull))
    lasts = _samples(window.rows(chosen), rig, beside, at_limit)
    return [
        Motion(t, ground, rim, resistance, at_limit, slip, pull, last, beside, torque, reserve)
        for t, ground, resistance, at_limit, slip, pull, rim, beside, torque, reserve, last in zip(
            *scalars, *of_wheels, lasts, strict=True
        )
    ]


def _samples(window: Window, rig: Rig, beside: Array, at_limit: NDArray[np.bool_]) -> list[Sample]:
    """Each bin of a window of a rig with a chassis, for the forecast of a stall; beside (N, W), at_limit (N,)."""
    assert rig.chassis is not None  # `motions` sees to it
    rim, of_rim = rig.radius * window.speed, rig.radius**2 * window.variance["speed"]
    known = np.isfinite(rim) & np.isfinite(of_rim) & rig.drives
    count, force = known.sum(axis=1), window.torque / rig.radius
    pushes = np.isfinite(force)
    thrust = np.where(pushes.any(axis=1), np.where(pushes, force, 0.0).sum(axis=1), np.nan)
    depth, of_depth = window.sinkage, window.variance["sinkage"]
    sunk = np.isfinite(depth) & np.isfinite(of_depth)
    bin_, deepest = np.arange(len(depth)), np.where(sunk, depth, -np.inf).argmax(axis=1)
    depth, of_depth = (np.where(sunk, values, np.nan)[bin_, deepest] for values in (depth, of_depth))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, mean_beside = (np.where(known, values, 0.0).sum(axis=1) / count for values in (rim, beside))
    columns = (
        window.t,
        window.ground_speed,
        window.variance["ground_speed"],
        mean,
        np.where(known, of_rim, 0.0).sum(axis=1) / np.maximum(count, 1) ** 2,
        thrust / (rig.chassis.mass * GRAVITY),
        np.where(count > 0, mean_beside, 0.0),
        at_limit,
        depth,
        of_depth,
        np.where(np.isnan(window.pitch) & window.kinematic, window.acceleration, np.nan),
    )
    return list(map(Sample, *(column.tolist() for column in columns)))


def _side(rig: Rig) -> Array:
    """Lever [m] (W,) by which a yaw rate, positive to the left, adds to a wheel's ground speed; 0 without a track."""
    lever = np.zeros(len(rig.wheels))
    if rig.track is not None:
        left, right = pairs(rig)
        lever[left], lever[right] = -rig.track / 2.0, rig.track / 2.0
    return lever
