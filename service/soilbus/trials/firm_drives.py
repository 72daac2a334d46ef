"""Simulated drives on ground that holds, one function for each kind of work; every warning on them is false.

The easy kind is steady work. The hard kinds have fast changes that could look like a loss of traction: uneven ground,
an implement lifted at headlands, stop and go, short hills, clods, and soil that is soft all over.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.simulator.scenario import Patch, Profile, Scenario, Swing, realise
from soilbus.terra.vehicle import GRAVITY
from soilbus.trials.boggings import (
    FAST_SWING_BAND,
    FIRM_SOILS,
    LIFT_SLIP,
    SIDE_SHIFT,
    SOFT_SOILS,
    largest_draft,
    side_shift,
)

__all__ = ["EASY", "FIRM_KINDS", "HARD", "firm_ground"]

DRIVE_TIME = 300.0
"""Length of a drive [s]."""
EASY = "firm"
HARD = ("harsh", "headland", "stop_and_go", "hills", "clods", "soft")
"""Fast, uneven, up and down; rows with the implement lifted at their ends; a queue's or a loader's speed; short steep
hills; stones and clods in the implement's way; a light draft on soil that is soft all over."""
FIRM_KINDS = (EASY, *HARD)
GROUND_SPEED = Swing(1.0, 1.8)
"""Ground speed [m/s], where a kind of drive does not set its own."""
HARSH_SIDE_SHIFT = 0.4
"""Share of an axle's load that harsh ground shifts, where the machine bears it (`boggings.side_shift`)."""
LEAST_PULL = 0.02
"""Share of the weight that a machine can pull where it is driven."""
_KNOT_PERIOD = 0.1
"""Time [s] between the knots of a draft."""


def firm_ground(config: Config, kind: str, rng: np.random.Generator) -> Scenario:
    """Return a drive of one of FIRM_KINDS, with a draft that the ground holds all along."""
    soil = str(rng.choice(_soft_soils(config) if kind == "soft" else FIRM_SOILS))
    side = side_shift(config, soil, HARSH_SIDE_SHIFT if kind == "harsh" else SIDE_SHIFT)
    return replace(_DRIVES[kind](config, soil, largest_draft(config, soil, side), rng), side_shift=Swing(-side, side))


def _soft_soils(config: Config) -> tuple[str, ...]:
    """Soft soils on which the machine can pull at all, else firm ones."""
    least = LEAST_PULL * GRAVITY * (config.vehicle.mass if config.vehicle else 0.0)
    held = {soil: largest_draft(config, soil, side_shift(config, soil, SIDE_SHIFT)) for soil in SOFT_SOILS}
    return tuple(soil for soil, most in held.items() if most > least) or FIRM_SOILS


def _harsh(config: Config, soil: str, most: float, rng: np.random.Generator) -> Scenario:
    knots = np.arange(0.0, 3.0 * DRIVE_TIME, 25.0)
    weight = GRAVITY * config.vehicle.mass if config.vehicle else np.inf
    pitch = rng.uniform(-0.13, 0.13, len(knots)) * most / weight
    slope = tuple(zip(knots.tolist(), pitch.tolist(), strict=True))
    return Scenario(
        DRIVE_TIME, (Patch(0.0, soil),), speed=Swing(0.8, 2.5), draft=Swing(0.1 * most, 0.65 * most, *FAST_SWING_BAND),
        lift_slip=LIFT_SLIP, slip_spread=0.03, slope=slope,
    )  # fmt: skip


def _headland(config: Config, soil: str, most: float, rng: np.random.Generator) -> Scenario:
    """Half a minute in work, lifted in 1 to 2 s for the turn, lowered in 1 to 3 s."""
    t = _times()
    lowered = _steps(t, rng, (25.0, 45.0), (6.0, 12.0), (1.0, 2.0), (1.0, 3.0))
    work = realise(Swing(0.4 * most, 0.65 * most, *FAST_SWING_BAND), t, rng).value
    speed = 1.0 + 0.6 * lowered
    return _scenario(soil, _profile(t, 0.05 * most + lowered * (work - 0.05 * most)), _profile(t, speed))


