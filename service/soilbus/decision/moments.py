"""What the watch reads ten times a second: slip, speeds, thrust and pull of one moment, from a short window of data.

    slip velocity of a wheel   v_s = r omega - V           V: of the ground beside the wheel, on a curve too
    resistance                 (sum(T / r) - pull) / (m g)
    common slip                e^(-b s) = mean of e^(-b s_w)      mu = mu_max (1 - e^(-b s)) (Brixius 1987)

Wheels on a differential share a torque: as load shifts between them, their mean slip grows at the same pull.  The
common slip, at which both would give what they give, hardly grows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.decision.options import WATCH
from soilbus.estimation.window import Rig, Window, inertia_of, pairs, pull_given
from soilbus.terra.vehicle import GRAVITY, slip_ratio


class Sample(NamedTuple):
    """Readings of one bin; nan where not known.

    t [s]; ground [m/s]: ground speed of the vehicle's middle; rim [m/s]: mean rim speed of the driven wheels whose
    speed is known; thrust, draft: sum of torque over radius, and draft, as shares of the weight; beside [m/s]: mean
    ground speed of those wheels less that of the middle, not zero on a curve with a side missing; at_limit: as of
    `Moment`; depth [m]: of the deepest wheel; felt [m/s^2]: dv/dt + g sin(pitch) where a specific force is measured and
    no pitch.
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
    draft: float = math.nan


class Moment(NamedTuple):
    """Means of the readings over some bins; nan where not known.

    t [s]: of the last bin.  ground, rim, beside [m/s]: ground speed of the vehicle's middle, rim speed of each wheel
    that a motor can drive, and ground speed of each of these less that of the middle (on a curve).  resistance: thrust
    less draft, slope and inertia, as a share of the weight.  at_limit: every motor whose limit is known is at its
    limit, and at least one limit is known.  slip, common: torque-weighted mean of the driving wheels, and common slip
    of all that do drive.  given, inertia, pull [N]: pull as far as it is measured, the part of it that speeds the
    vehicle up, and all of it, nan where no acceleration is measured.  last: the last bin by itself.  torque [N m],
    reserve: of each wheel that a motor can drive, and whether it is known to be below its limit.  engaged: which of all
    wheels drive.  mass [kg].
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
    common: float = math.nan
    engaged: tuple[bool, ...] = ()
    given: float = math.nan
    inertia: float = 0.0
    mass: float = 0.0


def common_slip(slips: Sequence[float], exponent: float = WATCH.slip_exponent) -> float:
    """Return the slip at which all wheels would give the mean of what they give at their own slips, of one or more."""
    least = min(slips)
    mean = sum(math.exp(exponent * (least - slip)) for slip in slips) / len(slips)
    return least - math.log(mean) / exponent


def bins_of_a_moment(bin_length: float) -> int:
    """Return the number of bins of a length [s] over which a moment's means go."""
    return max(round(WATCH.moment_span / bin_length), 1)


def moment_of(window: Window, rig: Rig, torque_limit: NDArray[np.float64], config: Config) -> Moment | None:
    """Return the mean over a short forward window; None without a bin or a chassis.  Parameters as of `moments`."""
    bins = len(window.t)
    return next(iter(moments(window, rig, torque_limit, config, np.arange(bins)[-1:], bins)), None)


