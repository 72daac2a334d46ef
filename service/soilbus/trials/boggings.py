"""Simulated drives that end with the vehicle stuck, one function of random parameters for each kind.

    digging:  v = rim speed (1 - slip),  slip from a first drive at constant speed over the same ground

The kinds are soft ground with a long or a short transition, a draft or a grade that outgrows firm ground, wheels that
dig themselves in at constant throttle, and uneven variants of softening and draft.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.estimation.assembly import rig_of
from soilbus.simulator.drive import SimulationError, drive
from soilbus.simulator.drivetrain import drivetrain_of
from soilbus.simulator.scenario import Patch, Profile, Scenario, Swing, realise
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active
from soilbus.terra.soils import soil_named
from soilbus.terra.vehicle import GRAVITY
from soilbus.terra.wheel import WheelModel
from soilbus.trials.draft_trials import true_largest_draft

__all__ = ["KINDS", "BoggingDrive", "bogging", "largest_draft", "side_shift"]

FIRM_SOILS = ("rubicon_sandy_loam_43", "north_gower_clayey_loam_46", "upland_sandy_loam_51", "loam")
SLIPPING_SOILS = FIRM_SOILS[:2] + FIRM_SOILS[3:]
"""Soils on which the reference tractor's motors can turn the wheels into slip; on the others a draft stalls them."""
SOFT_SOILS = ("wet_clay", "clayey_soil_38", "lean_clay_32", "heavy_clay_40")
"""Soft soils of the table."""
KINDS = ("softening", "patch", "draft", "grade", "digging", "uneven_softening", "uneven_draft")
"""Ground that softens over many metres; a soft patch with an edge; a draft and a grade that outgrow firm ground;
wheels that dig themselves in at constant throttle; ground that softens, or a draft that grows, as the draft swings."""
DRIVE_TIME = 60.0
"""Length of a drive [s]."""
FAST_SWING_BAND = (0.1, 0.4)
"""Frequencies [Hz] of a draft that swings fast."""
SPEED_TIME_CONSTANT = 0.5
"""Time constant [s] of the ground speed behind the slip at constant throttle."""
MIN_SPEED = 0.3
"""Ground speed [m/s] at which a drive at constant throttle counts as stuck."""
SIDE_SHIFT = 0.15
"""Share of an axle's load that the ground shifts from side to side."""
KEPT_SHARE = 0.7
"""Share of its draft on the level that a machine keeps on the side slopes that it is driven on."""
LIFT_SLIP = Swing(0.9, 0.9)
"""Slip at which the driver lifts the implement: too late."""


class BoggingDrive(NamedTuple):
    """A drive and the effects that act in it."""

    scenario: Scenario
    effects: tuple[Active, ...] = ()


def bogging(config: Config, kind: str, rng: np.random.Generator) -> BoggingDrive:
    """Return a drive of one of KINDS that is meant to end stuck; `rng` picks soils, lengths and drafts.

    Raises SimulationError where the vehicle cannot be driven, ValueError for another kind.
    """
    firm = str(rng.choice(SLIPPING_SOILS if kind in ("draft", "grade", "uneven_draft") else FIRM_SOILS))
    side = side_shift(config, firm, SIDE_SHIFT)
    made = _bogging(config, kind, firm, side, rng)
    return made._replace(scenario=replace(made.scenario, side_shift=Swing(-side, side)))


def _bogging(config: Config, kind: str, firm: str, side: float, rng: np.random.Generator) -> BoggingDrive:
    """From a draft that the machine holds on every side slope of the drive to one that it holds on none."""
    most, level = (largest_draft(config, firm, shift) for shift in (side, 0.0))
    start = rng.uniform(22.0, 32.0)
    if kind in ("softening", "patch", "uneven_softening"):
        length = rng.uniform(*((2.0, 8.0) if kind == "patch" else (15.0, 40.0)))
        soils = (Patch(0.0, firm), Patch(start, str(rng.choice(SOFT_SOILS))))
        draft = _about(rng.uniform(0.35, 0.55), most)
        if kind == "uneven_softening":
            draft = Swing(0.2 * most, 0.6 * most, *FAST_SWING_BAND)
        return BoggingDrive(Scenario(DRIVE_TIME, soils, draft=draft, lift_slip=LIFT_SLIP, transition=length))
    if kind in ("draft", "uneven_draft"):
        draft_of = _growing(rng, most, level, 0.0 if kind == "draft" else 0.15)
        return BoggingDrive(Scenario(DRIVE_TIME, (Patch(0.0, firm),), draft=draft_of, lift_slip=LIFT_SLIP))
    if kind == "grade":
        share, length = rng.uniform(0.35, 0.55), rng.uniform(15.0, 40.0)
        weight = GRAVITY * config.vehicle.mass if config.vehicle else np.inf
        steepest = float(np.arcsin(min((rng.uniform(1.1, 1.3) * level - share * most) / weight, 0.5)))
        slope = ((0.0, 0.0), (start, 0.0), (start + length, steepest))
        easy = Scenario(DRIVE_TIME, (Patch(0.0, firm),), draft=_about(share, most), lift_slip=LIFT_SLIP, slope=slope)
        return BoggingDrive(easy)
    if kind == "digging":
        return _digging(config, firm, most, side, start, rng)
    raise ValueError(f"no kind of bogging is called {kind}; known: {', '.join(KINDS)}")


