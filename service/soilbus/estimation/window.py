"""Window: bin means of the measured channels on one time base, each mean with its variance.

    mean_b = sum of samples / n,    var(mean_b) = (absolute^2 + (relative mean_b)^2 + (of_mean level)^2) / n

Sensors have their own rates and phases.  Averaging over short bins brings them onto one time base and makes the noise
small enough to be propagated through the model linearly.  A bin without an admitted sample holds nan: a missing value
is never zero.  `forward` mirrors reversing, `steady` goes on between the samples of a slope, `turning` finds turns;
`NoiseTable` holds the sensors' noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.local_cubics import Curve
from soilbus.estimation.options import ESTIMATOR, EstimatorOptions
from soilbus.terra.vehicle import Chassis, pull_required

if TYPE_CHECKING:
    from soilbus.estimation.instrumentation import Instrumentation, Observations

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
TIME_TOLERANCE = 1e-3
"""Times [s] closer than this are those of one bin."""
VEHICLE_QUANTITIES = (
    "ground_speed", "draft", "pitch", "acceleration", "yaw_rate", "roll", "steering_angle", "differential_lock",
)  # fmt: skip
"""Quantities that the vehicle has one channel of."""
ALONG = ("torque", "speed", "ground_speed", "draft", "pitch", "acceleration", "yaw_rate")
"""Quantities that change their sign where the vehicle reverses."""
LEAST_LEVEL = {
    "torque": 50.0, "load": 500.0, "speed": 0.4, "sinkage": 0.01,
    "ground_speed": 0.2, "draft": 500.0, "pitch": 0.01, "acceleration": 0.1, "yaw_rate": 0.02,
    "roll": 0.01, "steering_angle": 0.02, "differential_lock": 1.0,
}  # fmt: skip
"""Magnitudes (SI) below which relative noise shrinks no further in the outlier test: a sensor at rest still
has its resolution and its zero error.  No evidence recorded."""


class SensorNoise(NamedTuple):
    """Noise of a channel; the first three add in quadrature."""

    absolute: float = 0.0  # sd of a sample in SI
    relative: float = 0.0  # sd over its value
    of_mean: float = 0.0  # sd over the channel's mean magnitude in the window
    gain: float = 0.0  # sd of a constant relative gain error


@dataclass(frozen=True, slots=True)
class Rig:
    """The vehicle or test rig: W wheels, their geometry, the sensors' noise."""

    wheels: tuple[str, ...]
    radius: Array  # (W,) [m], as width
    width: Array
    ahead: Array  # (W,), distance to the last axle over the wheelbase: 1 on the front axle
    chassis: Chassis | None  # None for a test rig, whose drawbar pull is measured as draft
    noise: Mapping[str, SensorNoise]
    track: float | None = None  # distance [m] between the left and the right wheels, where known
    driven: NDArray[np.bool_] | None = None  # (W,), which wheels a motor can drive; None for all
    # what is measured, where that is not a torque, a speed and a load of each wheel
    instrumentation: Instrumentation | None = None
    # names (W,) of a quantity's columns in the raw window, where these are not the wheels'
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    towing: str = "measured"  # as `config.model.Vehicle.towing`
    specific_force: bool = False  # whether the accelerometer measures dv/dt + g sin(pitch)
    # of a vehicle that steers by the speeds of its sides: greatest lateral over longitudinal sliding speed
    max_lateral: float | None = None
    lengths: Array | None = None  # (W,) [m], contact lengths of tracks, 0 of wheels; None where all are wheels
    mass_std: float = 0.0  # relative sd of the mass in `chassis` [1], as far as decisions reckon with it
    options: EstimatorOptions = ESTIMATOR

    @property
    def mean_width(self) -> float:
        """Mean width [m] of the tyres."""
        return float(self.width.mean())

    @property
    def length(self) -> Array | float:
        """Contact lengths [m] (W,); the number 0 where all are wheels."""
        return 0.0 if self.lengths is None else self.lengths

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of all channels, wheel quantities first."""
        per_wheel = tuple(
            f"{q}.{name or w}" for q in WHEEL_QUANTITIES
            for w, name in zip(self.wheels, self.names.get(q, self.wheels), strict=True)
        )  # fmt: skip
        return per_wheel + VEHICLE_QUANTITIES

    @property
    def front(self) -> NDArray[np.bool_]:
        """Which wheels are on the front axle (W,)."""
        return np.asarray(self.ahead == 1.0)

    @property
    def axles(self) -> list[list[int]]:
        """The wheels of each axle, from the front to the rear."""
        ahead = self.ahead.tolist()
        return [[i for i, at in enumerate(ahead) if at == axle] for axle in sorted(set(ahead), reverse=True)]

    @property
    def drives(self) -> NDArray[np.bool_]:
        """Which wheels a motor can drive (W,)."""
        return np.ones(len(self.wheels), bool) if self.driven is None else self.driven


@dataclass(frozen=True, slots=True)
class Window:
    """Bin means of one window and the variances of those means, in SI; nan where missing.

    The quantities of wheels have shape (N, W), those of the vehicle (N,); yaw_rate is positive to the left.  `variance`
    holds an array of the same shape for each.  `curves` are smooth curves of the samples by channel, where computed.
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
    curves: Mapping[str, Curve] = field(default_factory=dict)
    roll: Array = field(default_factory=lambda: np.empty(0))
    steering_angle: Array = field(default_factory=lambda: np.empty(0))
    differential_lock: Array = field(default_factory=lambda: np.empty(0))
    # (N,), -1 where the vehicle reversed before `forward`, else 1
    direction: Array = field(default_factory=lambda: np.empty(0))
    observations: Observations | None = None  # of `instrumentation.completed`
    # (N, W), relative sd of V / omega within an instant; 0 in single bins
    swing: Array = field(default_factory=lambda: np.empty((0, 0)))
    kinematic: bool = False  # whether an acceleration that was a specific force has become dv/dt

    def __post_init__(self) -> None:
        if len(self.swing) != len(self.t):
            object.__setattr__(self, "swing", np.zeros(self.speed.shape))
        for quantity in ("yaw_rate", "roll", "steering_angle", "differential_lock", "direction"):
            if len(getattr(self, quantity)) != len(self.t):
                object.__setattr__(self, quantity, np.full(len(self.t), 1.0 if quantity == "direction" else np.nan))

    def rows(self, keep: NDArray[np.intp] | slice) -> Window:
        """Return the window with the given bins only; a slice copies nothing."""
        values: dict[str, Any] = {q: getattr(self, q)[keep] for q in (*WHEEL_QUANTITIES, *VEHICLE_QUANTITIES)}
        given = self.observations
        return replace(
            self,
            t=self.t[keep],
            variance={q: v[keep] for q, v in self.variance.items()},
            direction=self.direction[keep],
            swing=self.swing[keep],
            observations=given and type(given)(*[column[keep] for column in given]),
            **values,
        )


