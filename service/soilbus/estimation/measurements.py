"""A window's data as the model wants it: what is usable, in which instants, with which variance."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.local_cubics import Series
from soilbus.estimation.window import Rig, Window, forward, turning
from soilbus.terra.vehicle import GRAVITY

Reading = tuple[Array, Array, NDArray[np.bool_]]
"""Values, variances of them, and which of them are known; zero where not."""

MAX_SLIP = 0.98
MIN_SLIP = -1.0
BENT = 6.0
"""Standard deviations by which cubics must differ from lines to be taken."""
GAIN_QUANTITIES = ("torque", "load", "speed", "ground_speed", "draft")

_BY_INSTANT = (
    "t", "usable", "torque", "torque_var", "has_torque", "sinkage", "sinkage_var", "has_sinkage", "load", "load_var",
    "speed", "speed_var", "ground_speed", "ground_speed_var", "slip", "draft", "draft_var", "demand", "demand_var",
    "has_balance", "pitch", "since", "distance", "wheel_angle", "acceleration", "acceleration_var",
    "_measured", "_measured_var", "_row_var", "_known",
)  # fmt: skip
"""Attributes of a window's problem with a row for each instant."""


def gain_names(rig: Rig) -> list[str]:
    """Names of the sensors' gain errors, in the order of every window's."""
    per_wheel = ("torque", "load", "speed")
    return [n for q in GAIN_QUANTITIES for n in ([f"{q}.{w}" for w in rig.wheels] if q in per_wheel else [q])]