def _stop_and_go(config: Config, soil: str, most: float, rng: np.random.Generator) -> Scenario:
    """Speed between a crawl and 2 m/s, at up to 1 m/s^2; at less where the machine pulls little of its weight."""
    t = _times()
    weight = GRAVITY * config.vehicle.mass if config.vehicle else 0.0
    slower = max(0.27 * weight / most, 1.0)
    ramp = (2.0 * slower, 4.0 * slower)
    going = _steps(t, rng, (5.0, 15.0), (3.0, 8.0), ramp, ramp)
    return _scenario(soil, Swing(0.2 * most, 0.5 * most), _profile(t, 0.25 + rng.uniform(1.2, 1.75) * going))


def _hills(config: Config, soil: str, most: float, rng: np.random.Generator) -> Scenario:
    """Ups and downs of 8 to 20 m that take up to 45 % of the largest draft."""
    weight = GRAVITY * config.vehicle.mass if config.vehicle else np.inf
    at = np.concatenate([[0.0], np.cumsum(rng.uniform(8.0, 20.0, 100))])
    pitch = np.concatenate([[0.0], rng.uniform(-0.2, 0.45, 100) * most / weight])
    slope = tuple(zip(at.tolist(), pitch.tolist(), strict=True))
    return _scenario(soil, Swing(0.15 * most, 0.3 * most), slope=slope)


def _clods(config: Config, soil: str, most: float, rng: np.random.Generator) -> Scenario:
    """Every few seconds a blow of a third of a second to one and a half."""
    t = _times()
    blows = np.zeros_like(t)
    begins = np.cumsum(rng.uniform(3.0, 10.0, 100))
    for begin, length, share in zip(begins, rng.uniform(0.3, 1.5, 100), rng.uniform(0.05, 0.35, 100), strict=True):
        blows = np.maximum(blows, share * np.clip(1.0 - np.abs(2.0 * (t - begin) / length - 1.0), 0.0, 1.0))
    even = realise(Swing(0.25, 0.4), t, rng).value
    return _scenario(soil, _profile(t, (even + blows) * most))


_DRIVES: dict[str, Callable[[Config, str, float, np.random.Generator], Scenario]] = {
    EASY: lambda config, soil, most, rng: _scenario(soil, Swing(0.2 * most, 0.65 * most)),
    "soft": lambda config, soil, most, rng: _scenario(soil, Swing(0.1 * most, 0.5 * most)),
    "harsh": _harsh, "headland": _headland, "stop_and_go": _stop_and_go, "hills": _hills, "clods": _clods,
}  # fmt: skip


def _scenario(
    soil: str, draft: Swing | Profile, speed: Swing | Profile = GROUND_SPEED,
    slope: tuple[tuple[float, float], ...] = ((0.0, 0.0),),
) -> Scenario:  # fmt: skip
    return Scenario(DRIVE_TIME, (Patch(0.0, soil),), speed, draft=draft, lift_slip=LIFT_SLIP, slope=slope)


def _times() -> Array:
    return np.arange(0.0, DRIVE_TIME + _KNOT_PERIOD, _KNOT_PERIOD)


def _profile(t: Array, value: Array) -> Profile:
    return Profile(t.tolist(), value.tolist())


def _steps(t: Array, rng: np.random.Generator, *ranges: tuple[float, float]) -> Array:
    """Share (N,) between 0 and 1, smooth: ranges [s] of how long it is 1, how long 0, how long it falls and rises."""

    def knots() -> Iterator[tuple[float, float]]:
        now = 0.0
        while now <= DRIVE_TIME:
            high, low, fall, rise = (rng.uniform(*r) for r in ranges)
            yield now, 1.0
            yield now + high, 1.0
            yield now + high + fall, 0.0
            yield now + high + fall + low, 0.0
            now += high + fall + low + rise
        yield now, 1.0

    at, share = np.array(list(knots())).T
    line = np.interp(t, at, share)
    return np.asarray(line**2 * (3.0 - 2.0 * line))