def forward(window: Window) -> Window:
    """Return the window with every instant of reversing turned into the same drive forward: wheel speeds >= 0.

    A smooth wheel is its own mirror image: in reverse all quantities along the ground change their sign and no others
    do; the ground speed becomes its magnitude, as a radar's has no sign.  Which axle runs in the other's ruts is not
    mirrored.  A vehicle reverses where more of its wheels turn backward than forward.  The speed of a wheel that turns
    against the majority is nan, and so are all speeds without a majority.
    """
    if not (window.speed < 0.0).any():
        return window
    with np.errstate(invalid="ignore"):
        turns = np.sign(window.speed)
    majority = np.sign(np.nansum(turns, axis=1))
    direction = np.where(majority < 0.0, -1.0, 1.0)
    undecided = (majority == 0.0) & (np.abs(turns) > 0.0).any(axis=1)
    speed = direction[:, None] * window.speed
    curves = {name: _ahead(name.partition(".")[0], curve, window.t, direction) for name, curve in window.curves.items()}
    return replace(
        window,
        speed=np.where((speed < 0.0) | undecided[:, None], np.nan, speed),
        torque=direction[:, None] * window.torque,
        ground_speed=np.where(direction < 0.0, np.abs(window.ground_speed), window.ground_speed),
        draft=direction * window.draft,
        pitch=direction * window.pitch,
        acceleration=direction * window.acceleration,
        yaw_rate=direction * window.yaw_rate,
        direction=direction,
        curves=curves,
    )


def _ahead(quantity: str, curve: Curve, t: Array, direction: Array) -> Curve:
    """Return the curve of a quantity in the same drive forward; direction (N,) at times t (N,) [s] as in Window."""
    if quantity not in ALONG:
        return curve
    way = np.where(np.interp(curve.t, t, direction) < 0.0, -1.0, 1.0)
    return curve.times(np.where(way < 0.0, np.sign(curve.value), 1.0) if quantity == "ground_speed" else way)


