"""Measured columns -> the bins of a window, each mean with its variance.

Sensors run at their own rates and phases.  Averaging over short bins brings them onto one
time base and makes the noise small enough to be carried through the model linearly.  A
bin without an admitted sample holds nan: missing is never zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.local_cubics import Series
from soilbus.terra.vehicle import Chassis, pull_required

__all__ = [
    "VEHICLE_QUANTITIES",
    "WHEEL_QUANTITIES",
    "NoiseTable",
    "Rig",
    "SensorNoise",
    "Window",
    "forward",
    "made_window",
    "turning",
    "window_of_samples",
]

WHEEL_QUANTITIES = ("torque", "load", "speed", "sinkage")
"""Quantities that each wheel has a channel of."""
VEHICLE_QUANTITIES = ("ground_speed", "draft", "pitch", "acceleration", "yaw_rate")
"""Quantities that the vehicle has one channel of."""
LEAST_LEVEL = {
    "torque": 50.0, "load": 500.0, "speed": 0.4, "sinkage": 0.01,
    "ground_speed": 0.2, "draft": 500.0, "pitch": 0.01, "acceleration": 0.1, "yaw_rate": 0.02,
}  # fmt: skip
"""Magnitudes (SI) below which a relative noise shrinks no further when samples are screened: a
sensor at rest still has its resolution and its zero."""


class SensorNoise(NamedTuple):
    """Sd of a sample (parts add in quadrature) and sd of a fixed relative gain error."""

    absolute: float = 0.0
    relative: float = 0.0
    of_mean: float = 0.0
    gain: float = 0.0


@dataclass(frozen=True, slots=True)
class Rig:
    """The vehicle as the estimator sees it: W wheels, their geometry, the sensors' noise.

    radius and width [m] have shape (W,); front tells which wheels are on the front axle;
    chassis is None for a test rig, whose drawbar pull is then measured directly as draft.
    """

    wheels: tuple[str, ...]
    radius: Array
    width: Array
    front: NDArray[np.bool_]
    chassis: Chassis | None
    noise: Mapping[str, SensorNoise]
    track: float | None = None
    """Distance [m] between the left and the right wheels, where known."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Every channel name the rig may have, wheel quantities first."""
        per_wheel = tuple(f"{q}.{w}" for q in WHEEL_QUANTITIES for w in self.wheels)
        return per_wheel + VEHICLE_QUANTITIES


@dataclass(frozen=True, slots=True)
class Window:
    """Bin means of one window and the variances of those means; nan where missing.

    torque [N m], load [N], speed [rad/s], sinkage [m] have shape (N, W); ground_speed
    [m/s], draft [N], pitch [rad], acceleration [m/s^2], yaw_rate [rad/s] (positive to the
    left; unknown where it is not given) have shape (N,).  `variance` holds an array of the
    same shape for each.  `curves` are the samples' own curves by channel, where they were made.
    """

    t: Array
    torque: Array
    load: Array
    speed: Array
    sinkage: Array
    ground_speed: Array
    draft: Array
    pitch: Array
    acceleration: Array
    variance: Mapping[str, Array]
    samples: int
    yaw_rate: Array = field(default_factory=lambda: np.empty(0))
    curves: Mapping[str, Series] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.yaw_rate) != len(self.t):
            object.__setattr__(self, "yaw_rate", np.full(len(self.t), np.nan))

    def rows(self, keep: NDArray[np.intp]) -> Window:
        """The window with only these bins."""
        values: dict[str, Any] = {q: getattr(self, q)[keep] for q in (*WHEEL_QUANTITIES, *VEHICLE_QUANTITIES)}
        return replace(self, t=self.t[keep], variance={q: v[keep] for q, v in self.variance.items()}, **values)


def forward(window: Window) -> Window:
    """The window with every instant of reversing turned into the same drive forward.

    A smooth wheel is its own mirror image: backwards, all that points along the ground
    changes its sign and nothing else does.  So wheel speed, torque, draft, pitch,
    acceleration and yaw rate are negated and the ground speed becomes its magnitude (a radar's has no
    sign anyway), while loads and sinkages stay.  The load transfer is in the measured
    loads, which stay with their wheels.  Not mirrored is what tells front from rear: which
    axle runs in the other's ruts, and lugs with a direction.

    A vehicle reverses where more of its wheels turn backward than forward; the speed of a
    wheel against most of the others is nan, and that of every wheel where neither side is
    in the majority.
    """
    if not (window.speed < 0.0).any():
        return window
    with np.errstate(invalid="ignore"):
        turns = np.sign(window.speed)
    majority = np.sign(np.nansum(turns, axis=1))
    way = np.where(majority < 0.0, -1.0, 1.0)
    torn = (majority == 0.0) & (np.abs(turns) > 0.0).any(axis=1)
    speed = way[:, None] * window.speed
    return replace(
        window,
        speed=np.where((speed < 0.0) | torn[:, None], np.nan, speed),
        torque=way[:, None] * window.torque,
        ground_speed=np.where(way < 0.0, np.abs(window.ground_speed), window.ground_speed),
        draft=way * window.draft,
        pitch=way * window.pitch,
        acceleration=way * window.acceleration,
        yaw_rate=way * window.yaw_rate,
        curves={},
    )


