"""The simulated tractor: the true values of every quantity at every instant of a scenario.

    sum of drawbar pulls = draft + m g sin(pitch) + m dv/dt + forces of effects
    load of wheel i      = its vertical force

Quasi-static at 50 samples a second: ground speed and its rate are given, and slips, draft, loads, sinkages and torques
solve these balances with the wheel-soil model and the drive line (simulator/equilibrium.py, simulator/drivetrain.py).
A vehicle that never tows anything drives over the given slopes, or, where slip is prescribed, up and down slopes that
take it. Turning is not modelled; a side slope only shifts load. Effects on forces take part in the balance; effects on
sensors belong to simulator/sensors.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.config.model import Config, Wheel
from soilbus.estimation.assembly import UNKNOWN_SHARE, chassis_of, effects_of
from soilbus.simulator.course import positions
from soilbus.simulator.drivetrain import Drivetrain, drivetrain_of
from soilbus.simulator.equilibrium import Equilibrium, Mechanics, Situation, sinkages, solve, surroundings, wheel_slips
from soilbus.simulator.scenario import SAMPLE_RATE, Scenario, Swing, oscillation, realise, soil_along, soil_names
from soilbus.terra.effects.effect import Active, Surroundings
from soilbus.terra.vehicle import GRAVITY, Chassis, axle_loads, pull_required
from soilbus.terra.wheel import WheelModel

_MASS_STREAM, _BOUNCE_STREAM = 3, 4
"""Name the random numbers of the true mass and of bouncing wheels, which disturb no others."""
_LARGEST_LOSS = 0.9
"""Share of its load that a bouncing wheel loses at most: quasi-static wheels do not jump."""


class SimulationError(Exception):
    """The scenario cannot be driven with this configuration; one line says why."""


@dataclass(frozen=True, slots=True)
class Drive:
    """True values of a drive.

    Attributes
    ----------
    columns
        By name, each (N,), in SI: t, distance, ground_speed, acceleration, pitch, roll (nan without a track), latitude,
        longitude [rad], draft, demand (nan where slip was prescribed), soil (names); and for each wheel W slip.W,
        entry_angle.W, sinkage.W, load.W, torque.W (at the wheel), drawbar_pull.W, speed.W [rad/s], torque_limit.W (of
        its own motor; nan: unknown).
    bogged_at
        Time [s] at which no slip lets the tractor go on and the drive ends; None without.
    effects
        Effects that acted.
    surroundings
        What these may depend on (N, W).
    chassis
        Mass and geometry as they were.
    """

    columns: dict[str, NDArray[Any]]
    bogged_at: float | None
    effects: tuple[Active, ...]
    surroundings: Surroundings
    chassis: Chassis


@dataclass(frozen=True, slots=True)
class _Motion:
    t: Array
    distance: Array
    speed: Array
    acceleration: Array
    pitch: Array


def drive(config: Config, scenario: Scenario, seed: int, effects: Sequence[Active] = ()) -> Drive:
    """Drive the configured vehicle through one realisation of a scenario.

    Parameters
    ----------
    config
        The vehicle, with the effects of config.model.effects.
    scenario
        Speed, soils, and draft or slip.
    seed
        Picks the realisation.
    effects
        Further effects.

    Raises
    ------
    SimulationError
        There is no vehicle, it cannot even start, or it shall tow what it never tows.
    KeyError
        A soil is unknown.
    ConfigError
        An effect cannot be.
    """
    chassis = _chassis(config, scenario, seed)
    present = (*effects_of(config), *effects)
    rng = np.random.default_rng(seed)
    t = np.arange(round(scenario.duration * SAMPLE_RATE)) / SAMPLE_RATE
    speed = realise(scenario.speed, t, rng)
    knots = np.array(scenario.slope, float)
    climbs = _climbs(config, scenario)
    pitch = np.zeros_like(t) if climbs else np.interp(speed.integral, knots[:, 0], knots[:, 1])
    motion = _Motion(t, speed.integral, speed.value, speed.rate, pitch)
    drivetrain = drivetrain_of(config)
    bounce = _bounce(config.wheel, scenario, t, seed)
    situation, side = _situation(config.wheel, chassis, scenario, motion, drivetrain, climbs, bounce, rng)
    rear = np.array([wheel.axle == "rear" for wheel in config.wheel])
    model, length = WheelModel(shear_law=config.model.shear_law), float(motion.distance[-1])
    mechanics = Mechanics(model, rear, chassis.mass, scenario.duration, length, drivetrain, present, climbs)
    result = solve(_with_resisting_effects(situation, mechanics), mechanics)
    stuck = np.flatnonzero(~result.found)
    end = int(stuck[0]) if len(stuck) else len(t)
    if end < 2:
        soil = soil_names(scenario.soils, motion.distance[:1])[0]
        raise SimulationError(f"the tractor cannot drive on {soil}: no slip lets it move")
    columns = _columns(config.wheel, scenario, motion, situation, result, sinkages(situation, mechanics, result))
    columns |= {"roll": _roll(config, side)}
    if climbs:
        columns |= {"pitch": np.arcsin(result.draft / (chassis.mass * GRAVITY)), "draft": np.zeros_like(t)}
    around: tuple[Any, ...] = surroundings(situation, mechanics, wheel_slips(situation, result), result.draft)
    return Drive(
        {name: column[:end] for name, column in columns.items()},
        float(t[end]) if len(stuck) else None,
        present,
        Surroundings(*(a if np.ndim(a) < 2 else a[:end] for a in around)),
        chassis,
    )


def _climbs(config: Config, scenario: Scenario) -> bool:
    """Whether slopes take the pull that the prescribed slip gives, as nothing is towed that could."""
    if config.vehicle is None or config.vehicle.towing != "never":
        return False
    if scenario.draft is not None:
        raise SimulationError("vehicle.towing = never, but the scenario has a draft: give it slopes, speeds or a slip")
    if scenario.slip is not None and any(pitch for _, pitch in scenario.slope):
        raise SimulationError("vehicle.towing = never: a scenario has slopes or a slip, which makes its own slopes")
    return scenario.slip is not None


def _with_resisting_effects(situation: Situation, mechanics: Mechanics) -> Situation:
    """The situation with the forces of resisting effects added to the resistance, at zero draft."""
    resistance, nothing = situation.resistance, np.zeros(len(situation.t))
    around = surroundings(situation, mechanics, np.zeros_like(situation.radius), nothing)
    for effect, values in mechanics.effects:
        if effect.resistance is not None:
            resistance = resistance + np.ravel(effect.resistance(around, values))
    return situation._replace(resistance=resistance)


def _chassis(config: Config, scenario: Scenario, seed: int) -> Chassis:
    """Mass and geometry, as configured or as the scenario draws them."""
    chassis, vehicle = chassis_of(config), config.vehicle
    if chassis is None or vehicle is None or not config.wheel:
        raise SimulationError("the simulator needs a [vehicle] with [[wheel]]s")
    if not chassis.on_tracks and {wheel.axle for wheel in config.wheel} != {"front", "rear"}:
        raise SimulationError("the simulator needs wheels on both axles")
    if not scenario.drawn_mass:
        return chassis
    usual = UNKNOWN_SHARE if any(wheel.load is None for wheel in config.wheel) else 0.0
    mass_std = usual * vehicle.mass if vehicle.mass_std is None else vehicle.mass_std
    cg_std = usual * vehicle.wheelbase if vehicle.cg_std is None else vehicle.cg_std
    drawn = np.random.default_rng([seed, _MASS_STREAM]).standard_normal(2) * (mass_std, cg_std)
    ahead = np.clip(chassis.cg_ahead_of_rear_axle + drawn[1], 0.0, chassis.wheelbase)
    return replace(chassis, mass=chassis.mass + float(drawn[0]), cg_ahead_of_rear_axle=float(ahead))


def _bounce(wheels: Sequence[Wheel], scenario: Scenario, t: Array, seed: int) -> Array:
    """What bounce and roll of each axle add to the loads of its wheels (W, N), over these."""
    if not scenario.bounce:
        return np.zeros((len(wheels), len(t)))
    rng = np.random.default_rng([seed, _BOUNCE_STREAM])
    modes = {axle: (oscillation(t, rng), oscillation(t, rng)) for axle in ("front", "rear")}
    of_wheels = []
    for wheel in wheels:
        up, roll = modes[str(wheel.axle)]
        mates = [w.name for w in wheels if w.axle == wheel.axle]
        of_wheels.append(up + (roll if mates.index(wheel.name) < len(mates) / 2.0 else -roll))
    return np.asarray(np.maximum(scenario.bounce * np.sqrt(0.5) * np.stack(of_wheels), -_LARGEST_LOSS))


def _roll(config: Config, side: Array) -> Array:
    """Roll [rad] (N,), left side up, of a side slope that shifts this share of the load to the left."""
    assert config.vehicle is not None  # _chassis sees to it
    if config.vehicle.track is None:
        return np.full_like(side, np.nan)
    return np.asarray(-np.arcsin(side * config.vehicle.track / (2.0 * config.vehicle.cg_height)))


def _situation(
    wheels: list[Wheel],
    chassis: Chassis,
    scenario: Scenario,
    motion: _Motion,
    drivetrain: Drivetrain,
    climbs: bool,
    bounce: Array,
    rng: np.random.Generator,
) -> tuple[Situation, Array]:
    """What is given, and the share (N,) of its axle's load that a side slope shifts to the left."""
    shape = (len(wheels), len(motion.t))
    side = realise(scenario.side_shift, motion.t, rng).value
    share = np.stack([_load_share(wheels, i, side) for i in range(len(wheels))]) * (1.0 + bounce)

    def loads(draft: float, inertia: float = 0.0) -> Array:
        front, rear = axle_loads(chassis, draft, motion.pitch, motion.acceleration + inertia)
        return np.asarray(share * np.stack([front if wheel.axle == "front" else rear for wheel in wheels]))

    test_draft = chassis.mass  # any draft will do, loads are linear in it
    level = loads(0.0)
    drawn = loads(0.0, 1.0) if climbs else loads(test_draft)
    static = axle_loads(chassis, 0.0, 0.0, 0.0)
    upright = share * np.array([[static[wheel.axle != "front"]] for wheel in wheels]) * float(climbs)
    ahead = {"front": chassis.wheelbase - chassis.cg_ahead_of_rear_axle, "rear": -chassis.cg_ahead_of_rear_axle}
    if chassis.on_tracks:
        ahead["front"] = 0.0
    position = np.stack([motion.distance + ahead[str(wheel.axle)] for wheel in wheels])
    soil = soil_along(scenario.soils, position, scenario.transition)
    spread = Swing(-scenario.slip_spread, scenario.slip_spread)

    def each_wheel(values: list[float]) -> Array:
        return np.broadcast_to(np.array(values)[:, None], shape)

    demand, slip_limit, least = _driver(scenario, motion.t, rng)
    deviation = np.stack([realise(spread, motion.t, rng).value for _ in wheels])
    deviation = np.where((drivetrain.leader < 0)[:, None], 0.0, deviation[drivetrain.leader])
    given = Situation(
        motion.t,
        motion.distance,
        motion.speed,
        motion.acceleration,
        pull_required(chassis, 0.0, motion.pitch, motion.acceleration),
        level,
        (drawn - level) / test_draft,
        upright,
        deviation,
        each_wheel([wheel.radius for wheel in wheels]),
        each_wheel([wheel.width for wheel in wheels]),
        each_wheel([wheel.contact_length for wheel in wheels]),
        np.array(soil),
        demand,
        slip_limit,
        np.broadcast_to(drivetrain.limit[:, None], (len(drivetrain.limit), len(motion.t))),
        least,
    )
    return given, side


