"""Instrumentation: how the torques, speeds and loads of the wheels follow from what is measured.

    M_q x_q = l_q + noise      x_q: torques, speeds or loads of the W wheels; l_q: W independent observations

Each row of M is what one channel measures (a wheel, the sum over an axle, the mean that a motor's speed is) or, where
no channel is left, what is known without measuring:

    torque    T_left - T_right = 0       open differential, sd: its friction; unknown where it is locked
              T = 0                      a wheel that is not driven: solved for its slip, see `observation_model`
    speed     omega_left - omega_right   0, sd: slip_sd, nothing where the differential is locked
              omega = V / r (1 - s)      a wheel without sensor, until its torque says better
    load      sum W = m g cos(pitch)     and heave: what measured axles bounce
              front less rear            the shift to the front axle by pitch, acceleration and draft
              axle between, less what the others' line gives it: 0, sd: how unequally axles share (`wheel_shares`)
              W_left - W_right           from the roll angle; sd: what uneven ground adds

So a channel of two wheels is one noise and one gain error.  Where every wheel has its own torque, speed and load, all M
are unit matrices and `Rig.instrumentation` is None.  `completed` makes a window of it: values of every wheel, and the
observations l for the observation model, which propagates their noise through M^-1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.window import Rig, Window, pairs, steady, zero_if_unknown
from soilbus.terra.vehicle import GRAVITY, axle_loads, wheel_loads

LEAST_WEIGHT = 1e-12
"""Weight below which an entry of an inverse is rounding: its rows hold ones, halves and gear ratios' shares."""


class Group(NamedTuple):
    """A channel of one wheel or more: sum(weight x) over these wheels."""

    wheels: tuple[int, ...]
    weight: tuple[float, ...]
    name: str  # of the wheel or the axle that it is mapped for


class Coupling(NamedTuple):
    """Two sets of wheels behind a differential."""

    one: tuple[int, ...]
    other: tuple[int, ...]
    bias: float  # sd of the difference of the torques over their sum
    locked: bool  # the speeds are equal, and the torques differ by anything
    is_open: bool  # the torques are equal but for friction
    of_axle: bool = True  # the vehicle's differential lock acts on it
    is_switched: bool = False  # a signal says whether it does


class Row(NamedTuple):
    """A row of M: weights (W,), what it is, its channel's column or its coupling's index, and the sd of its gain."""

    weight: tuple[float, ...]
    kind: str
    at: int
    name: str
    gain: float = 0.0


class Observations(NamedTuple):
    """Observations of N instants, in the order of the rows; nan where unknown."""

    torque: Array  # (N, W)
    torque_var: Array
    value: Array  # (N, 2 W + 1) of loads, speeds and ground speed
    variance: Array
    # (N, 2 W + 1) [1]: how computed loads follow m (G sin(pitch) + dv/dt), whose noise is not in `variance`
    by_inertia: Array
    by_draft: Array  # as by_inertia, of the draft as measured


@dataclass(frozen=True)
class Instrumentation:
    """What is measured of the W wheels of a rig."""

    torque: tuple[Row, ...]  # W rows of each
    speed: tuple[Row, ...]
    load: tuple[Row, ...]
    couplings: tuple[Coupling, ...]  # differentials, and the shaft between the axles
    ratio: Array  # (W,), turns of a motor of both axles for one of the wheel
    load_noise: float  # relative sd of a load that is not measured, in a bin
    motors: tuple[Group, ...] = ()  # those that drive several wheels

    @cached_property
    def latent_matrix(self) -> Array:
        """M of loads, speeds and ground speed (2 W + 1, 2 W + 1)."""
        W = len(self.load)
        M = np.eye(2 * W + 1)
        M[:W, :W], M[W : 2 * W, W : 2 * W] = matrix(self.load), matrix(self.speed)
        return M

    @cached_property
    def from_observed(self) -> Array:
        """The inverse of `latent_matrix`."""
        return np.asarray(np.linalg.inv(self.latent_matrix))

    @cached_property
    def loads_at_prior(self) -> NDArray[np.bool_]:
        """Which rows of loads (W,) neither a load cell nor torques measure.

        Torques measure the difference of two wheels with a measured sum, and a measured torque each.
        """
        computed, rows = self.computes("torque"), list(zip(matrix(self.load) != 0.0, self.load, strict=True))
        sums = [on.tolist() for on, row in rows if row.kind == "channel"]
        by_torques = [row.kind == "side" and not computed[on].any() and on.tolist() in sums for on, row in rows]
        return np.asarray(np.array([row.kind != "channel" for row in self.load]) & ~np.array(by_torques))

    @cached_property
    def sides(self) -> tuple[tuple[int, int], ...]:
        """Row of torques and row of loads of each two wheels with equal torques and computed loads."""
        return tuple(
            (i, k)
            for i, torque in enumerate(self.torque)
            for k, load in enumerate(self.load)
            if torque.kind == "coupling" and load.kind == "side"
            if self.couplings[torque.at].is_open
            if [w != 0.0 for w in torque.weight] == [w != 0.0 for w in load.weight]
        )

    @cached_property
    def without_speed(self) -> NDArray[np.bool_]:
        """Which wheels (W,) have a speed that no channel measures, not even the mean of several."""
        free = [row for row in self.speed if row.kind == "free"]
        return np.array([any(row.weight[w] for row in free) for w in range(len(self.speed))])

    def computes(self, quantity: str) -> NDArray[np.bool_]:
        """Return which wheels (W,) have a torque, speed or load that is not wholly measured."""
        rows = getattr(self, quantity)
        return np.array([any(r.weight[w] for r in rows if r.kind != "channel") for w in range(len(rows))])


