"""What a soil lets the vehicle do: pull over slip, largest draft, steepest grade.

All wheels turn at the same slip.  Loads follow the pull (load transfer) and the entry
angles follow the loads; both are solved together by Newton.  Gradients by the soil
parameters come with its last step, so a posterior propagates through them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.window import Rig
from soilbus.terra.effects.steady import CompletedModel
from soilbus.terra.stress import lumped_modulus
from soilbus.terra.vehicle import GRAVITY, Chassis, axle_loads
from soilbus.terra.wheel import (
    MAX_ENTRY_ANGLE,
    Soil,
    WheelModel,
    WheelState,
    entry_angle_for_load,
)

Array = NDArray[np.float64]

GRID = 14
MIN_SLIP = 0.02
MAX_SKID = 0.3
SKID_GRID = 9
SLIP_STEP = 1e-4
"""For the change of pull and torque with slip."""
TORQUE_TOLERANCE = 1e-4
"""Of the largest torque of the curve; what is left is mended linearly."""
PULL_TOLERANCE = 1e-3
"""Newton step of the pull, over the weight, that is the last: it leaves some 1e-6 of the weight."""
SMALL_PULL = 1e-2
"""Difference of pull [N] from which the load transfer's slope is taken."""
MAX_ITERATIONS = 12