def moments(
    window: Window, rig: Rig, torque_limit: NDArray[np.float64], config: Config, chosen: NDArray[np.intp], bins: int
) -> list[Moment]:
    """Return the means at some bins of a forward window, each over the last bins there.

    torque_limit (W,) [N m]: nan where not known, 0 of a wheel that rolls freely.  config: `full_torque`, `min_speed`,
    up to which slip is nan.  chosen (M,): the bins at which each mean ends.  bins: over how many, fewer at the window's
    begin.
    """
    if not len(chosen) or rig.chassis is None or not rig.wheels:
        return []
    drives, radius, mass = rig.drives, rig.radius, rig.chassis.mass
    engaged = drives & ~(torque_limit <= 0.0)
    speed, given = window.ground_speed, pull_given(window, rig.chassis)
    moving = np.where(speed > config.estimator.min_speed, speed, np.nan)[:, None]
    slips = slip_ratio(radius, window.speed, moving)
    slips = np.where(slips > -1.0, slips, np.nan)
    if rig.instrumentation is not None:
        slips[:, rig.instrumentation.without_speed] = np.nan  # their speed is assumed
    lever = np.zeros(len(radius))  # by which a yaw rate, positive to the left, adds to a wheel's ground speed
    if rig.track is not None:
        left, right = pairs(rig)
        lever[left], lever[right] = -rig.track / 2.0, rig.track / 2.0
    inertia = np.where(np.isfinite(given), inertia_of(window, rig.chassis), np.nan)
    n, w = 4, len(radius)
    columns = np.column_stack(
        [speed, given, inertia, window.yaw_rate, radius * window.speed, window.torque, slips[:, engaged]]
    )
    place = chosen[:, None] + np.arange(1 - bins, 1)
    taken = np.where((place >= 0)[..., None], columns[np.maximum(place, 0)], np.nan)
    known = np.isfinite(taken)
    accelerates = (np.isfinite(window.acceleration)[place] & (place >= 0)).any(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        means = np.where(known, taken, 0.0).sum(axis=1) / known.sum(axis=1)
        ground, given, inertia, yaw_rate = means[:, :n].T
        rim, torque, slips = means[:, n : n + w], means[:, n + w : n + 2 * w], means[:, n + 2 * w :]
        beside = lever * np.where(np.isfinite(yaw_rate), yaw_rate, 0.0)[:, None]
        limited = np.isfinite(torque_limit) & (torque_limit > 0.0)
        full = torque >= config.traversability.full_torque * torque_limit
        at_limit = limited.any() & (full | ~limited).all(axis=1)
        resistance = ((torque / radius).sum(axis=1) - given) / (mass * GRAVITY)
        weights = np.where((torque > 0.0) & (rim > 0.0) & drives, torque, 0.0)
        slip = np.where(weights > 0.0, weights * (1.0 - (ground[:, None] + beside) / rim), 0.0)
        slip = slip.sum(axis=1) / weights.sum(axis=1)
    pull = np.where(accelerates, given, np.nan)
    common = [common_slip(row) if (row := s[np.isfinite(s)].tolist()) else math.nan for s in slips]
    lasts = _samples(window.rows(chosen), rig, beside, at_limit)
    rims, besides, torques, reserves = (v[:, drives].tolist() for v in (rim, beside, torque, limited & ~full))
    of_vehicle = (window.t[chosen], ground, resistance, at_limit, slip, pull, given, np.nan_to_num(inertia))
    columns_of = zip(*(values.tolist() for values in of_vehicle), strict=True)
    drive = tuple(engaged.tolist())
    return [
        Moment(t, ground, rims[i], resistance, limit, slip, pull, lasts[i], besides[i], torques[i], reserves[i],
               common[i], drive, given, inertia, mass)
        for i, (t, ground, resistance, limit, slip, pull, given, inertia) in enumerate(columns_of)
    ]  # fmt: skip


def _samples(window: Window, rig: Rig, beside: Array, at_limit: NDArray[np.bool_]) -> list[Sample]:
    """Return each bin of a window of a rig with a chassis by itself; beside (N, W), at_limit (N,)."""
    assert rig.chassis is not None  # `moments` sees to it
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
    weight = rig.chassis.mass * GRAVITY
    columns = (
        window.t,
        window.ground_speed,
        window.variance["ground_speed"],
        mean,
        np.where(known, of_rim, 0.0).sum(axis=1) / np.maximum(count, 1) ** 2,
        thrust / weight,
        np.where(count > 0, mean_beside, 0.0),
        at_limit,
        depth,
        of_depth,
        np.where(np.isnan(window.pitch) & window.kinematic, window.acceleration, np.nan),
        window.draft / weight,
    )
    return list(map(Sample, *(column.tolist() for column in columns)))
