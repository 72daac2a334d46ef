"""The simulated tractor: the true values of every quantity at every instant of a scenario.

    sum of drawbar pulls = draft + m g sin(pitch) + m dv/dt + forces of effects
    load of wheel i      = its vertical force

Quasi-static at 50 samples a second: ground speed and its rate are given, and slips, draft, loads, sinkages and torques
solve these balances with the wheel-soil model and the drive line (simulator/equilibrium.py, simulator/drivetrain.py).
A vehicle that never tows anything drives over the given slopes, or, where slip is prescribed, up and down slopes that
take it. Turning is not modelled; a side slope only shifts load. Effects on forces take part in the balance; effects on
sensors belong to simulator/sensors.py.

`steps` drives a step of time after the other, each with the command of its beginning; `drive` is one step of the whole
duration. Where nobody lifts the implement, what the wheels cannot give slows the vehicle down:

    dv/dt = min(towards the wanted speed, (sum of drawbar pulls at the slip limit - draft - m g sin(pitch)) / m)
    slip limit = 1 - v / (RIM_SPEED_RATIO max(wanted speed, v))    the rims turn no faster; at MAX_SLIP it is stuck
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.config.model import Config, Wheel
from soilbus.estimation.assembly import UNKNOWN_SHARE, chassis_of, effects_of
from soilbus.simulator.course import positions
from soilbus.simulator.drivetrain import drivetrain_of
from soilbus.simulator.equilibrium import (
    MAX_SLIP,
    Equilibrium,
    Mechanics,
    Situation,
    sinkages,
    solve,
    surroundings,
    wheel_slips,
)
from soilbus.simulator.scenario import SAMPLE_RATE, Scenario, Swing, Wave, oscillation, realise, soil_along, soil_names
from soilbus.terra.effects.effect import Active, Surroundings
from soilbus.terra.vehicle import GRAVITY, Chassis, pull_required, wheel_loads
from soilbus.terra.wheel import WheelModel
from soilbus.words import WorkError

STEP = 0.1
"""Length [s] of a step where the drive depends on what happened before."""
LEAST_SPEED = 0.2
"""Least ground speed [m/s] that can be wanted: the simulated vehicle drives, it does not park."""
MAX_ACCELERATION = 0.5
"""Greatest rate [m/s^2] at which the vehicle nears another wanted speed: a driver with an implement in the ground."""
RIM_SPEED_RATIO = 3.0
"""Speed of the rims over the wanted ground speed that the motors do not pass. How long bogging down takes hardly
depends on it, as past a slip of 0.6 the pull changes little with slip."""
_MASS_STREAM, _BOUNCE_STREAM = 3, 4
"""Name the random numbers of the true mass and of bouncing wheels, which disturb no others."""
_LARGEST_LOSS = 0.9
"""Share of its load that a bouncing wheel loses at most: quasi-static wheels do not jump."""


class SimulationError(WorkError):
    """Error of a scenario that cannot be driven with this configuration; one line says why."""


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
class Command:
    """Commands to the vehicle; without one the scenario holds.

    Draft [N] of an implement that nobody lifts, ground speed [m/s], and torque limit at the wheel [N m] by its name.
    """

    draft: float | None = None
    speed: float | None = None
    torque_limit: Mapping[str, float] = field(default_factory=dict)


NO_COMMAND = Command()


@dataclass(frozen=True, slots=True)
class _Motion:
    t: Array
    distance: Array
    speed: Array
    acceleration: Array
    pitch: Array


@dataclass(frozen=True, slots=True)
class _Plan:
    """The scenario's waves over the whole duration, each (N,), and what does not change on the way.

    deviation: each motor's slip beyond the common one (M, N); bounce: of the wheels' loads over these (W, N).
    """

    config: Config
    scenario: Scenario
    t: Array
    speed: Wave
    side: Array
    demand: Array
    slip_limit: Array
    least_draft: Array
    deviation: Array
    bounce: Array
    chassis: Chassis
    mechanics: Mechanics


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a step begins: speed [m/s], distance [m], both None as the scenario has them, and the last equilibrium."""

    speed: float | None = None
    distance: float | None = None
    last: Equilibrium | None = None


def drive(config: Config, scenario: Scenario, seed: int, effects: Sequence[Active] = ()) -> Drive:
    """Drive the configured vehicle through one realisation of a scenario, which the seed picks.

    Effects are those of config.model.effects and `effects`.

    Raises
    ------
    SimulationError
        There is no vehicle, it cannot even start, or it shall tow what it never tows.
    KeyError
        A soil is unknown.
    ConfigError
        An effect cannot be.
    """
    step = math.inf if scenario.lifted else STEP
    return joined(list(steps(config, scenario, seed, effects, step)))