@lru_cache(64)
def matrix(rows: tuple[Row, ...]) -> Array:
    """Return M (W, W) of a quantity's rows."""
    return np.array([row.weight for row in rows])


@lru_cache(64)
def inverse(rows: tuple[Row, ...]) -> Array:
    """Return M^-1 (W, W) of a quantity's rows."""
    return np.asarray(np.linalg.inv(matrix(rows)))


def rows_of(
    n_wheels: int, channels: Sequence[Group], gain: float, otherwise: Sequence[Row]
) -> tuple[tuple[Row, ...], tuple[str, ...]]:
    """Return W independent rows, channels first, and names (W,) of the raw window's columns.

    A row that the rows before it imply is left out.  The raw window has a channel in the column of the first of its
    wheels that no channel of fewer wheels has.
    """
    rows: list[Row] = []
    for group in channels:
        weight = np.zeros(n_wheels)
        weight[list(group.wheels)] = group.weight
        if _independent(rows, weight):
            rows.append(Row(tuple(weight.tolist()), "channel", -1, group.name, gain))
    names = [""] * n_wheels
    for i in sorted(range(len(rows)), key=lambda i: np.count_nonzero(rows[i].weight)):
        column = next(w for w, of in enumerate(rows[i].weight) if of and not names[w])
        rows[i], names[column] = rows[i]._replace(at=column), rows[i].name
    for row in otherwise:
        if len(rows) < n_wheels and _independent(rows, np.array(row.weight)):
            rows.append(row)
    place: dict[int, Row] = {}  # each row at the place of a wheel that it is of, those of one wheel first
    for row in sorted(rows, key=lambda row: np.count_nonzero(row.weight)):
        free = [i for i in range(len(rows)) if i not in place]
        place[next((i for i in free if row.weight[i]), free[0])] = row
    return tuple(place[i] for i in range(len(rows))), tuple(names)


def _independent(rows: Sequence[Row], weight: Array) -> bool:
    return int(np.linalg.matrix_rank(np.array([*(row.weight for row in rows), weight]))) == len(rows) + 1


def contrast(n_wheels: int, one: Sequence[int], other: Sequence[int], scale: Array) -> tuple[float, ...]:
    """Return the weights (W,) of mean(scale x) over one set of wheels less that over the other."""
    weight = np.zeros(n_wheels)
    weight[list(one)] = scale[list(one)] / len(one)
    weight[list(other)] = -scale[list(other)] / len(other)
    return tuple(weight.tolist())


def unit(n_wheels: int, wheel: int) -> tuple[float, ...]:
    """Return the weights (W,) of one wheel alone."""
    return tuple(float(w == wheel) for w in range(n_wheels))


