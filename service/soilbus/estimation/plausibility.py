"""Which sensor lies: readings plausible each by itself, but not beside the others.

A window of bins is judged as a whole, on the instants at which the vehicle drives straight
on, and only what is sustained counts.  Thresholds lie beyond what any soil, slope, driver or
effect of `terra.effects` makes of good sensors; a lie that a soil could tell (a draft somewhat
off, one wheel that slips more) is left to the model, which then does not fit.  Each check sees
the window without the channels that an earlier one has named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.changes import accelerated, pulling, scaled
from soilbus.estimation.scene import DEVIATIONS, FALSE_SLIP, Resolution, Scene, scene_of
from soilbus.estimation.series import lasts, median, runs
from soilbus.estimation.window import (
    VEHICLE_QUANTITIES,
    WHEEL_QUANTITIES,
    Rig,
    SensorNoise,
    Window,
    pull_given,
    zero_if_unknown,
)
from soilbus.terra.vehicle import GRAVITY, Chassis, axle_loads

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SAME = 1e-12
"""Relative difference of means of equal readings: rounding."""
CHANCE = 1e-12
"""Chance, by the noise that the sensor is said to have, below which a run of equal readings is a frozen sensor."""
COARSE = 0.1
"""Share of repeated readings elsewhere in the window by which a sensor is coarser than its signal, not frozen."""
STILL_SHARE = 0.1
"""Rim speed, as a share of the ground speed, below which a wheel does not turn."""
BRAKED = 0.2
"""Braking torque over load and radius from which a wheel may be locked."""
GEAR_SLACK = 0.03
"""Relative difference of motor and wheel speed that gear and radius of the wheel's sensor may have."""
LEAST_TURN = 0.02
"""Difference [rad/s] of the two that resolution and phase may make besides."""
NO_TRACTION, TRACTION = 0.01, 0.15
"""Torque over load and radius of a wheel that drives nothing (any soil resists more), and of one that surely drives."""
ODD_SLIP = 0.2
"""Distance from the other wheels' slip that speaks against the wheel's speed rather than its torque."""
LOAD_SUM = 0.15
"""Share of the weight by which the loads' sum must be wrong; lost zeros and what is carried stay below it."""
LOAD_AXLE = 0.05
"""Share of the weight by which the load transfer of an axle without fault may be wrong."""
LOAD_SIDE = 0.10
"""Share of an axle's load by which its left and right must differ more than the other axle's for one to be named."""
ANY_LOAD = 0.6
"""Wrong share of the weight that nothing carried explains, so that all load cells are wrong."""


def implausible(
    window: Window,
    rig: Rig,
    min_speed: float,
    max_turn: float,
    bin_length: float,
    resolution: Mapping[str, Resolution],
    motor_speed: Array | None = None,
) -> tuple[str, ...]:
    """Channels of a forward window (see `window.forward`) that lie in it, in the order of rig.channels.

    min_speed [m/s] and max_turn as the estimator's gates; resolution by channel name;
    motor_speed [rad/s] (N, W), nan where unknown, may be named as "motor_speed.FL".
    """
    motor = np.full(window.speed.shape, np.nan) if motor_speed is None else motor_speed
    scene = scene_of(window, rig, min_speed, max_turn, bin_length, resolution, motor)
    if not scene.driving.any():
        return ()
    named: set[str] = set()
    for check in CHECKS:
        if found := set(check(scene)):
            named |= found
            window = without(window, rig, found)
            motor = np.where([f"motor_speed.{w}" in found for w in rig.wheels], np.nan, motor)
            scene = scene_of(window, rig, min_speed, max_turn, bin_length, resolution, motor)
    order = (*rig.channels, *(f"motor_speed.{w}" for w in rig.wheels))
    return tuple(name for name in order if name in named)


def without(window: Window, rig: Rig, channels: set[str]) -> Window:
    """The window without any reading of these channels."""
    values: dict[str, Array] = {}
    for name in channels & set(rig.channels):
        quantity, _, wheel = name.partition(".")
        values.setdefault(quantity, getattr(window, quantity).copy())
        values[quantity][..., rig.wheels.index(wheel) if wheel else slice(None)] = np.nan
    changed: dict[str, Any] = values
    return replace(window, **changed) if changed else window