@dataclass(frozen=True, slots=True)
class PullCurve:
    """Steady pull at some slips, each on the level (pull is draft) or up a grade without draft.

    slip, on_grade, pull [N] and the summed wheel torque have shape (S,); torque [N m],
    entry_angle [rad] have shape (W, S).  pull_by_soil (6, S) and torque_by_soil (W, 6, S)
    are gradients by the parameters of Soil in SI.  pull is nan where no balance exists.
    """

    slip: Array
    on_grade: NDArray[np.bool_]
    pull: Array
    torque: Array
    entry_angle: Array
    pull_by_soil: Array
    torque_by_soil: Array

    def part(self, on_grade: bool) -> PullCurve:
        """Only the level or only the graded columns."""
        keep = self.on_grade == on_grade
        return PullCurve(
            self.slip[keep], self.on_grade[keep], self.pull[keep], self.torque[:, keep], self.entry_angle[:, keep],
            self.pull_by_soil[:, keep], self.torque_by_soil[..., keep],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Capability:
    """The largest pull [N] with its gradient (6,), the slip it needs and what limits it."""

    pull: float
    gradient: Array
    slip: float
    limit: Literal["traction", "torque", "slip"]


@dataclass(frozen=True, slots=True)
class _Axles:
    """Wheels alike in axle, radius and width are computed once."""

    chassis: Chassis
    radius: Array
    width: Array
    front: NDArray[np.bool_]
    share: Array
    count: Array
    of_wheel: NDArray[np.intp]

    @classmethod
    def of(cls, rig: Rig) -> _Axles:
        if rig.chassis is None:
            raise ValueError("a capability needs the vehicle's mass and geometry")
        kinds = list(zip(rig.radius.tolist(), rig.width.tolist(), rig.front.tolist(), strict=True))
        unlike = list(dict.fromkeys(kinds))
        radius, width, front = (np.array(column)[:, None] for column in zip(*unlike, strict=True))
        count = np.array([[float(kinds.count(kind))] for kind in unlike])
        share = 1.0 / np.where(front, rig.front.sum(), (~rig.front).sum())
        of_wheel = np.array([unlike.index(kind) for kind in kinds])
        return cls(rig.chassis, radius, width, front, share, count, of_wheel)

    def loads(self, pull: Array, on_grade: NDArray[np.bool_]) -> Array:
        weight = self.chassis.mass * GRAVITY
        pitch = np.arcsin(np.clip(np.where(on_grade, pull, 0.0) / weight, -0.99, 0.99))
        front, rear = axle_loads(self.chassis, np.where(on_grade, 0.0, pull), pitch, 0.0)
        return np.asarray(np.where(self.front, front, rear) * self.share)


def pull_curve(
    soil: Soil,
    rig: Rig,
    model: WheelModel | CompletedModel,
    slip: Array,
    on_grade: NDArray[np.bool_],
    start: PullCurve | None = None,
) -> PullCurve:
    """Pull that balances itself at each slip (S,); `start` is the curve of a similar soil.

    Raises ValueError for a rig without a chassis.
    """
    axles = _Axles.of(rig)
    completed = model if isinstance(model, CompletedModel) else CompletedModel(model)
    K_L = lumped_modulus(soil.k_c, soil.k_phi, axles.width)
    slips, radius, width, K_L = (a.copy() for a in np.broadcast_arrays(slip, axles.radius, axles.width, K_L))
    shape, tolerance = slips.shape, PULL_TOLERANCE * axles.chassis.mass * GRAVITY
    tan_phi = np.tan(soil.phi)

    def state(angle: Array) -> WheelState:
        return WheelState(angle, slips, radius, width, K_L, soil.n, tan_phi, soil.c, soil.K)

    if start is not None and np.array_equal(start.slip, slip) and np.isfinite(start.entry_angle).all():
        pull = np.where(np.isfinite(start.pull), start.pull, 0.0)
        angle = start.entry_angle[[int(np.argmax(axles.of_wheel == k)) for k in range(shape[0])]]
        load = axles.loads(pull, on_grade)
    else:
        pull = np.zeros(len(slip))
        load = axles.loads(pull, on_grade)
        guess = state(np.full(shape, np.nan))
        angle = entry_angle_for_load(np.broadcast_to(load, shape), guess, completed.model, tolerance=1e-2)
    with np.errstate(all="ignore"):
        for _ in range(MAX_ITERATIONS):
            forces, d = completed.forces_and_derivatives(
                state(angle), ~axles.front, load, np.where(on_grade, 0.0, pull), axles.chassis.mass
            )
            by_load = d[1:, 0] / d[0, 0]  # pull and torque by load, the entry angle following
            shift = (axles.loads(pull + SMALL_PULL, on_grade) - axles.loads(pull, on_grade)) / SMALL_PULL
            off = load - forces[0]
            slope = (axles.count * by_load[0] * shift).sum(0) - 1.0
            change = -((axles.count * (forces[1] + by_load[0] * off)).sum(0) - pull) / slope
            pull = pull + change
            load = axles.loads(pull, on_grade)
            new_angle = angle + (load - forces[0]) / d[0, 0]
            angle = np.clip(new_angle, 0.5 * angle, np.minimum(2.0 * angle, MAX_ENTRY_ANGLE))
            if not np.nanmax(np.abs(change), initial=0.0) > tolerance:
                break
        by_soil = _by_soil(d, soil, axles.width)
        pull_by_soil = (axles.count[:, None] * (by_soil[1] - by_load[0][:, None] * by_soil[0])).sum(0) / -slope
        load_change = shift[:, None] * pull_by_soil - by_soil[0]
        torque = forces[2] + by_load[1] * (load - forces[0])
        torque_by_soil = by_soil[2] + by_load[1][:, None] * load_change
        balanced = np.isfinite(angle).all(0) & (load > 0.0).all(0) & (np.abs(change) <= tolerance)
    w = axles.of_wheel
    return PullCurve(
        slip, on_grade, np.where(balanced, pull, np.nan), torque[w], angle[w], pull_by_soil, torque_by_soil[w]
    )


def _by_soil(d: Array, soil: Soil, width: Array) -> Array:
    """(3, A, 6, S): derivatives of load, pull and torque by the soil parameters, entry angle held."""
    sec2 = 1.0 + np.tan(soil.phi) ** 2
    return np.stack([d[:, 2] / width, d[:, 2], d[:, 3], d[:, 4] * sec2, d[:, 5], d[:, 6]], axis=2)


@cache
def slip_grid(max_slip: float) -> Array:
    """Slips at which a pull curve is worth knowing."""
    return np.geomspace(MIN_SLIP, max_slip, GRID)


def largest_pull(
    curve: PullCurve, torque_limit: Array, soil: Soil, rig: Rig, model: WheelModel | CompletedModel
) -> Capability | None:
    """Largest pull of a curve (all of it level, or all graded) within wheel torques up to torque_limit (W,) [N m].

    nan in torque_limit: that wheel's limit is not known and does not count.  Where even
    the least slip of the curve asks for more torque than there is, the pull is that of
    wheels that skid: below zero, as only a push or a slope moves the vehicle.  None where
    the soil carries no steady state at all.
    """
    known = np.isfinite(torque_limit)
    balanced = np.isfinite(curve.pull)
    usable = balanced & (curve.torque[known] <= torque_limit[known, None]).all(0)
    if not balanced.any():
        return None
    if not usable.any():
        if curve.slip[0] < 0.0:
            least = int(np.argmin(np.where(balanced, curve.pull, np.inf)))
            return Capability(
                float(curve.pull[least]), curve.pull_by_soil[:, least], float(curve.slip[least]), "torque"
            )
        skid = np.linspace(-MAX_SKID, curve.slip[0], SKID_GRID)
        towed = pull_curve(soil, rig, model, skid, np.full(SKID_GRID, bool(curve.on_grade[0])))
        return largest_pull(towed, torque_limit, soil, rig, model)
    best = int(np.argmax(np.where(usable, curve.pull, -np.inf)))
    after = best + 1
    if after < len(curve.slip) and balanced[after] and curve.pull[after] > curve.pull[best]:
        return _at_torque_limit(curve, best, torque_limit, soil, rig, model)
    limit: Literal["slip", "traction"] = "slip" if after == len(curve.slip) else "traction"
    return Capability(float(curve.pull[best]), curve.pull_by_soil[:, best], float(curve.slip[best]), limit)


def _at_torque_limit(
    curve: PullCurve, below: int, torque_limit: Array, soil: Soil, rig: Rig, model: WheelModel | CompletedModel
) -> Capability:
    """The pull where the first wheel meets its torque limit, between two points of the curve.

    Newton on the wheel that is most above its limit, inside a bracket.
    """
    low, high = curve.slip[below], curve.slip[below + 1]
    over = [float(np.nanmax(curve.torque[:, i] - torque_limit)) for i in (below, below + 1)]
    slip = float(low - (high - low) * over[0] / (over[1] - over[0]))
    graded = np.full(2, bool(curve.on_grade[below]))
    for _ in range(MAX_ITERATIONS):
        at = pull_curve(soil, rig, model, np.array([slip, slip + SLIP_STEP]), graded)
        wheel = int(np.nanargmax(at.torque[:, 0] - torque_limit))
        torque_slope, pull_slope = ((a[1] - a[0]) / SLIP_STEP for a in (at.torque[wheel], at.pull))
        miss = torque_limit[wheel] - at.torque[wheel, 0]
        if abs(miss) < TORQUE_TOLERANCE * curve.torque[wheel].max():
            break
        low, high = (slip, high) if miss > 0.0 else (low, slip)
        step = slip + float(miss / torque_slope) if torque_slope > 0.0 else math.inf
        slip = step if low < step < high else (low + high) / 2.0
    gradient = at.pull_by_soil[:, 0] - pull_slope / torque_slope * at.torque_by_soil[wheel, :, 0]
    return Capability(float(at.pull[0] + pull_slope / torque_slope * miss), gradient, float(at.slip[0]), "torque")


def slip_for_pull(curve: PullCurve, pull: float) -> tuple[float, float] | None:
    """Slip at which a level curve gives this pull [N], and the wheels' summed torque [N m] there.

    None where no slip of the curve gives it.
    """
    torque = curve.torque.sum(0)
    enough = np.flatnonzero(np.isfinite(curve.pull) & (curve.pull >= pull))
    if not len(enough):
        return None
    i = int(enough[0])
    if i == 0 or not np.isfinite(curve.pull[i - 1]):
        return float(curve.slip[i]), float(torque[i])
    part = (pull - curve.pull[i - 1]) / (curve.pull[i] - curve.pull[i - 1])
    slip = curve.slip[i - 1] + part * (curve.slip[i] - curve.slip[i - 1])
    return float(slip), float(torque[i - 1] + part * (torque[i] - torque[i - 1]))