def completed(window: Window, rig: Rig) -> Window:
    """Return a forward window with a torque, speed and load of every wheel, and `observations` if there is need.

    Its draft is zero where nothing is ever towed, its acceleration dv/dt where specific force was measured, its yaw
    rate that of the steering angle where none was.
    """
    window = _of_vehicle(window, rig)
    given = rig.instrumentation
    if given is None or window.observations is not None or not len(window.t):
        return window
    zero = np.zeros(len(window.t))
    readings = [window.torque[:, row.at] if row.kind == "channel" else zero for row in given.torque]
    torque_read = np.stack(readings, axis=1)
    torque = _combined(torque_read, inverse(given.torque))  # differentials share equally
    load_of, load_var, load_read, by_inertia, by_draft = _loads(window, rig, given, torque)
    speed_of, speed_var = _speeds(window, rig, given)
    torque_var = _torque_variances(window, given, torque)
    torque_of = np.where(np.isfinite(torque_var), torque_read, np.nan)
    latents = np.column_stack([load_of, speed_of, window.ground_speed])
    latents_var = np.column_stack([load_var, speed_var, window.variance["ground_speed"]])
    follows = (np.pad(by, ((0, 0), (0, by.shape[1] + 1))) for by in (by_inertia, by_draft))
    observations = Observations(torque_of, torque_var, latents, latents_var, *follows)
    columns, variance = dict[str, Any](), dict(window.variance)
    for quantity, rows, read, of_rows in (
        ("load", given.load, load_read, load_var), ("speed", given.speed, speed_of, speed_var),
        ("torque", given.torque, torque_read, torque_var),
    ):  # fmt: skip
        known = np.where(np.isfinite(of_rows), of_rows, np.nan if quantity != "torque" else 0.0)
        columns[quantity] = _combined(read, inverse(rows))
        variance[quantity] = _combined(known, inverse(rows) ** 2)
    return replace(window, variance=variance, observations=observations, **columns)


def recompleted(window: Window, rig: Rig, other: Rig) -> Window:
    """Return a window that was completed for a rig, completed for another one with the same channels."""
    given, observations = rig.instrumentation, window.observations
    if other is rig or given is None or observations is None:
        return window
    W, variance, raw = len(rig.wheels), dict(window.variance), dict[str, Any]()
    values = np.hstack([observations.torque, observations.value])
    variances = np.hstack([observations.torque_var, observations.variance])
    for first, quantity in zip((0, W, 2 * W), ("torque", "load", "speed"), strict=True):
        raw[quantity], variance[quantity] = np.full((2, len(values), W), np.nan)
        for i, row in enumerate(getattr(given, quantity), first):
            if row.kind == "channel":
                raw[quantity][:, row.at], variance[quantity][:, row.at] = values[:, i], variances[:, i]
    return completed(replace(window, variance=variance, observations=None, **raw), other)


def straightened(window: Window, rig: Rig, yaw_rate: Array) -> Window:
    """Return a completed window with the wheel speeds that give each wheel its own slip at the vehicle's ground speed.

    On a curve at yaw rate q (N,) [rad/s] a wheel half a track to the left moves over the ground at V - q B / 2.
    """
    yaw = zero_if_unknown(yaw_rate)
    if rig.track is None or rig.chassis is None or not yaw.any():
        return window
    left, right = pairs(rig)
    own = np.repeat(window.ground_speed[:, None], len(rig.wheels), axis=1)
    own[:, left] -= yaw[:, None] * rig.track / 2.0
    own[:, right] += yaw[:, None] * rig.track / 2.0
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(own > 0.0, window.ground_speed[:, None] / own, 1.0)
    speed, observations = window.speed * np.where(np.isfinite(scale), scale, 1.0), window.observations
    if rig.instrumentation is not None and observations is not None:
        W, value = len(rig.wheels), observations.value.copy()
        value[:, W : 2 * W] = _combined(speed, matrix(rig.instrumentation.speed))
        observations = observations._replace(value=value)
    return replace(window, speed=speed, observations=observations)


def _of_vehicle(window: Window, rig: Rig) -> Window:
    """Draft, acceleration and yaw rate as the machine has them."""
    changed, variance = dict[str, Any](), dict(window.variance)
    if rig.towing == "never":
        changed["draft"] = np.zeros(len(window.t))
        weight = 0.0 if rig.chassis is None else rig.chassis.mass * GRAVITY
        slope = rig.options.measurements.unknown_slope
        shown = np.isfinite(window.pitch) | (np.isfinite(window.acceleration) & rig.specific_force)
        variance["draft"] = np.where(shown, 0.0, (slope * weight) ** 2)
    if rig.specific_force and not window.kinematic:
        changed["acceleration"] = window.acceleration - GRAVITY * np.sin(zero_if_unknown(steady(window).pitch))
    if rig.chassis is not None and np.isfinite(window.steering_angle).any() and not np.isfinite(window.yaw_rate).any():
        curvature = np.tan(window.steering_angle) / rig.chassis.wheelbase
        changed["yaw_rate"] = window.ground_speed * curvature
        variance["yaw_rate"] = (window.ground_speed / rig.chassis.wheelbase) ** 2 * window.variance["steering_angle"]
    if not changed:
        return window
    return replace(window, variance=variance, kinematic=window.kinematic or rig.specific_force, **changed)


