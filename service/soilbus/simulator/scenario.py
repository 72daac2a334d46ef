"""Scenarios: what the simulated tractor is asked to do. Soils along the route, speed, and draft or slip.

    swing(t) = base + gain sum_k sin(omega_k t + phi_k),   k = 1..4,  scaled into low..high

A scenario is plain data; the seed of the simulation picks one realisation of its random waves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.simulator.course import NORTHWARD, Course
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import Soil

__all__ = [
    "SAMPLE_RATE", "Patch", "Profile", "Scenario", "Swing", "Wave", "demo", "excited", "oscillation", "realise",
    "soil_along", "soil_names",
]  # fmt: skip

SAMPLE_RATE = 50.0
"""Samples of the true values a second [Hz]."""
_N_SINES = 4
_BOUNCE_BAND = (1.5, 3.0)
"""Natural frequencies [Hz] of a tractor's bounce and of an axle's roll on its tyres (Wong 2008, ch. 7)."""
_BOUNCE_DAMPING = 0.12
"""Damping ratio of these: tyres without dampers."""
_REFERENCE_TIME = 60.0
"""Time [s] in which a wave touches its bounds; a shorter scenario shows a part of the wave, not a steeper one."""


@dataclass(frozen=True, slots=True)
class Swing:
    """A quantity that moves between bounds, which it touches in a drive of a minute, as a sum of four slow sines.

    At their frequencies [Hz] next to nothing happens between two samples, and one window of 10 s still sees many states
    of the wheels.
    """

    low: float
    high: float
    slowest: float = 0.05
    fastest: float = 0.12


@dataclass(frozen=True, slots=True)
class Profile:
    """A quantity with given values at times t [s], ascending; straight lines between them, constant outside."""

    t: Sequence[float]
    value: Sequence[float]

    @property
    def low(self) -> float:
        """The least value."""
        return min(self.value)

    @property
    def high(self) -> float:
        """The greatest value."""
        return max(self.value)


class Wave(NamedTuple):
    """One realisation of a swing or a profile: value, rate of change [1/s], integral from the start [s]; each (N,)."""

    value: Array
    rate: Array
    integral: Array


def realise(swing: Swing | Profile, t: Array, rng: np.random.Generator) -> Wave:
    """Return a random wave at times [s] (N,) that ascend from 0; given values are returned as they are."""
    if isinstance(swing, Profile):
        value = np.interp(t, swing.t, swing.value)
        area = np.cumsum((value[1:] + value[:-1]) / 2.0 * np.diff(t))
        return Wave(value, np.gradient(value, t), np.concatenate([[0.0], area]))
    edges = np.linspace(swing.slowest, swing.fastest, _N_SINES + 1)
    omega = 2.0 * np.pi * rng.uniform(edges[:-1], edges[1:])
    phase = rng.uniform(0.0, 2.0 * np.pi, _N_SINES)

    def total(shape: Array) -> Array:
        return np.asarray(shape.sum(axis=0))

    def angle(at: Array) -> Array:
        return omega[:, None] * at + phase[:, None]

    reference = np.linspace(0.0, max(_REFERENCE_TIME, float(t[-1])), 4096)
    seen = total(np.sin(angle(reference)))
    gain = (swing.high - swing.low) / (seen.max() - seen.min())
    base = swing.low - gain * seen.min()
    value = np.clip(base + gain * total(np.sin(angle(t))), swing.low, swing.high)
    rate = gain * total(omega[:, None] * np.cos(angle(t)))
    area = total((np.cos(phase)[:, None] - np.cos(angle(t))) / omega[:, None])
    return Wave(value, rate, base * t + gain * area)


@dataclass(frozen=True, slots=True)
class Patch:
    """Soil from a distance [m] on: a name of terra.soils, or the soil itself with a name."""

    start: float
    name: str
    soil: Soil | None = None

    def parameters(self) -> Soil:
        """Return the soil; KeyError for a name that terra.soils does not know."""
        return self.soil if self.soil is not None else soil_named(self.name)


@dataclass(frozen=True, slots=True)
class Scenario:
    """Scenario of one drive.

    Attributes
    ----------
    duration
        [s].
    soils
        Patches at ascending distances.
    speed
        Ground speed [m/s].
    draft, slip
        One at most is given: the draft that the implement asks for [N], or the common slip of all driven wheels.
        Without both nothing is towed: slope and acceleration alone take pull.
    lift_slip
        With `draft`: the driver lifts the implement as far as needed to keep slip below this, and never pushes. None:
        nobody lifts it; what the wheels cannot give slows the vehicle down.
    slip_spread
        Greatest deviation of a single wheel from the common slip.
    side_shift
        Share of an axle's load that a side slope moves to its left wheel; negative to the right.
    bounce
        Rms of a wheel's load about its steady one, over it: axles that bounce and roll on their tyres.
    slope
        Knots (distance [m], pitch [rad]), straight lines between them.
    transition
        Length [m] over which one soil turns into the next.
    course
        Where on the earth.
    drawn_mass
        The true mass and centre of gravity are drawn about the configured ones, by `mass_std` and `cg_std`.
    vehicle_seed
        Picks true mass and gain errors of the sensors: the same vehicle in several drives; None: the drive's seed does.
    """

    duration: float
    soils: Sequence[Patch]
    speed: Swing | Profile = Swing(1.0, 1.8)
    draft: Swing | Profile | None = None
    slip: Swing | Profile | None = None
    lift_slip: Swing | None = Swing(0.45, 0.45)
    slip_spread: float = 0.015
    side_shift: Swing | Profile = Swing(-0.15, 0.15)
    bounce: float = 0.0
    slope: Sequence[tuple[float, float]] = ((0.0, 0.0),)
    transition: float = 1.0
    course: Course = NORTHWARD
    drawn_mass: bool = False
    vehicle_seed: int | None = None

    @property
    def lifted(self) -> bool:
        """Whether a driver who lifts the implement limits the slip, or it is prescribed."""
        return self.slip is not None or self.lift_slip is not None

    def __post_init__(self) -> None:
        """Raise ValueError for a scenario that cannot be driven."""
        starts = [patch.start for patch in self.soils]
        if not starts or starts != sorted(set(starts)):
            raise ValueError("soils: at least one, at ascending distances")
        if self.draft is not None and self.slip is not None:
            raise ValueError("one of draft and slip at most may be given")
        if not np.isfinite(self.duration):
            raise ValueError(f"duration: {self.duration} is no number of seconds")
        if self.duration * SAMPLE_RATE < 2.0:
            raise ValueError(f"duration: {self.duration} s is too short")
        if self.speed.low <= 0.0 or self.transition <= 0.0:
            raise ValueError("speed and transition must be above zero")


def oscillation(t: Array, rng: np.random.Generator) -> Array:
    """Return a lightly damped mode of an axle on its tyres, driven by random ground; (N,), of unit rms.

    x'' + 2 zeta w x' + w^2 x = white noise, sampled without error: an autoregression of second order
    """
    from scipy.signal import lfilter  # not needed without

    w = 2.0 * np.pi * rng.uniform(*_BOUNCE_BAND)
    decay, turn = np.exp(-_BOUNCE_DAMPING * w / SAMPLE_RATE), w * np.sqrt(1.0 - _BOUNCE_DAMPING**2) / SAMPLE_RATE
    settled = round(10.0 * SAMPLE_RATE)
    noise = rng.standard_normal(len(t) + settled)
    a, b = 2.0 * decay * np.cos(turn), -(decay**2)
    mode = lfilter([1.0], [1.0, -a, -b], noise)[settled:]
    variance = (1.0 - b) / ((1.0 + b) * ((1.0 - b) ** 2 - a**2))
    return np.asarray(mode / np.sqrt(variance))


def soil_along(patches: Sequence[Patch], position: Array, transition: float) -> Soil:
    """Return the soil parameters at positions [m] of any shape: a Soil of arrays of that shape."""
    rows = [np.array(patch.parameters()) for patch in patches]
    values = np.multiply.outer(rows[0], np.ones_like(position))
    for patch, before, after in zip(patches[1:], rows, rows[1:], strict=False):
        share = np.clip((position - patch.start) / transition, 0.0, 1.0)
        values += np.multiply.outer(after - before, share)
    return Soil(*values)


def soil_names(patches: Sequence[Patch], position: Array) -> list[str]:
    """Return the name of the soil at each position [m] (N,)."""
    index = np.searchsorted([patch.start for patch in patches[1:]], position, side="right")
    return [patches[int(i)].name for i in index]


def excited(soil: str = "loam", duration: float = 120.0) -> Scenario:
    """Return one soil with slip swept from 0.05 to 0.4: the drive that determines the soil best."""
    return Scenario(duration, (Patch(0.0, soil),), slip=Swing(0.05, 0.40))


def demo(duration: float = 60.0, first: str = "loam", second: str = "wet_clay") -> Scenario:
    """Return half the time on the first soil, then the same work on the second.

    The draft asked for is easy on loam and more than wet clay can hold: there the driver
    lifts the implement to get through at all, at slips that a careful driver avoids.
    """
    speed = Swing(1.2, 1.6)
    halfway = duration / 2.0 * (speed.low + speed.high) / 2.0
    soils = (Patch(0.0, first), Patch(halfway, second))
    return Scenario(duration, soils, speed, draft=Swing(2000.0, 4000.0), lift_slip=Swing(0.50, 0.65))
