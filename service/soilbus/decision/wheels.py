"""The wheels over slip on many soils at once, on the level: forces, and how they change with load and slip.

All driven wheels turn at the same slip; the others roll at the slip that takes no torque.
Loads follow the pull (load transfer) and entry angles follow the loads; both are solved
together by Newton.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.decision.uncertain_model import ModelOfRows, UncertainModel
from soilbus.estimation.window import Rig
from soilbus.terra.effects.steady import CompletedModel, Wheel
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soil_laws import lumped_modulus
from soilbus.terra.vehicle import GRAVITY, Chassis, axle_loads
from soilbus.terra.wheel import MAX_ENTRY_ANGLE, WheelModel, WheelState

TOLERANCE = 1e-3
"""Newton step of pull and load, over the weight, that is the last: it leaves some 1e-6 of the weight."""
RIDGE = 1e-6
"""Share of the soils' spread below which a direction tells nothing of how pull and angles change."""
LEAST = 1e-12
MAX_ITERATIONS = 12
TEST_LOAD = 0.9
ROLLING_SLIP, MAX_ROLLING_SLIP = -0.05, 0.5
"""Slip from which that of a wheel without torque is looked for, and the skid that it never passes."""


@dataclass(frozen=True, slots=True)
class Axles:
    """Wheels alike in axle, radius, width and whether they are driven count as one of A kinds.

    radius, width [m], front, driven and count have shape (A, 1).  A wheel's load is level cos + tilt sin of
    the slope + lever times the draft, (A, 1) each; of_wheel (W,) is each wheel's kind.
    """

    chassis: Chassis
    radius: Array
    width: Array
    front: NDArray[np.bool_]
    driven: NDArray[np.bool_]
    count: Array
    level: Array
    tilt: Array
    lever: Array
    of_wheel: NDArray[np.intp]

    @classmethod
    def of(cls, rig: Rig, driven: NDArray[np.bool_] | None = None) -> Axles:
        """The kinds of a rig's wheels, all driven or those of `driven` (W,); ValueError for a rig without a chassis."""
        if rig.chassis is None:
            raise ValueError("a capability needs the vehicle's mass and geometry")
        drives = [True] * len(rig.wheels) if driven is None else driven.tolist()
        kinds = list(zip(rig.radius.tolist(), rig.width.tolist(), rig.front.tolist(), drives, strict=True))
        unlike = list(dict.fromkeys(kinds))
        radius, width, front, drive = (np.array(column)[:, None] for column in zip(*unlike, strict=True))
        count = np.array([[float(kinds.count(kind))] for kind in unlike])
        share = 1.0 / np.where(front, rig.front.sum(), (~rig.front).sum())
        cases = ((0.0, 0.0), (0.0, math.pi / 2.0), (1.0, 0.0))
        level, tilt, drawn = (
            share * np.where(front, *axle_loads(rig.chassis, draft, slope, 0.0)) for draft, slope in cases
        )
        of_wheel = np.array([unlike.index(kind) for kind in kinds])
        return cls(rig.chassis, radius, width, front, drive, count, level, tilt, drawn - level, of_wheel)

    def wheel(self, load: Array) -> Wheel:
        """One wheel of each kind under a load [N] (..., A)."""
        return Wheel(self.radius[:, 0], self.width[:, 0], ~self.front[:, 0], load)

    @property
    def weight(self) -> float:
        """Of the vehicle [N]."""
        return self.chassis.mass * GRAVITY

    def loads(self, draft: Any, sine: Any) -> Array:
        """Load on each wheel [N] (..., A, S) for a draft [N] and a slope's sine, each (..., S)."""
        draft = np.atleast_1d(draft)[..., None, :]
        sine = np.atleast_1d(np.minimum(np.maximum(sine, -0.99), 0.99))[..., None, :]
        return np.asarray(self.level * np.sqrt(1.0 - sine * sine) + self.tilt * sine + self.lever * draft)