def frozen(scene: Scene) -> Iterator[str]:
    """Channels that read the very same for longer than their noise allows, while the vehicle drives."""
    window, rig = scene.window, scene.rig
    quantities = (*WHEEL_QUANTITIES, *VEHICLE_QUANTITIES)
    value = np.column_stack([getattr(window, q) for q in quantities])
    with np.errstate(invalid="ignore"):
        same = np.abs(np.diff(value, axis=0)) <= SAME * np.abs(value[1:])
    same &= scene.driving[1:, None]
    often = np.flatnonzero(same.sum(axis=0) >= scene.sustained).tolist()
    if not often:
        return
    variance = np.column_stack([window.variance[q] for q in quantities])
    for i in often:
        name = rig.channels[i]
        noise, resolution = rig.noise[name.partition(".")[0]], scene.resolution.get(name, Resolution(0.0, False))
        stretches = [(first, last) for first, last in runs(same[:, i]) if last - first >= scene.sustained]
        within = sum(last - first for first, last in stretches)
        if same[:, i].sum() - within > COARSE * (np.isfinite(value[:, i]).sum() - within):
            continue
        if any(_stuck(float(value[a, i]), variance[a : b + 1, i], noise, resolution) for a, b in stretches):
            yield name


def _stuck(value: float, variance: Array, noise: SensorNoise, resolution: Resolution) -> bool:
    """Whether noise would have moved a reading that is the same in bins of these variances (N,).

    At most, where the truth is in the middle of the reading's step, noise leaves one sample
    in it with the chance erf(step / (2 sqrt(2) sd)).
    """
    of_sample = noise.absolute**2 + (noise.relative**2 + noise.of_mean**2) * value**2
    if of_sample == 0.0 or (resolution.rests_at_zero and abs(value) <= resolution.step):
        return False
    samples = float((of_sample / variance).sum())
    same = math.erf(resolution.step / (2.0 * math.sqrt(2.0 * of_sample)))
    return (samples - 1.0) * math.log(max(same, CHANCE)) < math.log(CHANCE)


def not_turning(scene: Scene) -> Iterator[str]:
    """Speeds of wheels that stand, unbraked, while the vehicle drives; the ground speed where all of them rest."""
    window, rig = scene.window, scene.rig
    ground = window.ground_speed[:, None]
    with np.errstate(invalid="ignore"):
        still = scene.driving[:, None] & (rig.radius * window.speed < STILL_SHARE * ground)
        braked = scene.traction < -BRAKED
        idle = np.abs(scene.traction) < NO_TRACTION
    if lasts(np.logical_and.reduce(still & idle, axis=1), scene.sustained):
        yield "ground_speed"
        return
    for i, wheel in enumerate(rig.wheels):
        if lasts(still[:, i] & ~braked[:, i], scene.sustained):
            yield f"speed.{wheel}"


def geared(scene: Scene) -> Iterator[str]:
    """Of a wheel and its motor, whose speeds do not go together, the one farther from the other wheels'.

    Both, where this is so of most wheels: the gear ratio may be wrong, and the torques with it.
    """
    window, rig, motor = scene.window, scene.rig, scene.motor_speed
    with np.errstate(invalid="ignore"):
        noise = np.sqrt(2.0 * window.variance["speed"])
        apart = np.abs(motor - window.speed) > GEAR_SLACK * np.abs(window.speed) + DEVIATIONS * noise + LEAST_TURN
    apart &= scene.driving[:, None]
    wrong = [i for i in range(len(rig.wheels)) if lasts(apart[:, i], scene.sustained)]
    good = [i for i in range(len(rig.wheels)) if i not in wrong]
    for i in wrong:
        if len(wrong) > len(good):
            yield f"speed.{rig.wheels[i]}"
            yield f"motor_speed.{rig.wheels[i]}"
            continue
        where = apart[:, i]
        usual = median((rig.radius * window.speed)[where][:, good])
        of_motor, of_wheel = (abs(median(rig.radius[i] * s[where, i]) - usual) for s in (motor, window.speed))
        yield f"{'motor_speed' if of_motor > of_wheel else 'speed'}.{rig.wheels[i]}"