def _combined(values: Array, weight: Array) -> Array:
    """Weighted sums (N, W) of values (N, W); nan where a value with a weight is nan; those without one do not count."""
    unknown = np.isnan(values)
    sums = np.where(unknown, 0.0, values) @ weight.T
    if unknown.any():
        sums[(unknown.astype(float) @ (np.abs(weight) > LEAST_WEIGHT).astype(float).T) > 0.0] = np.nan
    return np.asarray(sums)


def _loads(window: Window, rig: Rig, given: Instrumentation, torque: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Observations of loads, their variances, what the rows read, and what they follow as in `Observations` (N, W)."""
    n, W, window, chassis = len(window.t), len(given.load), steady(window), rig.chassis
    load, scale, variance, by_inertia, by_draft = (np.zeros((n, W)) for _ in range(5))
    if chassis is not None:
        weight, direction = chassis.mass * GRAVITY, window.direction
        pitch, roll = zero_if_unknown(window.pitch), zero_if_unknown(window.roll)
        static, _ = axle_loads(chassis, 0.0, 0.0, 0.0)
        upright = wheel_loads(chassis, rig.ahead, 0.0, 0.0, 0.0)
    for i, row in enumerate(given.load):
        if row.kind == "channel":
            load[:, i] = scale[:, i] = window.load[:, row.at]
            variance[:, i] = window.variance["load"][:, row.at]
            continue
        assert chassis is not None  # `rig_of` sees to it
        if row.kind == "weight":
            scale[:, i], variance[:, i] = weight * np.cos(pitch), (given.load_noise / 2.0 * weight) ** 2
            load[:, i] = scale[:, i] + _heave(window, rig, given)
        elif row.kind == "transfer":
            along = direction * pitch, direction * zero_if_unknown(window.acceleration)
            draft, draft_var = _draft_on_hitch(window, rig, given, torque)
            front, rear = axle_loads(chassis, direction * draft, *along)
            share = static / weight
            load[:, i] = (1.0 - share) * front - share * rear
            scale[:, i] = static
            by_inertia[:, i] = -direction * chassis.cg_height / chassis.wheelbase
            knows_slope = np.isfinite(window.pitch) | rig.specific_force
            by_inertia[~(np.isfinite(window.acceleration) & knows_slope), i] = 0.0
            by_draft[:, i] = -direction * np.isfinite(window.draft) * chassis.hitch_height / chassis.wheelbase
            of_pitch = np.where(by_inertia[:, i] == 0.0, GRAVITY**2 * _known_var(window, "pitch"), 0.0)
            variance[:, i] = (
                (given.load_noise / 2.0 * min(static, weight - static)) ** 2
                + (chassis.mass * chassis.cg_height / chassis.wheelbase) ** 2 * of_pitch
                + np.where(by_draft[:, i] == 0.0, (chassis.hitch_height / chassis.wheelbase) ** 2 * draft_var, 0.0)
            )
        elif row.kind == "frame":
            scale[:, i] = upright[rig.ahead == rig.ahead[row.at]].sum()
            variance[:, i] = (given.load_noise * np.linalg.norm(np.array(row.weight) * upright)) ** 2
        else:  # left less right
            axle = float(upright[rig.ahead == rig.ahead[row.at]].sum())
            lever = 0.0 if rig.track is None else chassis.cg_height / rig.track
            load[:, i] = -2.0 * axle * lever * np.sin(roll)
            scale[:, i] = axle
            of_slope = np.where(
                np.isfinite(window.roll),
                (2.0 * axle * lever) ** 2 * _known_var(window, "roll"),
                (rig.options.measurements.unknown_slope * axle) ** 2,
            )
            variance[:, i] = (given.load_noise * axle) ** 2 / 2.0 + of_slope
    return scale, variance, load, by_inertia, by_draft


def _heave(window: Window, rig: Rig, given: Instrumentation) -> Array:
    """What measured loads hold beyond weight, pitch, acceleration and draft, less its mean in the window (N,) [N]."""
    # An axle bounces on its own tyres: with a dynamic index near one the other one does not lose what it gains
    # (Wong 2008, ch. 7, pitch and bounce).  Zero where no draft is known, which shifts load between axles.
    channels = [row for row in given.load if row.kind == "channel"]
    if rig.chassis is None or not channels:
        return np.zeros(len(window.t))
    direction = window.direction
    along = direction * zero_if_unknown(window.pitch), direction * zero_if_unknown(window.acceleration)
    of_wheels = wheel_loads(rig.chassis, rig.ahead, direction * window.draft, *along)
    beyond = np.sum([window.load[:, row.at] - np.array(row.weight) @ of_wheels for row in channels], axis=0)
    known = np.isfinite(beyond)
    return np.where(known, beyond - np.mean(beyond[known]), 0.0) if known.any() else np.zeros(len(window.t))


def _draft_on_hitch(window: Window, rig: Rig, given: Instrumentation, torque: Array) -> tuple[Array, Array]:
    """Draft [N] for the loads, and its variance: where none is measured, at most what the wheels' torques leave it."""
    mass = 0.0 if rig.chassis is None else rig.chassis.mass
    known, most = np.isfinite(window.draft), rig.options.measurements.largest_draft * mass * GRAVITY
    along = zero_if_unknown(window.acceleration) + GRAVITY * np.sin(zero_if_unknown(window.pitch))
    left = np.clip((torque / rig.radius).sum(axis=1) - mass * along, 0.0, most)
    is_measured = np.isfinite(left) & all(row.kind != "unknown" for row in given.torque)
    bound = np.where(is_measured, left, most)  # the draft is anywhere from 0 to it
    return np.where(known, window.draft, bound / 2.0), np.where(known, _known_var(window, "draft"), bound**2 / 12.0)


def _known_var(window: Window, quantity: str) -> Array:
    variance = window.variance[quantity]
    return np.where(np.isfinite(getattr(window, quantity)) & np.isfinite(variance), variance, 0.0)


def _speeds(window: Window, rig: Rig, given: Instrumentation) -> tuple[Array, Array]:
    """Observations of the wheels' speeds and their variances, each (N, W)."""
    speed, variance = np.zeros((2, len(window.t), len(given.speed)))
    options = rig.options.measurements
    rolling = window.ground_speed[:, None] / rig.radius / (1.0 - options.rolling_slip)
    for i, row in enumerate(given.speed):
        if row.kind == "channel":
            speed[:, i], variance[:, i] = window.speed[:, row.at], window.variance["speed"][:, row.at]
        elif row.kind == "coupling":
            relative = np.where(_locked(window, given.couplings[row.at]), 0.0, 2.0 * options.slip_sd)
            size = np.abs(np.array(row.weight)) @ np.nan_to_num(rolling).T / 2.0
            variance[:, i] = (relative * size) ** 2
        elif row.kind != "same":  # what turns together has no difference
            speed[:, i] = rolling[:, row.at]
            variance[:, i] = (options.slip_sd * rolling[:, row.at]) ** 2
    return speed, variance


def _torque_variances(window: Window, given: Instrumentation, torque: Array) -> Array:
    """Variances of the rows of torques (N, W), by torques of the wheels (N, W); nan where a row says nothing."""
    variance = np.zeros_like(torque)
    for i, row in enumerate(given.torque):
        if row.kind == "channel":
            variance[:, i] = window.variance["torque"][:, row.at]
        elif row.kind in ("free", "unknown"):
            variance[:, i] = np.nan
        else:
            weight, coupling = np.abs(np.array(row.weight)), given.couplings[row.at]
            size = np.abs(zero_if_unknown(torque)) @ weight
            may_be_locked = _locked(window, coupling) | (coupling.is_switched & np.isnan(window.differential_lock))
            variance[:, i] = np.where(may_be_locked, np.nan, (coupling.bias * size) ** 2)
    return variance


def _locked(window: Window, coupling: Coupling) -> NDArray[np.bool_]:
    """At which instants (N,) a differential is locked."""
    return np.asarray((coupling.of_axle & (zero_if_unknown(window.differential_lock) > 0.5)) | coupling.locked)


def rows_in(rig: Rig, quantity: str) -> tuple[Row, ...]:
    """Return the rows of torques, loads or speeds; without an instrumentation a channel of each wheel."""
    if rig.instrumentation is not None:
        found: tuple[Row, ...] = getattr(rig.instrumentation, quantity)
        return found
    return _own_channels(rig.wheels, rig.noise[quantity].gain)


@lru_cache(64)
def _own_channels(wheels: tuple[str, ...], gain: float) -> tuple[Row, ...]:
    """A channel of each wheel, of one sd of gain."""
    return tuple(Row(unit(len(wheels), i), "channel", i, name, gain) for i, name in enumerate(wheels))


def channel_value(rig: Rig, quantity: str, name: str, of_wheels: Array) -> Array:
    """Return what the channel of a wheel or axle reads (N,) where the wheels have these values (W, N)."""
    rows: Sequence[Row] = () if rig.instrumentation is None else getattr(rig.instrumentation, quantity, ())
    for row in rows:
        if row.kind == "channel" and row.name == name:
            return np.asarray(np.array(row.weight) @ of_wheels)
    return np.asarray(of_wheels[rig.wheels.index(name)])