def turning(window: Window, rig: Rig, max_turn: float) -> NDArray[np.bool_]:
    """Return whether the vehicle turns too sharply for one ground speed, at each instant (N,) of a forward window.

    max_turn: relative difference of the rim speeds of an axle above which an instant is in a turn.

    Notes
    -----
    With track B and yaw rate r the ground speeds of an axle's wheels differ by B r.  Where r is known it decides: rim
    speeds that differ without it are wheel spin.  Without a known track the rim speeds must show a turn to the side of
    r, by a difference that a possible track explains.

    Without r the rim speeds decide.  In a turn the wheels of one side are the faster ones on every axle, by relative
    differences within a factor of two (steering angle, tracks), and no greater than about a centre one track away:
    steered tractors turn about centres at least 1.5 tracks away, and one side that spins while the other stands is at
    2.  Other patterns are slip.  An axle with an unknown speed or without two wheels is ignored.

    A vehicle that steers by the speeds of its sides slides sideways in every turn: the ratio of lateral to longitudinal
    sliding speed decides, too.
    """
    relative, difference = _rim_differences(window, rig)
    size = np.abs(relative)
    smallest, largest = np.fmin.reduce(size, axis=1, initial=np.inf), np.fmax.reduce(size, axis=1, initial=0.0)
    same_sign = np.abs(np.nansum(np.sign(relative), axis=1)) == np.isfinite(relative).sum(axis=1)
    by_rims = np.isfinite(smallest) & (smallest > max_turn) & (largest < 1.0)  # B/R = 1
    by_rims &= (largest < 2.0 * smallest) & same_sign
    yaw = window.yaw_rate
    if rig.max_lateral is not None and rig.chassis is not None:
        by_rims |= _slides(window, rig, rig.max_lateral, difference)
    if not np.isfinite(yaw).any():
        return np.asarray(by_rims)
    with np.errstate(invalid="ignore", divide="ignore"):
        if rig.track is not None:
            by_yaw = rig.track * np.abs(yaw) > max_turn * np.abs(window.ground_speed)
        else:
            track = difference / yaw[:, None]  # of the axle, if the difference is the turn's alone
            possible = np.isnan(track) | ((track > 0.3) & (track < 8.0))  # from a small rover to 3.2 m over 1 - slip
            by_yaw = by_rims & possible.all(axis=1)
    if rig.max_lateral is not None:
        by_yaw = by_yaw | by_rims
    return np.asarray(np.where(np.isfinite(yaw), by_yaw, by_rims))


