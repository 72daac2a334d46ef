"""The drive line of the simulated vehicle: one condition for the slip of each wheel.

    motor        sum of b_i u_i (s_i - s) = 0           the mean of its wheels' rim speeds is that at the common slip s
    coupling     D = clip(D - k d, -B, B),  B = bias |S|  its two sides differ in torque by B at most, else in no speed
    free wheel   T_i = 0

u_i = 1 / (1 - s_i) is a wheel's rim speed over the ground speed; D, S and d are difference and sum of the torques and
difference of the speeds on the two sides of a differential. One formula holds for all: an open differential has the
bias 0 (equal torques), a locked one inf (equal speeds), one of limited slip a finite one. The clip is exact for any
k > 0, which only decides how Newton's method gets there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.config.model import Axle, Config, Wheel

__all__ = ["BIAS", "Drivetrain", "drivetrain_of", "own_motors"]

BIAS = {"open": 0.0, "limited": 0.25, "locked": math.inf}
"""Greatest difference of the torques over their sum where `torque_bias` is not given: none, that of a clutch pack of
bias ratio 1.7 (`config.model.Axle.torque_bias`), any."""
_OF_DRIVE = {"torque", "torque_limit", "max_torque", "motor_speed", "differential", "torque_bias"}
"""Keys that say that an [[axle]] has a drive; a load cell alone does not."""


@dataclass(frozen=True, slots=True)
class Drivetrain:
    """Drive line of M wheels: one condition a row, and the torques that are limited.

    Attributes
    ----------
    speed
        (M, M), weights of the rim speeds over the ground speed: of a motor (sum 1), or one side of a coupling less the
        other; zero for a free wheel.
    torque
        (M, M), weights of the torques: one side of a coupling less the other, or a free wheel alone; zero for a motor.
    bias
        (M,), of a coupling; 0 in all other rows.
    is_motor
        (M,).
    leader
        (M,), the wheel whose given deviation from the common slip the wheel shares; -1 for a free wheel.
    limited, limit
        (L, M) weights of the torques that have a limit, wheels first, and these limits [N m] (L,); inf for none.
    """

    speed: Array
    torque: Array
    bias: Array
    is_motor: NDArray[np.bool_]
    leader: NDArray[np.intp]
    limited: Array
    limit: Array


def own_motors(limit: Sequence[float] | Array) -> Drivetrain:
    """Return a motor for each wheel, with these limits [N m] (M,); inf for none."""
    n = len(limit)
    return Drivetrain(
        np.eye(n), np.zeros((n, n)), np.zeros(n), np.ones(n, bool), np.arange(n), np.eye(n), np.asarray(limit, float)
    )


def drivetrain_of(config: Config) -> Drivetrain:
    """Return the drive line that the configuration describes.

    Parameters
    ----------
    config
        An [[axle]] with a torque, a motor's speed, a limit or a differential drives its wheels together, `both` those
        of both axles; so does one signal of torque or speed that is mapped for several wheels. Every other driven
        wheel has a motor of its own.

    Returns
    -------
    Couplings are those of `differential` of each axle and of `both`, open on an axle and locked between the axles
    where it is not given. Wheels on one signal of speed turn together.
    """
    wheels = config.wheel
    n = len(wheels)
    drive = own_motors([wheel.max_torque or math.inf for wheel in wheels])
    speed, torque, bias = drive.speed.copy(), drive.torque.copy(), drive.bias.copy()
    is_motor, leader = drive.is_motor.copy(), drive.leader.copy()
    for i, wheel in enumerate(wheels):
        if not wheel.driven:
            speed[i], torque[i, i], is_motor[i], leader[i] = 0.0, 1.0, False, -1
    ratio = np.array([getattr(config.axle_named(wheel.axle), "gear_ratio", 1.0) for wheel in wheels])
    per_turn = ratio / np.array([wheel.radius for wheel in wheels])
    for group in _groups(config):
        first = group[0]
        leader[group] = first
        speed[first] = 0.0
        speed[first, group] = 1.0 / len(group)
        for row, (one, other, bias_of) in zip(group[1:], _couplings(config, group), strict=True):
            is_motor[row], bias[row], speed[row] = False, bias_of, 0.0
            for side, sign in ((one, 1.0), (other, -1.0)):
                speed[row, side] = sign * per_turn[side] / len(side) / per_turn[group].mean()
                torque[row, side] = sign / ratio[side] * ratio[group].mean()
    weights, limits = _limits_of_axles(config, ratio)
    limited, limit = np.concatenate([np.eye(n), weights]), np.concatenate([drive.limit, limits])
    return Drivetrain(speed, torque, bias, is_motor, leader, limited, limit)


def _groups(config: Config) -> list[list[int]]:
    """Driven wheels that one motor turns, for each motor of several wheels."""
    driven = [i for i, wheel in enumerate(config.wheel) if wheel.driven]
    together = [_wheels_of(axle, config.wheel) for axle in config.axle if axle.model_fields_set & _OF_DRIVE]
    for role in ("torque", "speed"):
        together += [[config.wheel.index(wheel) for wheel in same] for same in config.same_signal(role)]
    group_of = {i: {i} for i in driven}
    for wheels in together:
        merged: set[int] = set().union(*(group_of[i] for i in wheels if i in group_of))
        group_of |= dict.fromkeys(merged, merged)
    return [sorted(group) for i, group in group_of.items() if i == min(group) and len(group) > 1]


def _wheels_of(axle: Axle, wheels: Sequence[Wheel]) -> list[int]:
    return [i for i, wheel in enumerate(wheels) if axle.name in ("both", wheel.axle)]


def _couplings(config: Config, group: Sequence[int]) -> Iterator[tuple[list[int], list[int], float]]:
    """The two sides of each differential behind a motor, and its bias: one less than the motor has wheels."""
    on_one_signal = [{config.wheel.index(wheel) for wheel in same} for same in config.same_signal("speed")]
    on_axle = {name: [i for i in group if config.wheel[i].axle == name] for name in config.axles}
    for name, wheels in on_axle.items():
        for one, other in pairwise(wheels):
            rigid = any({one, other} <= same for same in on_one_signal)
            yield [one], [other], math.inf if rigid else _bias(config.axle_named(name), "open")
    rigid = any(set(group) <= same for same in on_one_signal)
    for front, rear in pairwise(filter(None, on_axle.values())):
        yield front, rear, math.inf if rigid else _bias(config.axle_named("both"), "locked")


def _bias(axle: Axle | None, otherwise: str) -> float:
    """Greatest difference of the torques over their sum."""
    kind = otherwise if axle is None else axle.differential
    return BIAS[kind] if kind == "locked" or axle is None or axle.torque_bias is None else axle.torque_bias


def _limits_of_axles(config: Config, ratio: Array) -> tuple[Array, Array]:
    """Weights (L, M) of the torques that are limited together, and their limits [N m] (L,)."""
    weights, limits = [np.empty((0, len(config.wheel)))], []
    for axle in config.axle:
        if axle.max_torque is not None:
            weight = np.zeros((1, len(config.wheel)))
            wheels = _wheels_of(axle, config.wheel)
            weight[0, wheels] = 1.0 / ratio[wheels] if axle.name == "both" else 1.0
            weights.append(weight)
            limits.append(axle.max_torque)
    return np.concatenate(weights), np.array(limits, float)