class Measurements:
    """The usable instants (N) of a window: arrays (N, W) of the wheels and (N,) of the vehicle, in SI.

    Each has its variance and a mask of what is known; both are zero where it is not.
    `standstill` and `turning` count instants left out; reversing counts as driving forward.
    """

    def __init__(self, window: Window, rig: Rig, min_speed: float, max_turn: float) -> None:
        self.rig = rig
        self._curves = Curves(forward(window), rig.wheels)
        window = self._curves.window
        n_wheels = len(rig.wheels)
        moving, in_turn = window.ground_speed > min_speed, turning(window, rig, max_turn)
        straight = moving & ~in_turn
        rim = rig.radius * window.speed
        with np.errstate(invalid="ignore", divide="ignore"):
            slip = 1.0 - window.ground_speed[:, None] / rim
            usable = straight[:, None] & (window.load > 0.0) & (rim > 0.0) & (slip < MAX_SLIP) & (slip > MIN_SLIP)
        kept = np.flatnonzero(usable.any(axis=1))
        self.standstill = int(np.count_nonzero(~moving & np.isfinite(window.ground_speed)))
        self.turning = int(np.count_nonzero(moving & in_turn))
        self.t = window.t[kept]
        self.usable = usable = usable[kept]
        self.n_wheels = n_wheels

        def take(quantity: str) -> Reading:
            value = getattr(window, quantity)[kept]
            variance = window.variance[quantity][kept]
            known = np.isfinite(value) & np.isfinite(variance)
            return np.where(known, value, 0.0), np.where(known, variance, 0.0), known

        self.torque, self.torque_var, known = take("torque")
        self.has_torque = known & usable
        self.sinkage, self.sinkage_var, known = take("sinkage")
        self.has_sinkage = known & usable
        self.with_sinkage = bool(self.has_sinkage.any())
        load, load_var, _ = take("load")
        speed, speed_var, _ = take("speed")
        self.ground_speed, self.ground_speed_var, _ = take("ground_speed")
        # Unusable wheel-instants get a harmless stand-in; none of their rows counts.
        self.load = np.where(usable, load, 1e3)
        self.speed = np.where(usable, speed, self.ground_speed[:, None] / (0.8 * rig.radius))
        self.load_var, self.speed_var = np.where(usable, load_var, 0.0), np.where(usable, speed_var, 0.0)
        self.since, self.distance = travelled(self.t, self.ground_speed, window.t)
        self.duration = float(window.t[-1] - window.t[0]) if len(window.t) else 0.0
        self.length = float(self.distance[-1]) if len(self.distance) else 0.0
        self.wheel_angle = turned(self.t, self.speed)
        self._balance(take, usable)
        self.gain_names = gain_names(rig)
        self.gain_std = np.array([rig.noise[name.partition(".")[0]].gain for name in self.gain_names])
        self.n_sensors = len(self.gain_names)
        self.slip = slip[kept]
        self._measured = np.concatenate([self.load, self.speed, self.ground_speed[:, None]], axis=1)
        self._measured_var = np.concatenate([self.load_var, self.speed_var, self.ground_speed_var[:, None]], axis=1)
        known_rows = [self.has_torque, self.has_balance[:, None], self.has_sinkage]
        row_var = [self.torque_var, self.demand_var[:, None], self.sinkage_var]
        n_kinds = 3 if self.with_sinkage else 2
        known = np.concatenate(known_rows[:n_kinds], axis=1)
        self._row_var = np.where(known, np.concatenate(row_var[:n_kinds], axis=1), 1.0)
        self._known = known
        self._count()

    def _count(self) -> None:
        """What follows from the number of instants and the masks."""
        self.n = len(self.t)
        self._n_known = int(self._known.sum())
        self._missing = None if self._n_known == self._known.size else ~self._known
        self._radius, self._width = (np.tile(a, self.n) for a in (self.rig.radius, self.rig.width))

    def _balance(self, take: Callable[[str], Reading], usable: NDArray[np.bool_]) -> None:
        """The pull that draft, slope and inertia ask of the wheels, and its variance."""
        self.draft, draft_var, known = take("draft")
        self.with_pitch = False
        demand, variance = self.draft.copy(), draft_var.copy()
        acceleration, acceleration_var = np.zeros_like(demand), np.zeros_like(demand)
        self.pitch = np.zeros_like(demand)
        if self.rig.chassis is not None:
            mass = self.rig.chassis.mass
            pitch, pitch_var, has_pitch = take("pitch")
            self.with_pitch = bool(has_pitch.any())
            if self.with_pitch:
                known = known & has_pitch
            acceleration, acceleration_var, has_acceleration = take("acceleration")
            if has_acceleration.any():
                known = known & has_acceleration
            else:
                acceleration, acceleration_var = differentiated_speed(self.t, self.ground_speed, self.ground_speed_var)
            demand += mass * (GRAVITY * np.sin(pitch) + acceleration)
            variance += mass**2 * ((GRAVITY * np.cos(pitch)) ** 2 * pitch_var + acceleration_var)
            self.pitch = pitch
        self.acceleration, self.acceleration_var = acceleration, acceleration_var
        self.demand, self.demand_var = demand, variance
        self.draft_var = np.where(known & usable.all(axis=1), draft_var, 0.0)
        self.has_balance = known & usable.all(axis=1)

    @property
    def _n_residuals(self) -> int:
        """Residuals of an instant."""
        return int(self._row_var.shape[1])

    @property
    def n_rows(self) -> int:
        """Number of residuals that count."""
        return self._n_known

    def sample_time(self, quantity: str) -> float:
        """Time [s] between a quantity's samples, the longest of its channels; 0 where only bins are known."""
        names = (quantity, *(f"{quantity}.{wheel}" for wheel in self.rig.wheels))
        curves = self._curves.window.curves
        return max((curves[name].smooth.step for name in names if name in curves), default=0.0)

    def part(self, instants: slice | NDArray[np.intp]) -> Self:
        """The same with only these of its instants."""
        part = copy(self)
        for name in _BY_INSTANT:
            setattr(part, name, getattr(self, name)[instants])
        part._count()
        return part


class Curves:
    """A window's measured series as smooth curves, made when they are asked for."""

    def __init__(self, window: Window, wheels: tuple[str, ...]) -> None:
        self.window = window
        self._wheels = wheels
        self._made: dict[str, list[Series]] = {}

    def of(self, quantity: str) -> list[Series]:
        """One curve for each wheel, or one for the vehicle."""
        if quantity not in self._made:
            values, variances = getattr(self.window, quantity), self.window.variance[quantity]
            names = [quantity] if values.ndim == 1 else [f"{quantity}.{wheel}" for wheel in self._wheels]
            if all(name in self.window.curves for name in names):
                return self._made.setdefault(quantity, [self.window.curves[name] for name in names])
            columns = values.reshape(len(self.window.t), -1), variances.reshape(len(self.window.t), -1)
            self._made[quantity] = [self._curve(v, var) for v, var in zip(*(c.T for c in columns), strict=True)]
        return self._made[quantity]

    def number_of(self, quantity: str) -> int:
        """How many curves `of` returns; it makes none."""
        values = getattr(self.window, quantity)
        return 1 if values.ndim == 1 else int(values.shape[1])

    def _curve(self, values: Array, variance: Array) -> Series:
        known = np.isfinite(values) & np.isfinite(variance)
        return Series.of(self.window.t[known], values[known], variance[known])