@dataclass(frozen=True, slots=True)
class WheelTable:
    """D soils (D, 6), A kinds of wheels, S slips: wheels at the loads of the steady level pull.

    pull [N] (D, S) is the whole vehicle's; load [N] (D, A, S); at (3, D, A, S) are drawbar pull [N],
    torque [N m] and entry angle [rad] of one wheel, by_load and by_slip their derivatives
    by its load at constant slip and by slip at constant load; bend (3, 1, A, S) is half the second
    derivative by load, that of the first soil for all.  balanced (D, S) tells where a
    steady state was found; elsewhere pull is nan.
    """

    axles: Axles
    soils: Array
    slip: Array
    pull: Array
    load: Array
    at: Array
    by_load: Array
    by_slip: Array
    bend: Array
    balanced: NDArray[np.bool_]

    def pull_at(self, load: Array) -> Array:
        """Pull of the vehicle [N] (..., D, S) with its wheels at other loads (..., D, A, S)."""
        change = load - self.load
        drawbar = self.at[0] + change * (self.by_load[0] + self.bend[0] * change)
        return np.asarray((self.axles.count * drawbar).sum(axis=-2))

    def change_at(self, load: Array) -> list[Array]:
        """Changes of drawbar pull, torque and entry angle (..., D, A, S) at other loads (..., D, A, S)."""
        change = load - self.load
        return [change * (slope + bend * change) for slope, bend in zip(self.by_load, self.bend, strict=True)]


def wheel_table(
    soils: Array,
    rig: Rig,
    model: WheelModel | CompletedModel | UncertainModel,
    slip: Array,
    start: WheelTable | None = None,
    tolerance: float = TOLERANCE,
    driven: NDArray[np.bool_] | None = None,
) -> WheelTable:
    """Wheels on soils (D, 6) at slips (S,) of the driven ones (W,), all by default.

    `start` is the same rig's table of similar soils.

    The last of the soils are those of the model's doubts, where it has any.  tolerance: the Newton
    step of pull and load, over the weight, that is the last.

    Raises ValueError for a rig without a chassis.
    """
    n_soils, n_slips = len(soils), len(slip)
    completed = UncertainModel.over(model).of_rows(n_soils)
    axles = Axles.of(rig, driven)
    if start is not None and not (
        start.pull.shape == (n_soils, n_slips)
        and np.array_equal(start.slip, slip)
        and np.array_equal(start.axles.driven, axles.driven)
    ):
        start = None
    slips = np.where(axles.driven, np.broadcast_to(slip, (n_soils, len(axles.count), n_slips)), ROLLING_SLIP)
    if start is not None:
        pull, angle = _foreseen(start, soils)
        pull = np.where(start.balanced, pull, 0.0)
        angle = np.where(start.balanced[:, None], angle, np.nan).clip(max=MAX_ENTRY_ANGLE)
    else:
        pull, angle = np.zeros((n_soils, n_slips)), np.full((n_soils, len(axles.count), n_slips), np.nan)
    load = np.broadcast_to(axles.loads(pull, 0.0), angle.shape).copy()
    unknown = np.isnan(angle).any(axis=(1, 2))
    if unknown.any():
        guess = _state(soils[unknown], axles, slips[unknown], angle[unknown])
        angle[unknown] = entry_angle_for_load(load[unknown], guess, completed.first.model, tolerance=1e-2)
    last_step = tolerance * axles.weight
    with np.errstate(all="ignore"):
        now = _newton_step(soils, axles, completed, slips, pull, load, angle)
        for _ in range(MAX_ITERATIONS - 1):
            rows = np.flatnonzero((now.miss > last_step).any(axis=1))
            if not len(rows):
                break
            angle[rows] = np.clip(now.at[2, rows], 0.5 * angle[rows], 2.0 * angle[rows]).clip(max=MAX_ENTRY_ANGLE)
            of_rows = (
                soils[rows],
                axles,
                completed.of(rows),
                now.slip[rows],
                now.pull[rows],
                now.load[rows],
                angle[rows],
            )
            for whole, part in zip(now, _newton_step(*of_rows), strict=True):
                whole[(slice(None),) * (part.ndim == 4) + (rows,)] = part
    pull, load, at, by_load, by_slip, slips, miss = now
    balanced = np.isfinite(at[2]).all(axis=1) & (load > 0.0).all(axis=1) & (miss <= last_step)
    bend = _bend(soils[:1], axles, completed.first, slips[:1], load[:1], at[:, :1], by_load[:, :1])
    return WheelTable(axles, soils, slip, np.where(balanced, pull, np.nan), load, at, by_load, by_slip, bend, balanced)