def loads(scene: Scene) -> Iterator[str]:
    """The load that alone explains why the loads do not add up to the weight; all of them where nothing else can."""
    window, rig, chassis = scene.window, scene.rig, scene.rig.chassis
    if chassis is None or set(rig.front.tolist()) != {True, False}:
        return
    weight = chassis.mass * GRAVITY
    excess = _axle_excess(window, rig, chassis) / weight
    total = excess.sum(axis=1)
    with np.errstate(invalid="ignore"):
        wrong = scene.driving & (np.abs(total) > LOAD_SUM)
    if not lasts(wrong, scene.sustained):
        return
    front, rear = np.median(excess[wrong], axis=0)
    if not -ANY_LOAD < front + rear < ANY_LOAD:
        yield from (f"load.{wheel}" for wheel in rig.wheels)
        return
    if min(abs(front), abs(rear)) > LOAD_AXLE:
        return  # something is carried
    of_axle = [np.flatnonzero(rig.front), np.flatnonzero(~rig.front)]
    bad, sound = of_axle if abs(front) > abs(rear) else of_axle[::-1]
    if len(bad) == len(sound) == 2:
        left, other = (
            median(window.load[wrong][:, axle[0]] / window.load[wrong][:, axle].sum(axis=1)) for axle in (bad, sound)
        )
        if abs(left - other) > LOAD_SIDE:
            heavier = 0 if left > other else 1
            yield f"load.{rig.wheels[bad[heavier if front + rear > 0.0 else 1 - heavier]]}"


def _axle_excess(window: Window, rig: Rig, chassis: Chassis) -> Array:
    """By how much [N] the loads on front and rear axle exceed those of mass, draft, slope and inertia, (N, 2)."""
    draft, pitch, acceleration = (zero_if_unknown(a) for a in (window.draft, window.pitch, window.acceleration))
    due = np.stack(axle_loads(chassis, draft, pitch, acceleration), axis=1)
    told = np.stack([window.load[:, rig.front].sum(axis=1), window.load[:, ~rig.front].sum(axis=1)], axis=1)
    return np.asarray(told - due)


def traction(scene: Scene) -> Iterator[str]:
    """Torques, speeds or the ground speed of wheels that slip without driving, or drive without slipping."""
    rig, slip, grip = scene.rig, scene.slip, scene.traction
    with np.errstate(invalid="ignore"):
        idle = (slip > FALSE_SLIP) & (grip < NO_TRACTION)
        dragged = (slip < -FALSE_SLIP) & (grip > TRACTION)
    idles = [i for i in range(len(rig.wheels)) if lasts(idle[:, i], scene.sustained)]
    drags = [i for i in range(len(rig.wheels)) if lasts(dragged[:, i], scene.sustained)]
    if 2 * len(drags) > len(rig.wheels):
        yield "ground_speed"
        return
    if len(idles) == len(rig.wheels) and not _pulls(scene, np.logical_and.reduce(idle, axis=1)):
        yield "ground_speed"  # or the torques: coasting at a ground speed that is told too low looks the same
    yield from (f"torque.{rig.wheels[i]}" for i in idles)
    others = [i for i in range(len(rig.wheels)) if i not in {*idles, *drags}]
    for i in drags:
        where = dragged[:, i]
        usual = median(slip[where][:, others])
        odd = math.isfinite(usual) and abs(median(slip[where, i]) - usual) > ODD_SLIP
        yield f"{'speed' if odd else 'torque'}.{rig.wheels[i]}"


def _pulls(scene: Scene, where: Mask) -> bool:
    """Whether draft, slope and inertia ask the wheels to pull at these instants."""
    chassis = scene.rig.chassis
    if chassis is None:
        return bool(median(scene.window.draft[where]) > 0.0)
    return median(pull_given(scene.window, chassis)[where]) > TRACTION / 3.0 * chassis.mass * GRAVITY


CHECKS: Sequence[Callable[[Scene], Iterator[str]]] = (
    frozen, not_turning, geared, loads, accelerated, traction, scaled, pulling,
)  # fmt: skip
"""In their order: what one names the next ones do not see."""