def turning(window: Window, rig: Rig, max_turn: float) -> NDArray[np.bool_]:
    """At which instants (N,) of a forward window the vehicle turns too sharply for one ground speed.

    On a turn of radius R with track B and yaw rate r = V/R, the ground speeds of the two
    wheels of an axle differ by B r, that is by B/R of their mean V, and each wheel's slip,
    taken from the speed of the vehicle's middle, is wrong by B/(2 R) (1 - slip).  An instant
    is in a turn where that relative difference exceeds `max_turn`.

    Where the yaw rate is known it decides: rim speeds that differ without it are wheel spin.
    With a track the difference is B r.  Without one the rim speeds must show a turn (below)
    to the side of the yaw rate, by a difference that a track could make of it.

    Without a yaw rate the rim speeds alone tell.  A turn makes the wheels of the same side the
    faster ones on every axle, by the same relative difference but for what steering angle and
    tracks make of it, and by no more than a turn about a centre one track away.  All else is
    slip: of one wheel, of one on each axle crosswise (open differentials), of all on one side
    while the others stand, or of one axle on a side slope.  An axle with an unknown speed, or
    not with two wheels, does not count; without any no instant is in a turn.
    """
    apart, faster = _rim_differences(window, rig)
    size = np.abs(apart)
    least, most = np.fmin.reduce(size, axis=1, initial=np.inf), np.fmax.reduce(size, axis=1, initial=0.0)
    one_way = np.abs(np.nansum(np.sign(apart), axis=1)) == np.isfinite(apart).sum(axis=1)
    by_rims = np.isfinite(least) & (least > max_turn) & (most < SHARPEST_TURN) & (most < UNLIKE_AXLES * least)
    by_rims &= one_way
    yaw = window.yaw_rate
    if not np.isfinite(yaw).any():
        return np.asarray(by_rims)
    with np.errstate(invalid="ignore", divide="ignore"):
        if rig.track is not None:
            by_yaw = rig.track * np.abs(yaw) > max_turn * np.abs(window.ground_speed)
        else:
            track = faster / yaw[:, None]  # of the axle, were nothing but the turn in it
            low, high = TRACKS
            by_yaw = by_rims & (np.isnan(track) | ((track > low) & (track < high))).all(axis=1)
    return np.asarray(np.where(np.isfinite(yaw), by_yaw, by_rims))


SHARPEST_TURN = 1.0
"""Relative difference of rim speeds of a turn about a centre one track from the vehicle's middle: B/R = 1.
Steered tractors turn about centres at least 1.5 tracks away; one side that spins while the other stands is at 2."""
UNLIKE_AXLES = 2.0
"""Ratio of the axles' relative differences in one turn.  The front axle's is less by the square of the cosine of the
steering angle (1/2 at 45 degrees), the slower inner wheels of both slip about alike."""
TRACKS = (0.3, 8.0)
"""Tracks [m] of wheeled vehicles, from small rovers to 3.2 m, the latter over 1 - slip for slips up to 0.6."""


def _rim_differences(window: Window, rig: Rig) -> tuple[Array, Array]:
    """Right less left rim speed (N, P) of each pair: over their mean, and in m/s; nan where unknown."""
    left, right = (rig.radius[side] * window.speed[:, side] for side in pairs(rig))
    with np.errstate(invalid="ignore", divide="ignore"):
        return 2.0 * (right - left) / (left + right), right - left


def pairs(rig: Rig) -> NDArray[np.intp]:
    """Left and right wheels (2, P) of the axles that have two; the left one is configured first."""
    return _pairs(tuple(rig.front.tolist()))


@cache
def _pairs(front: tuple[bool, ...]) -> NDArray[np.intp]:
    axles = [[i for i, is_front in enumerate(front) if is_front == wanted] for wanted in (True, False)]
    return np.array([wheels for wheels in axles if len(wheels) == 2], np.intp).reshape(-1, 2).T