def steps(
    config: Config,
    scenario: Scenario,
    seed: int,
    effects: Sequence[Active] = (),
    step: float = STEP,
    commanded: Callable[[float], Command] = lambda t: NO_COMMAND,
) -> Iterator[Drive]:
    """Yield a drive (see `drive`) step by step, until the scenario ends or the vehicle has bogged down.

    `commanded` is asked at the beginning of each `step` [s], with the time since the start [s]; it goes before the
    scenario.
    """
    plan = _plan(config, scenario, seed, (*effects_of(config), *effects))
    n = len(plan.t) if math.isinf(step) else max(round(step * SAMPLE_RATE), 1)
    place = _Place()
    for first in range(0, len(plan.t), n):
        part = slice(first, min(first + n, len(plan.t)))
        done, place = _driven(plan, part, place, commanded(float(plan.t[first])))
        if done.bogged_at is not None and first == 0 and len(done.columns["t"]) < 2:
            soil = soil_names(scenario.soils, plan.speed.integral[:1])[0]
            raise SimulationError(f"the tractor cannot drive on {soil}: no slip lets it move")
        yield done
        if done.bogged_at is not None:
            return


def joined(drives: Sequence[Drive]) -> Drive:
    """Return one drive of several that follow one another."""
    if len(drives) == 1:
        return drives[0]
    last = drives[-1]
    columns = {name: np.concatenate([d.columns[name] for d in drives]) for name in last.columns}
    around: Any = zip(*(d.surroundings for d in drives), strict=True)
    whole: Any = (np.concatenate(a) if np.ndim(a[0]) > 1 else a[-1] for a in around)
    return replace(last, columns=columns, surroundings=Surroundings(*whole))


def latest(done: Drive, n: int) -> Drive:
    """Return the last n instants of a drive."""
    around: Any = done.surroundings
    columns = {name: column[-n:] for name, column in done.columns.items()}
    return replace(done, columns=columns, surroundings=Surroundings(*(a[-n:] if np.ndim(a) > 1 else a for a in around)))


def _plan(config: Config, scenario: Scenario, seed: int, effects: tuple[Active, ...]) -> _Plan:
    chassis = _chassis(config, scenario, seed)
    rng = np.random.default_rng(seed)
    t = np.arange(round(scenario.duration * SAMPLE_RATE)) / SAMPLE_RATE
    speed = realise(scenario.speed, t, rng)
    climbs = _climbs(config, scenario)
    drivetrain = drivetrain_of(config)
    side = realise(scenario.side_shift, t, rng).value
    demand, slip_limit, least = _driver(scenario, t, rng)
    spread = Swing(-scenario.slip_spread, scenario.slip_spread)
    deviation = np.stack([realise(spread, t, rng).value for _ in config.wheel])
    deviation = np.where((drivetrain.leader < 0)[:, None], 0.0, deviation[drivetrain.leader])
    bounce = _bounce(config, scenario, t, seed)
    rear = _ahead(config) < 1.0
    model = WheelModel(shear_law=config.model.shear_law, rollers=config.rollers)
    length = float(speed.integral[-1])
    mechanics = Mechanics(model, rear, chassis.mass, scenario.duration, length, drivetrain, effects, climbs)
    return _Plan(config, scenario, t, speed, side, demand, slip_limit, least, deviation, bounce, chassis, mechanics)


def _driven(plan: _Plan, part: slice, place: _Place, command: Command) -> tuple[Drive, _Place]:
    """One step, and where the next one begins."""
    wanted = None if command.speed is None else max(command.speed, LEAST_SPEED)
    command = replace(command, draft=None if plan.mechanics.climbs else command.draft, speed=wanted)
    lifted = command.draft is None and plan.scenario.lifted
    motion, end = _motion(plan, part, place, wanted, math.inf)
    situation = _situation(plan, part, motion, command, lifted)
    result = solve(situation, plan.mechanics, place.last)
    lacking = 0.0 if lifted else float(np.mean(situation.demand - result.draft))
    if lacking > 1e-6 * plan.chassis.mass * GRAVITY:
        possible = float(motion.acceleration.mean()) - lacking / plan.chassis.mass
        motion, end = _motion(plan, part, place, wanted, possible)
        situation = _situation(plan, part, motion, command, lifted)
        result = solve(situation, plan.mechanics, result)
    lost = ~result.found if lifted else ~result.found | (situation.slip_limit >= MAX_SLIP)
    stuck = np.flatnonzero(lost)
    return _as_drive(plan, part, motion, situation, result, stuck), replace(end, last=result)


