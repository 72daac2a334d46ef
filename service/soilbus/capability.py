"""What a soil lets the vehicle do: pull over slip, largest draft, steepest grade.

All wheels turn at the same slip.  Loads follow the pull (load transfer) and the entry
angles follow the loads; both are solved together by Newton.  Gradients by the soil
parameters are exact at the solution, so a posterior propagates through them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.window import Rig
from soilbus.terra.stress import lumped_modulus
from soilbus.terra.vehicle import GRAVITY, axle_loads
from soilbus.terra.wheel import Soil, WheelModel, WheelState, entry_angle_for_load, wheel_forces_and_derivatives

Array = NDArray[np.float64]
Against = Literal["draft", "grade"]

_GRID = 14
_MIN_SLIP = 0.02


@dataclass(frozen=True, slots=True)
class PullCurve:
    """Steady pull over slip: slip, pull [N] (S,), torque [N m] per wheel (W, S).

    pull_by_soil (6, S) and torque_by_soil (W, 6, S) are gradients by the parameters of
    Soil in SI.  Where the loads cannot be carried or no balance exists, pull is nan.
    """

    slip: Array
    pull: Array
    torque: Array
    sinkage: Array
    pull_by_soil: Array
    torque_by_soil: Array


@dataclass(frozen=True, slots=True)
class Capability:
    """The largest pull [N] with its gradient (6,), the slip it needs and what limits it."""

    pull: float
    gradient: Array
    slip: float
    limit: Literal["traction", "torque", "slip"]


def pull_curve(soil: Soil, rig: Rig, model: WheelModel, slip: Array, against: Against) -> PullCurve:
    """Pull that balances itself at each slip (S,): as draft on the level, or up a grade without draft.

    Raises ValueError for a rig without a chassis.
    """
    if rig.chassis is None:
        raise ValueError("a capability needs the vehicle's mass and geometry")
    W, S = len(rig.wheels), len(slip)
    front = rig.front[:, None]
    share = 1.0 / np.where(front, rig.front.sum(), (~rig.front).sum())

    def loads(pull: Array) -> Array:
        if against == "draft":
            axles = axle_loads(rig.chassis, pull, 0.0, 0.0)  # type: ignore[arg-type]
        else:
            sine = np.clip(pull / (rig.chassis.mass * GRAVITY), -0.99, 0.99)  # type: ignore[union-attr]
            axles = axle_loads(rig.chassis, 0.0, np.arcsin(sine), 0.0)  # type: ignore[arg-type]
        return np.where(front, axles[0], axles[1]) * share

    def state(angle: Array) -> WheelState:
        wide = [np.broadcast_to(a[:, None], (W, S)).ravel() for a in (rig.radius, rig.width)]
        K_L = lumped_modulus(soil.k_c, soil.k_phi, wide[1])
        return WheelState(angle.ravel(), np.tile(slip, W), *wide, K_L, soil.n, np.tan(soil.phi), soil.c, soil.K)

    pull = np.zeros(S)
    step = 1.0
    load = loads(pull)
    angle = entry_angle_for_load(load.ravel(), state(np.full((W, S), np.nan)), model, tolerance=1e-3).reshape(W, S)
    with np.errstate(all="ignore"):
        for _ in range(8):
            forces, d = wheel_forces_and_derivatives(state(angle), model)
            forces, d = forces.reshape(3, W, S), d.reshape(3, 7, W, S)
            ratio = d[1, 0] / d[0, 0]
            off = load - forces[0]
            shift = (loads(pull + step) - loads(pull - step)) / (2.0 * step)
            slope = (ratio * shift).sum(0) - 1.0
            change = -((forces[1] + ratio * off).sum(0) - pull) / slope
            pull = pull + change
            load = loads(pull)
            angle = np.clip(angle + (load - forces[0]) / d[0, 0], 0.5 * angle, np.minimum(2.0 * angle, 1.4))
            if np.nanmax(np.abs(change), initial=0.0) < 0.5:
                break
        by_soil = _by_soil(d, soil, rig.width)
        load_by_soil, pull_by_soil, torque_by_soil = by_soil
        total = (pull_by_soil - ratio[:, None] * load_by_soil).sum(0) / -slope
        load_change = shift[:, None] * total - load_by_soil
        torque_ratio = d[2, 0] / d[0, 0]
        torque = forces[2] + torque_ratio * (load - forces[0])
        torque_total = torque_by_soil + torque_ratio[:, None] * load_change
        buried = ~(np.isfinite(angle).all(0) & (load > 0.0).all(0))
        sinkage = rig.radius[:, None] * (1.0 - np.cos(angle))
    return PullCurve(slip, np.where(buried, np.nan, pull), torque, sinkage, total, torque_total)


def _by_soil(d: Array, soil: Soil, width: Array) -> Array:
    """(3, W, 6, S): derivatives of load, pull and torque by the soil parameters, entry angle held."""
    sec2 = 1.0 + np.tan(soil.phi) ** 2
    return np.stack([d[:, 2] / width[:, None], d[:, 2], d[:, 3], d[:, 4] * sec2, d[:, 5], d[:, 6]], axis=2)


def largest_pull(
    soil: Soil, rig: Rig, model: WheelModel, torque_limit: Array | None, max_slip: float, against: Against
) -> Capability | None:
    """Largest steady pull over slips up to max_slip and wheel torques up to torque_limit (W,) [N m].

    nan in torque_limit: that wheel's limit is not known and does not count.  None where
    the soil carries no steady state at all.
    """
    grid = np.geomspace(_MIN_SLIP, max_slip, _GRID)
    curve = pull_curve(soil, rig, model, grid, against)
    limits = np.full(len(rig.wheels), np.nan) if torque_limit is None else torque_limit
    usage = np.nanmax(np.concatenate([curve.torque / limits[:, None], np.zeros((1, len(grid)))]), axis=0)
    usable = np.isfinite(curve.pull) & (usage <= 1.0)
    if not usable.any():
        return None if not np.isfinite(curve.pull).any() or usage[0] <= 1.0 else _torque_bound(curve)
    best = int(np.nanargmax(np.where(usable, curve.pull, -np.inf)))
    after = best + 1
    if after < len(grid) and np.isfinite(curve.pull[after]) and curve.pull[after] > curve.pull[best]:
        # The torque limit lies between two grid points: take the pull where it is met.
        part = float((1.0 - usage[best]) / (usage[after] - usage[best]))
        slip = float(grid[best] + part * (grid[after] - grid[best]))
        at = pull_curve(soil, rig, model, np.array([slip, grid[after]]), against)
        wheel = int(np.nanargmax(at.torque[:, 0] / limits))
        torque_slope = (at.torque[wheel, 1] - at.torque[wheel, 0]) / (at.slip[1] - at.slip[0])
        pull_slope = (at.pull[1] - at.pull[0]) / (at.slip[1] - at.slip[0])
        gradient = at.pull_by_soil[:, 0] - pull_slope / torque_slope * at.torque_by_soil[wheel, :, 0]
        return Capability(float(at.pull[0]), gradient, slip, "torque")
    limit: Literal["traction", "slip"] = "slip" if best == len(grid) - 1 else "traction"
    return Capability(float(curve.pull[best]), curve.pull_by_soil[:, best], float(grid[best]), limit)


def _torque_bound(curve: PullCurve) -> Capability:
    return Capability(0.0, np.zeros(6), float(curve.slip[0]), "torque")


def torque_for_pull(soil: Soil, rig: Rig, model: WheelModel, pull: float, max_slip: float) -> tuple[float, float] | None:
    """Sum of wheel torques [N m] and slip at which the wheels give this pull [N] on the level.

    None where no slip up to max_slip gives it.
    """
    grid = np.geomspace(_MIN_SLIP, max_slip, _GRID)
    curve = pull_curve(soil, rig, model, grid, "draft")
    torque = curve.torque.sum(0)
    enough = np.flatnonzero(np.isfinite(curve.pull) & (curve.pull >= pull))
    if not len(enough):
        return None
    i = int(enough[0])
    if i == 0:
        return float(torque[0]), float(grid[0])
    part = (pull - curve.pull[i - 1]) / (curve.pull[i] - curve.pull[i - 1])
    slip = grid[i - 1] + part * (grid[i] - grid[i - 1])
    return float(torque[i - 1] + part * (torque[i] - torque[i - 1])), float(slip)