class NoiseTable(NamedTuple):
    """A rig's noise, column by column of its channels: variance, relative, of_mean, least level (channels,)."""

    n_wheels: int
    variance: Array
    relative: Array
    of_mean: Array
    least: Array

    @classmethod
    def of(cls, rig: Rig) -> NoiseTable:
        noise = [rig.noise[name.partition(".")[0]] for name in rig.channels]
        return cls(
            len(rig.wheels),
            np.array([n.absolute**2 for n in noise]),
            np.array([n.relative for n in noise]),
            np.array([n.of_mean for n in noise]),
            np.array([LEAST_LEVEL[name.partition(".")[0]] for name in rig.channels]),
        )

    def of_samples(self, values: Array, column: int) -> Array:
        """Variances (N,) of samples (N,) of the channel with this number."""
        fixed = self.variance[column] + (self.of_mean[column] * np.abs(values).mean()) ** 2
        return np.asarray(fixed + (self.relative[column] * values) ** 2)

    def sd(self, count: NDArray[np.intp], size: Array, level: Array) -> Array:
        """Sd (N,) of samples of magnitudes `size` (N,), channel after channel.

        count (C,) of them are of each of the first channels, whose mean magnitudes are level (C,).
        """
        least = self.least[: len(count)]
        fixed = self.variance[: len(count)] + (self.of_mean[: len(count)] * np.maximum(level, least)) ** 2
        sd = np.maximum(size, np.repeat(least, count))
        sd *= np.repeat(self.relative[: len(count)], count)
        np.multiply(sd, sd, out=sd)
        sd += np.repeat(fixed, count)
        return np.sqrt(sd, out=sd)


def made_window(noise: NoiseTable, t: Array, mean: Array, worth: Array, count: Array) -> Window:
    """A window from bin means, the samples they are worth and those in them, (N, channels) as rig.channels."""
    variance = _variance_of_means(mean, np.where(count > 0.0, worth, 0.0), noise)
    values, variances = _by_quantity(mean, noise.n_wheels), _by_quantity(variance, noise.n_wheels)
    return Window(t=t, variance=variances, samples=int(count.sum()), curves={}, **values)


def _by_quantity(table: Array, n_wheels: int) -> dict[str, Array]:
    """The columns (N, channels) of each quantity: (N, W) of the wheels', (N,) of the vehicle's."""
    wheels = {q: table[:, i * n_wheels : (i + 1) * n_wheels] for i, q in enumerate(WHEEL_QUANTITIES)}
    first = len(WHEEL_QUANTITIES) * n_wheels
    return wheels | {q: table[:, first + i] for i, q in enumerate(VEHICLE_QUANTITIES)}


def _variance_of_means(mean: Array, count: Array, noise: NoiseTable) -> Array:
    """Variances (N, channels) of bin means; not finite where a bin is empty."""
    of_sample = noise.variance + np.where(noise.relative != 0.0, (noise.relative * mean) ** 2, 0.0)
    if noise.of_mean.any():
        size = np.abs(mean)
        known = np.isfinite(size)
        level = np.where(known, size, 0.0).sum(0) / np.maximum(known.sum(0), 1)
        of_sample += (noise.of_mean * level) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        variance: Array = of_sample / count
    return variance


def window_of_samples(rig: Rig, t: Array, samples: Mapping[str, Array], names: Sequence[str] = ()) -> Window:
    """A window whose every row is one sample of each named channel (tables, tests)."""
    mean = np.full((len(t), len(rig.channels)), np.nan)
    for i, name in enumerate(rig.channels):
        if name in samples and (not names or name in names):
            mean[:, i] = samples[name]
    one = np.isfinite(mean).astype(float)
    return made_window(NoiseTable.of(rig), np.asarray(t, float), mean, one, one)


def zero_if_unknown(values: Array) -> Array:
    """The same values with 0 in the place of nan."""
    return np.where(np.isnan(values), 0.0, values)


def pull_asked(window: Window, chassis: Chassis) -> Array:
    """Pull [N] (N,) that draft and slope ask of the wheels; nan without draft, level where the slope is not known."""
    return np.asarray(pull_required(chassis, window.draft, zero_if_unknown(window.pitch), 0.0))


def pull_given(window: Window, chassis: Chassis) -> Array:
    """As `pull_asked`, with what the wheels give to speed up where the acceleration is known."""
    return pull_asked(window, chassis) + inertia_of(window, chassis)


def inertia_of(window: Window, chassis: Chassis) -> Array:
    """Force [N] (N,) that speeds the vehicle up; none where the acceleration is not known."""
    return np.asarray(chassis.mass * zero_if_unknown(window.acceleration))