def _motion(plan: _Plan, part: slice, place: _Place, wanted: float | None, possible: float) -> tuple[_Motion, _Place]:
    """Motion in a step, and speed and distance at its end.

    wanted: ground speed [m/s], None as the scenario has it; possible: greatest acceleration [m/s^2] of the wheels.
    """
    t, planned = plan.t[part], Wave(*(a[part] for a in plan.speed))
    begun = planned.value[0] if place.speed is None else place.speed
    begin = planned.integral[0] if place.distance is None else place.distance
    span = len(t) / SAMPLE_RATE
    if wanted is None and place.speed is None and math.isinf(possible):
        offset = 0.0 if place.distance is None else place.distance - float(plan.speed.integral[part.start])
        motion = planned.value, planned.rate, planned.integral + offset
        following = plan.speed.integral[part.stop] + offset if part.stop < len(plan.t) else None
        end = _Place(None, None if place.distance is None or following is None else float(following))
    else:
        aim = float(plan.speed.value[min(part.stop, len(plan.t) - 1)]) if wanted is None else wanted
        rate = min(np.clip((aim - begun) / span, -MAX_ACCELERATION, MAX_ACCELERATION), possible)
        rate = max(rate, -begun / span)
        since = t - t[0]
        motion = begun + rate * since, np.full_like(t, rate), begin + begun * since + rate * since**2 / 2.0
        speed = float(begun + rate * span)
        follows = wanted is None and math.isclose(speed, aim)
        end = _Place(None if follows else speed, float(begin + begun * span + rate * span**2 / 2.0))
    speed_now, acceleration, distance = motion
    knots = np.array(plan.scenario.slope, float)
    pitch = np.zeros_like(t) if plan.mechanics.climbs else np.interp(distance, knots[:, 0], knots[:, 1])
    return _Motion(t, distance, speed_now, acceleration, pitch), end


def _as_drive(
    plan: _Plan, part: slice, motion: _Motion, situation: Situation, result: Equilibrium, stuck: NDArray[np.intp]
) -> Drive:
    config, scenario, mechanics, t = plan.config, plan.scenario, plan.mechanics, motion.t
    end = int(stuck[0]) if len(stuck) else len(t)
    columns = _columns(config.wheel, scenario, motion, situation, result, sinkages(situation, mechanics, result))
    columns |= {"roll": _roll(config, plan.side[part])}
    if mechanics.climbs:
        columns |= {"pitch": np.arcsin(result.draft / (plan.chassis.mass * GRAVITY)), "draft": np.zeros_like(t)}
    around: tuple[Any, ...] = surroundings(situation, mechanics, wheel_slips(situation, result), result.draft)
    return Drive(
        {name: column[:end] for name, column in columns.items()},
        float(t[end]) if len(stuck) else None,
        tuple(mechanics.effects),
        Surroundings(*(a if np.ndim(a) < 2 else a[:end] for a in around)),
        plan.chassis,
    )


def _climbs(config: Config, scenario: Scenario) -> bool:
    """Whether slopes take the pull that the prescribed slip gives, as nothing is towed that could."""
    if not config.tows_nothing:
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
    if not chassis.on_one_axle and len(config.axles) < 2:
        raise SimulationError("the simulator needs wheels on both axles")
    if not scenario.drawn_mass:
        return chassis
    usual = UNKNOWN_SHARE if any(wheel.load is None for wheel in config.wheel) else 0.0
    mass_std = usual * vehicle.mass if vehicle.mass_std is None else vehicle.mass_std
    cg_std = usual * vehicle.wheelbase if vehicle.cg_std is None else vehicle.cg_std
    of_vehicle = seed if scenario.vehicle_seed is None else scenario.vehicle_seed
    drawn = np.random.default_rng([of_vehicle, _MASS_STREAM]).standard_normal(2) * (mass_std, cg_std)
    ahead = np.clip(chassis.cg_ahead_of_rear_axle + drawn[1], 0.0, chassis.wheelbase)
    return replace(chassis, mass=chassis.mass + float(drawn[0]), cg_ahead_of_rear_axle=float(ahead))


def _bounce(config: Config, scenario: Scenario, t: Array, seed: int) -> Array:
    """What bounce and roll of each axle add to the loads of its wheels (W, N), over these."""
    wheels = config.wheel
    if not scenario.bounce:
        return np.zeros((len(wheels), len(t)))
    rng = np.random.default_rng([seed, _BOUNCE_STREAM])
    modes = {axle: (oscillation(t, rng), oscillation(t, rng)) for axle in config.axles}
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