def travelled(t: Array, ground_speed: Array, window: Array) -> tuple[Array, Array]:
    """Time [s] and distance [m] (N,) of instants t (N,) since the first bin of a window at times (M,)."""
    if not len(t):
        return np.zeros(0), np.zeros(0)
    mean = (ground_speed[1:] + ground_speed[:-1]) / 2.0
    first = ground_speed[0] * (t[0] - window[0])
    return t - window[0], np.concatenate([[0.0], np.cumsum(mean * np.diff(t))]) + first


def turned(t: Array, speed: Array) -> Array:
    """Angles [rad] (N, W) that wheels of these speeds [rad/s] (N, W) have turned since the first of times t (N,)."""
    steps = (speed[1:] + speed[:-1]) / 2.0 * np.diff(t)[:, None]
    return np.concatenate([np.zeros((min(len(t), 1), speed.shape[1])), np.cumsum(steps, axis=0)])


def differentiated_speed(t: Array, speed: Array, variance: Array, half_width: int = 3) -> tuple[Array, Array]:
    """Acceleration [m/s^2] and its variance from ground speed by local polynomials.

    t [s], speed [m/s] and variance of speed, all (N,).  Straight lines where the data show
    no more; cubics, which follow harsh driving and are noisier, where the two differ by
    more than noise does (lines then flatten every swing, and the vehicle seems lighter
    than it is).  The misfit adds to the variance, so that harsh driving is not mistaken for
    a precise reading.
    """
    n = len(t)
    if n < 3:
        return np.zeros(n), np.full(n, 1.0 if n else np.inf)
    lines = _slopes(t, speed, variance, half_width, 1)
    if n < 2 * half_width + 3:
        return lines.value, lines.variance
    cubics = _slopes(t, speed, variance, half_width + 1, 3)
    difference = cubics.weights - np.pad(lines.weights, ((0, 0), (1, 1)))
    noise = float((difference**2 * variance[cubics.near]).sum())
    square = float(((cubics.value - lines.value) ** 2).sum())
    bent = square > noise * (1.0 + BENT * math.sqrt(2.0 * (half_width + 1) / n))
    chosen = cubics if bent else lines
    return chosen.value, chosen.variance


class _Slopes(NamedTuple):
    """Slopes at all instants (N,) with their variances; weights (N, 2 half_width + 1) of the speeds at `near`."""

    value: Array
    variance: Array
    weights: Array
    near: NDArray[np.intp]


def _slopes(t: Array, speed: Array, variance: Array, half_width: int, degree: int) -> _Slopes:
    """Slope at each instant of a polynomial through it and its neighbours, fewer of them at the ends."""
    n = len(t)
    places = np.arange(n)[:, None] + np.arange(-half_width, half_width + 1)
    there, near = (places >= 0) & (places < n), np.clip(places, 0, n - 1)
    powers = (t[near] - t[:, None])[:, :, None] ** np.arange(degree + 1) * there[:, :, None]
    fit = np.linalg.pinv(powers)  # (N, degree + 1, 2 half_width + 1), zero where nobody is
    values = speed[near]
    misfit = np.where(there, values - (powers @ (fit @ values[:, :, None]))[:, :, 0], 0.0)
    count = there.sum(axis=1)
    spread = np.maximum((variance[near] * there).sum(1) / count, (misfit**2).sum(1) / np.maximum(count - degree - 1, 1))
    weights = fit[:, 1]
    return _Slopes((weights * values).sum(1), spread * (weights**2).sum(1), weights, near)