def largest_draft(config: Config, soil: str, side: float = 0.0) -> float:
    """Return the largest draft [N] on a soil of the table within the allowed slip, without a torque limit.

    side: share of each axle's load that a side slope moves to its left wheel.
    """
    rig, line, slip = rig_of(config), drivetrain_of(config), config.traversability.max_slip
    no_limit, line = np.full(len(rig.radius), np.nan), replace(line, limit=np.full_like(line.limit, np.inf))
    return true_largest_draft(soil_named(soil), rig, no_limit, slip, WheelModel(), drivetrain=line, side_shift=side)


def side_shift(config: Config, soil: str, most: float) -> float:
    """Return the greatest shift of load up to `most` with which a machine keeps KEPT_SHARE of its draft.

    An open differential gives both wheels no more torque than the lighter one holds: a tractor with one on a single
    driven axle keeps half of its draft where 15 % of the load are shifted, and none at 40 %.
    """
    level = largest_draft(config, soil)
    shifts = np.linspace(1.0, 0.0, 9) * most
    return next((side for side in shifts.tolist() if largest_draft(config, soil, side) >= KEPT_SHARE * level), 0.0)


def _growing(rng: np.random.Generator, most: float, level: float, swing: float) -> Profile:
    """A draft that grows beyond the largest one on the level [N]; swing: share of `most` by which it swings."""
    begin = rng.uniform(12.0, 20.0)
    shares = rng.uniform((0.3, 1.1), (0.5, 1.3)) * (1.0, level / most)
    grown = begin + rng.uniform(20.0, 40.0)
    if not swing:
        return Profile((begin, grown), (shares * most).tolist())
    t = np.arange(0.0, DRIVE_TIME, 0.1)
    swinging = np.interp(t, (begin, grown), shares) + realise(Swing(-swing, swing, *FAST_SWING_BAND), t, rng).value
    return Profile(t.tolist(), (swinging * most).tolist())


def _about(share: float, most: float) -> Swing:
    return Swing((share - 0.05) * most, (share + 0.05) * most)


def _digging(
    config: Config, firm: str, most: float, side: float, start: float, rng: np.random.Generator
) -> BoggingDrive:
    """Ground that softens, wheels that dig the deeper the more they slip, and a driver who keeps the throttle.

    Ground speed falls as slip grows: slips of a first drive at constant speed, metre by metre, give that of the second.
    """
    length, rim = rng.uniform(15.0, 40.0), rng.uniform(1.2, 1.8)
    slip_sinkage = CATALOGUE["slip_sinkage"]
    effects = (Active(slip_sinkage, slip_sinkage.neutral | {"softening": rng.uniform(0.5, 1.5)}),)
    soils = (Patch(0.0, firm), Patch(start, str(rng.choice(SOFT_SOILS))))
    draft = rng.uniform(0.35, 0.55) * most
    first = Scenario(
        DRIVE_TIME, soils, Swing(rim, rim), draft=Swing(draft, draft), lift_slip=LIFT_SLIP,
        side_shift=Swing(-side, side), transition=length,
    )  # fmt: skip
    seed = int(rng.integers(2**31))
    truth = drive(config, first, seed, effects).columns
    if len(truth["t"]) < 2:
        raise SimulationError(f"the tractor cannot drive on {firm}")
    slip = np.mean([truth[f"slip.{wheel.name}"] for wheel in config.wheel if wheel.driven], axis=0)
    speed = np.maximum(rim * (1.0 - slip), MIN_SPEED)
    t = np.concatenate([[0.0], np.cumsum(np.diff(truth["distance"]) * 2.0 / (speed[1:] + speed[:-1]))])
    even = np.arange(0.0, max(float(t[-1]), DRIVE_TIME), 0.1)
    smooth = _smoothed(np.interp(even, t, speed), 0.1 / SPEED_TIME_CONSTANT)
    return BoggingDrive(replace(first, speed=Profile(even.tolist(), smooth.tolist())), effects)


def _smoothed(values: Array, gain: float) -> Array:
    """Two lags of first order, as mass and driveline make of a change."""
    memory = 1.0 - gain
    for _ in range(2):
        values, _ = lfilter([gain], [1.0, -memory], values, zi=[memory * values[0]])
    return values