def _situation(plan: _Plan, part: slice, motion: _Motion, command: Command, lifted: bool) -> Situation:
    """What is given in a step, with the forces of effects that resist; `lifted`: the driver lifts at his slip limit."""
    chassis, wheels, drivetrain = plan.chassis, plan.config.wheel, plan.mechanics.drivetrain
    climbs, side = plan.mechanics.climbs, plan.side[part]
    shape = (len(wheels), len(motion.t))
    share = np.stack([_load_share(wheels, i, side) for i in range(len(wheels))]) * (1.0 + plan.bounce[:, part])
    ahead = _ahead(plan.config)

    def loads(draft: float, inertia: float = 0.0) -> Array:
        return np.asarray(share * wheel_loads(chassis, ahead, draft, motion.pitch, motion.acceleration + inertia))

    test_draft = chassis.mass  # any draft will do, loads are linear in it
    level = loads(0.0)
    drawn = loads(0.0, 1.0) if climbs else loads(test_draft)
    upright = share * wheel_loads(chassis, ahead, 0.0, 0.0, 0.0)[:, None] * float(climbs)
    to_cg = 0.0 * ahead if chassis.on_one_axle else ahead * chassis.wheelbase - chassis.cg_ahead_of_rear_axle
    position = motion.distance + to_cg[:, None]
    soil = soil_along(plan.scenario.soils, position, plan.scenario.transition)

    def each_wheel(name: str) -> Array:
        return np.broadcast_to(np.array([getattr(wheel, name) for wheel in wheels])[:, None], shape)

    demand, slip_limit, least = plan.demand[part], plan.slip_limit[part], plan.least_draft[part]
    if not lifted:
        wanted = plan.speed.value[part] if command.speed is None else command.speed
        rim = RIM_SPEED_RATIO * np.maximum(wanted, motion.speed)
        demand = demand if command.draft is None else np.full(shape[1], command.draft)
        slip_limit, least = np.minimum(1.0 - motion.speed / rim, MAX_SLIP), np.full(shape[1], -np.inf)
    limit = drivetrain.limit.copy()
    for i, wheel in enumerate(wheels):
        limit[i] = min(limit[i], command.torque_limit.get(wheel.name, math.inf))
    given = Situation(
        motion.t, motion.distance, motion.speed, motion.acceleration,
        pull_required(chassis, 0.0, motion.pitch, motion.acceleration), level, (drawn - level) / test_draft, upright,
        plan.deviation[:, part], each_wheel("radius"), each_wheel("width"), each_wheel("contact_length"),
        np.array(soil), demand, slip_limit, np.broadcast_to(limit[:, None], (len(limit), len(motion.t))), least,
    )  # fmt: skip
    return _with_resisting_effects(given, plan.mechanics)


def _load_share(wheels: list[Wheel], index: int, side: Array) -> Array:
    """What a side slope makes (N,) of one wheel's load, over it; wheels of an axle are listed left to right."""
    mates = [i for i, wheel in enumerate(wheels) if wheel.axle == wheels[index].axle]
    place = np.linspace(1.0, -1.0, len(mates))[mates.index(index)] if len(mates) > 1 else 0.0
    return np.asarray(1.0 + place * side)


def _ahead(config: Config) -> Array:
    """How far each wheel (W,) is ahead of the last axle, over the wheelbase."""
    return np.array([config.axles[str(wheel.axle)] for wheel in config.wheel])


def _driver(scenario: Scenario, t: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Demanded draft, slip limit and least draft, each (N,)."""
    if scenario.slip is not None:
        unbounded = np.full(len(t), np.inf)
        return unbounded, realise(scenario.slip, t, rng).value, -unbounded
    demand = np.zeros_like(t) if scenario.draft is None else realise(scenario.draft, t, rng).value
    return demand, realise(scenario.lift_slip or Swing(1.0, 1.0), t, rng).value, np.minimum(demand, 0.0)


def _columns(
    wheels: list[Wheel], scenario: Scenario, motion: _Motion, situation: Situation, result: Equilibrium, sunk: Array
) -> dict[str, NDArray[Any]]:
    latitude, longitude = positions(scenario.course, motion.distance)
    columns: dict[str, NDArray[Any]] = {
        "t": motion.t, "distance": motion.distance, "ground_speed": motion.speed, "acceleration": motion.acceleration,
        "pitch": motion.pitch, "latitude": latitude, "longitude": longitude, "draft": result.draft,
        "demand": np.where(np.isfinite(situation.demand), situation.demand, np.nan),
        "soil": np.array(soil_names(scenario.soils, motion.distance)),
    }  # fmt: skip
    slip, load = wheel_slips(situation, result), situation.load(result.draft)
    limit = np.where(np.isfinite(situation.torque_limit), situation.torque_limit, np.nan)
    for i, wheel in enumerate(wheels):
        of_wheel = {
            "slip": slip[i], "entry_angle": result.entry_angle[i], "sinkage": sunk[i], "load": load[i],
            "drawbar_pull": result.forces[1, i], "torque": result.forces[2, i],
            "speed": motion.speed / (wheel.radius * (1.0 - slip[i])), "torque_limit": limit[i],
        }  # fmt: skip
        columns |= {f"{quantity}.{wheel.name}": column for quantity, column in of_wheel.items()}
    return columns