def _load_share(wheels: list[Wheel], index: int, side: Array) -> Array:
    """Share (N,) of its axle's load on one wheel; wheels of an axle are listed left to right."""
    mates = [i for i, wheel in enumerate(wheels) if wheel.axle == wheels[index].axle]
    place = np.linspace(1.0, -1.0, len(mates))[mates.index(index)] if len(mates) > 1 else 0.0
    return np.asarray((1.0 + place * side) / len(mates))


def _driver(scenario: Scenario, t: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Demanded draft, slip limit and least draft, each (N,)."""
    if scenario.slip is not None:
        unbounded = np.full(len(t), np.inf)
        return unbounded, realise(scenario.slip, t, rng).value, -unbounded
    demand = np.zeros_like(t) if scenario.draft is None else realise(scenario.draft, t, rng).value
    return demand, realise(scenario.lift_slip, t, rng).value, np.minimum(demand, 0.0)


def _columns(
    wheels: list[Wheel], scenario: Scenario, motion: _Motion, situation: Situation, result: Equilibrium, sunk: Array
) -> dict[str, NDArray[Any]]:
    latitude, longitude = positions(scenario.course, motion.distance)
    columns: dict[str, NDArray[Any]] = {
        "t": motion.t,
        "distance": motion.distance,
        "ground_speed": motion.speed,
        "acceleration": motion.acceleration,
        "pitch": motion.pitch,
        "latitude": latitude,
        "longitude": longitude,
        "draft": result.draft,
        "demand": np.where(np.isfinite(situation.demand), situation.demand, np.nan),
        "soil": np.array(soil_names(scenario.soils, motion.distance)),
    }
    slip, load = wheel_slips(situation, result), situation.load(result.draft)
    limit = np.where(np.isfinite(situation.torque_limit), situation.torque_limit, np.nan)
    for i, wheel in enumerate(wheels):
        of_wheel = {
            "slip": slip[i],
            "entry_angle": result.entry_angle[i],
            "sinkage": sunk[i],
            "load": load[i],
            "drawbar_pull": result.forces[1, i],
            "torque": result.forces[2, i],
            "speed": motion.speed / (wheel.radius * (1.0 - slip[i])),
            "torque_limit": limit[i],
        }
        columns |= {f"{quantity}.{wheel.name}": column for quantity, column in of_wheel.items()}
    return columns