def _foreseen(start: WheelTable, soils: Array) -> tuple[Array, Array]:
    """Pull (D, S) and entry angle (D, A, S) on other soils, as those of a table change from its first to the rest."""
    n_soils, n_slips = start.pull.shape
    logs, other = (np.log(np.maximum(each, LEAST)) for each in (start.soils, soils))
    with np.errstate(all="ignore"):
        values = np.concatenate([start.pull, np.log(start.at[2]).reshape(n_soils, -1)], axis=1)
    apart, change = logs - logs[0], values - values[0]
    spread = apart.T @ apart
    ridge = RIDGE * np.trace(spread) + LEAST
    slopes = np.linalg.solve(spread + ridge * np.eye(len(spread)), apart.T @ np.where(np.isfinite(change), change, 0.0))
    values = values + (other - logs) @ slopes
    return values[:, :n_slips], np.exp(values[:, n_slips:]).reshape(start.load.shape)


class _Step(NamedTuple):
    """As in WheelTable after a step, with the slips (D, A, S), and how far it went [N] (D, S)."""

    pull: Array
    load: Array
    at: Array
    by_load: Array
    by_slip: Array
    slip: Array
    miss: Array


def _newton_step(
    soils: Array, axles: Axles, model: ModelOfRows, slip: Array, pull: Array, load: Array, angle: Array
) -> _Step:
    """One step towards wheels that carry their loads and a level pull that balances itself.

    A wheel that is not driven takes no torque: T = 0 is solved for its slip, which so follows its load.
    """
    forces, d = model.forces_and_slopes(_state(soils, axles, slip, angle), ~axles.front, load)
    by_carried = np.stack([d.by_angle[1], d.by_angle[2], np.ones_like(d.by_angle[0])]) / d.by_angle[0]
    by_load = by_carried * (1.0 - d.by_load[0])
    by_load[:2] += d.by_load[1:]
    by_slip = -by_carried * d.by_slip[0]
    by_slip[:2] += d.by_slip[1:]
    off = load - forces[0]
    by_torque = np.where(axles.driven, 0.0, -by_slip / by_slip[1])  # of the slip that takes a torque away
    rolled = forces[2] + by_carried[1] * off
    rolled_by_load = by_load[1].copy()
    by_load += by_torque * rolled_by_load
    gain = (axles.count * axles.lever * by_load[0]).sum(axis=1) - 1.0
    change = -((axles.count * (forces[1] + by_carried[0] * off + by_torque[0] * rolled)).sum(axis=1) - pull) / gain
    shift = axles.lever * change[:, None]
    step = off + shift
    slower = np.where(axles.driven, 0.0, (rolled + rolled_by_load * shift) / by_slip[1])
    at = by_carried * off + by_load * shift + by_torque * rolled
    at[:2] += forces[1:]
    at[2] += angle
    miss = np.maximum(np.abs(change), np.abs(step).max(axis=1))
    slip = np.clip(slip - slower, -MAX_ROLLING_SLIP, None)
    return _Step(pull + change, load + shift, at, by_load, by_slip * axles.driven, slip, miss)


def _bend(
    soil: Array, axles: Axles, model: CompletedModel, slip: Array, load: Array, at: Array, by_load: Array
) -> Array:
    """Half the second derivative by load, from the wheels under TEST_LOAD times their load."""
    change = (TEST_LOAD - 1.0) * load
    linear = at + change * by_load
    with np.errstate(all="ignore"):
        forces = model.forces(
            _state(soil, axles, slip, np.clip(linear[2], 0.0, MAX_ENTRY_ANGLE)), ~axles.front, load + change
        )
        exact = np.stack([forces[1], forces[2], linear[2]]) + by_load * (load + change - forces[0])
        return np.asarray((exact - linear) / change**2 * axles.driven)


def _state(soils: Array, axles: Axles, slip: Array, angle: Array) -> WheelState:
    """Every soil under every kind of wheel at its slips (D, A, S), each field of the whole shape."""
    k_c, k_phi, n, phi, c, K = soils.T[:, :, None, None]
    modulus = lumped_modulus(k_c, k_phi, axles.width)
    state = WheelState(angle, slip, axles.radius, axles.width, modulus, n, np.tan(phi), c, K)
    fields = np.empty((len(state), *angle.shape))
    for field, values in zip(fields, state, strict=True):
        field[...] = values
    return WheelState(*fields)