def _slides(window: Window, rig: Rig, max_lateral: float, difference: Array) -> NDArray[np.bool_]:
    """Whether the wheels of a skid-steered vehicle slide sideways too much (N,)."""
    # A wheel half a wheelbase from the centre of yaw slides sideways at yaw L / 2 and along at r omega - V.
    # Without a yaw rate the rim speeds bound it: (right less left) / B, less what the sides slip.
    assert rig.chassis is not None
    yaw = np.abs(window.yaw_rate)
    if rig.track is not None:
        with np.errstate(invalid="ignore"):
            yaw = np.where(np.isfinite(yaw), yaw, np.abs(difference).max(axis=1, initial=0.0) / rig.track)
    rim = rig.radius * window.speed
    known = np.isfinite(rim)
    mean = np.where(known, rim, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    # below a slip of 0.05 a wheel's forces are small in both directions
    along = np.maximum(np.abs(mean - window.ground_speed), 0.05 * np.abs(window.ground_speed))
    with np.errstate(invalid="ignore"):
        return np.asarray(yaw * rig.chassis.wheelbase / 2.0 > max_lateral * along)


def _rim_differences(window: Window, rig: Rig) -> tuple[Array, Array]:
    """Right less left rim speed (N, P) of each pair: over their mean, and in m/s; nan where unknown."""
    left, right = (rig.radius * window.speed).T[pairs(rig)].swapaxes(1, 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        return 2.0 * (right - left) / (left + right), right - left


def pairs(rig: Rig) -> NDArray[np.intp]:
    """Return the left and right wheels (2, P) of the axles that have two; the left one is configured first."""
    return np.array([wheels for wheels in rig.axles if len(wheels) == 2], np.intp).reshape(-1, 2).T


class NoiseTable(NamedTuple):
    """Noise of a rig by channel: absolute variance, relative, of_mean, least level, each (channels,)."""

    n_wheels: int
    variance: Array
    relative: Array
    of_mean: Array
    least: Array

    @classmethod
    def of(cls, rig: Rig) -> NoiseTable:
        """Return the noise of a rig's channels."""
        noise = [rig.noise.get(name.partition(".")[0], SensorNoise()) for name in rig.channels]
        return cls(
            len(rig.wheels),
            np.array([n.absolute**2 for n in noise]),
            np.array([n.relative for n in noise]),
            np.array([n.of_mean for n in noise]),
            np.array([LEAST_LEVEL[name.partition(".")[0]] for name in rig.channels]),
        )

    def of_samples(self, values: Array, column: int) -> Array:
        """Return the variances (N,) of samples (N,) of the channel in this column."""
        fixed = self.variance[column] + (self.of_mean[column] * np.abs(values).mean()) ** 2
        return np.asarray(fixed + (self.relative[column] * values) ** 2)

    def sd(self, count: NDArray[np.intp], size: Array, level: Array) -> Array:
        """Return the sd (N,) of samples with magnitudes `size` (N,), sorted by channel.

        count, level: number of samples, and mean magnitude, of each of the first C channels.
        """
        least = self.least[: len(count)]
        fixed = self.variance[: len(count)] + (self.of_mean[: len(count)] * np.maximum(level, least)) ** 2
        sd = np.maximum(size, np.repeat(least, count))
        sd *= np.repeat(self.relative[: len(count)], count)
        np.multiply(sd, sd, out=sd)
        sd += np.repeat(fixed, count)
        return np.sqrt(sd, out=sd)


def made_window(noise: NoiseTable, t: Array, mean: Array, worth: Array, samples: int) -> Window:
    """Return a window from bin means (N, channels), in the order of `Rig.channels`, at times t (N,) [s].

    worth (N, channels): effective number of independent samples in each bin; 0 where it has no value.
    """
    variances = _by_quantity(_variance_of_means(mean, worth, noise), noise.n_wheels)
    return Window(t=t, variance=variances, samples=samples, **_by_quantity(mean, noise.n_wheels))


def _by_quantity(table: Array, n_wheels: int) -> dict[str, Any]:
    """The columns of each quantity in a table (N, channels): (N, W) of the wheels, (N,) of the vehicle."""
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
        return np.asarray(of_sample / count)


def window_of_samples(rig: Rig, t: Array, samples: Mapping[str, Array]) -> Window:
    """Return a window whose rows are single samples of channels by name; t [s] (N,)."""
    mean = np.full((len(t), len(rig.channels)), np.nan)
    for i, name in enumerate(rig.channels):
        if name in samples:
            mean[:, i] = samples[name]
    one = np.isfinite(mean).astype(float)
    return made_window(NoiseTable.of(rig), np.asarray(t, float), mean, one, int(one.sum()))


def zero_if_unknown(values: Array) -> Array:
    """Return the values with 0 in place of nan."""
    return np.where(np.isnan(values), 0.0, values)


def steady(window: Window) -> Window:
    """Return the window with gaps of pitch, roll and acceleration filled by straight lines, as loads need them."""
    changed: dict[str, Any] = {}
    variance, direction = dict(window.variance), window.direction
    for name, sign in (("pitch", direction), ("acceleration", direction), ("roll", np.ones(len(window.t)))):
        known = np.isfinite(values := getattr(window, name))
        if known.any() and not known.all():
            t = window.t, window.t[known]
            changed[name] = sign * np.interp(*t, (sign * values)[known])
            variance[name] = np.interp(*t, variance[name][known])
    return replace(window, variance=variance, **changed) if changed else window


def pull_asked(window: Window, chassis: Chassis) -> Array:
    """Return the pull [N] (N,) that draft and slope ask of the wheels; nan without draft, level without pitch."""
    return np.asarray(pull_required(chassis, window.draft, zero_if_unknown(window.pitch), 0.0))


def pull_given(window: Window, chassis: Chassis) -> Array:
    """Return `pull_asked` plus the force that accelerates the vehicle where acceleration is known."""
    return pull_asked(window, chassis) + inertia_of(window, chassis)


def inertia_of(window: Window, chassis: Chassis) -> Array:
    """Return the force [N] (N,) that accelerates the vehicle; 0 where acceleration is unknown."""
    return np.asarray(chassis.mass * zero_if_unknown(window.acceleration))
