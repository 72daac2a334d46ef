"""The wheels over slip on many soils at once, on the level: forces and their derivatives by load and slip.

    vertical force    F_z(theta, s, N) = N            solved for the entry angle theta of each wheel
    load transfer     N = level + lever * P           solved together with
    pull balance      P = sum of the drawbar pulls    by Newton's method, for all soils and slips at once

All driven wheels have the same slip s.  The others roll at the slip at which their torque is zero, which is solved for
in the same step.  The result is the table from which `balance` interpolates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.decision.uncertain_model import UncertainModel
from soilbus.estimation.instrumentation import Group
from soilbus.estimation.window import Rig
from soilbus.terra.effects.steady import CompletedModel, Wheel
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soil_laws import lumped_modulus
from soilbus.terra.vehicle import GRAVITY, Chassis, wheel_loads
from soilbus.terra.wheel import MAX_ENTRY_ANGLE, WheelModel, WheelState

NEWTON_TOLERANCE = 1e-2
"""Step of pull and load, as a share of the weight, below which Newton's method stops.  On 120 s of loam the largest
draft differs from that by a third of it by 1.2e-4 at most, its std by 0.8 %, in a third of the steps less."""
RELATIVE_REGULARISATION = 1e-6
"""Ridge term of the regression on the soils' logarithms, as a share of their total sum of squares."""
LEAST_POSITIVE = 1e-12
"""Lower bound of a soil parameter before its logarithm is taken, and of the ridge term."""
MAX_NEWTON_STEPS = 12
DRAWBAR, TORQUE, ANGLE = range(3)
"""Places of drawbar pull [N], torque [N m] and entry angle [rad] of a wheel in a table's `at`, `by_load`, `by_slip`."""
MAX_SINE = 0.99
"""Sine of the steepest slope that is computed."""
LOAD_RATIO = 0.9
"""Load, as a share of a wheel's own, of the second evaluation from which the second derivative by load follows."""


@dataclass(frozen=True, slots=True)
class Axles:
    """The A kinds of wheels: those alike in axle, radius, width, contact length and whether they are driven.

    radius, width (A, 1) [m].  front, driven, count (A, 1): whether on the front axle, whether driven, and how many.
    level, tilt [N], lever [1] (A, 1): load of a wheel = level * cosine + tilt * sine of the slope + lever * draft.
    of_wheel (W,): kind of each wheel.  shared_motors: of several wheels.  length (A, 1) [m]: of tracks; the number 0
    where all are wheels.
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
    shared_motors: tuple[Group, ...] = ()
    length: Array | float = 0.0

    @classmethod
    def of(cls, rig: Rig, drives: NDArray[np.bool_]) -> Axles:
        """Return the kinds of a rig's wheels, of which some drive (W,); ValueError for a rig without a chassis."""
        if rig.chassis is None:
            raise ValueError("a capability needs the vehicle's mass and geometry")
        lengths = np.zeros(len(drives)) if rig.lengths is None else rig.lengths
        columns = (rig.radius, rig.width, rig.ahead, lengths)
        kinds = list(zip(*(column.tolist() for column in (*columns, drives)), strict=True))
        unlike = list(dict.fromkeys(kinds))
        radius, width, ahead, long, drive = (np.array(column)[:, None] for column in zip(*unlike, strict=True))
        count = np.array([[float(kinds.count(kind))] for kind in unlike])
        of_kind = [kinds.index(kind) for kind in unlike]
        cases = ((0.0, 0.0), (0.0, math.pi / 2.0), (1.0, 0.0))
        level, tilt, drawn = (
            wheel_loads(rig.chassis, rig.ahead, draft, slope, 0.0)[of_kind, None] for draft, slope in cases
        )
        of_wheel = np.array([unlike.index(kind) for kind in kinds])
        shared = () if rig.instrumentation is None else rig.instrumentation.motors
        length = 0.0 if rig.lengths is None else long
        lever = drawn - level
        return cls(rig.chassis, radius, width, ahead == 1.0, drive, count, level, tilt, lever, of_wheel, shared, length)

    def wheel(self, load: Array) -> Wheel:
        """Return one wheel of each kind under a load [N] (..., A)."""
        return Wheel(self.radius[:, 0], self.width[:, 0], ~self.front[:, 0], load)

    @property
    def weight(self) -> float:
        """Weight of the vehicle [N]."""
        return self.chassis.mass * GRAVITY

    def loads(self, draft: Any, sine: Any) -> Array:
        """Return the load on each wheel [N] (..., A, S) for a draft [N] and a slope's sine, each (..., S)."""
        draft = np.atleast_1d(draft)[..., None, :]
        sine = np.atleast_1d(np.minimum(np.maximum(sine, -MAX_SINE), MAX_SINE))[..., None, :]
        return np.asarray(self.level * np.sqrt(1.0 - sine * sine) + self.tilt * sine + self.lever * draft)


@dataclass(frozen=True, slots=True)
class WheelTable:
    """Steady states on the level of D soils, A kinds of wheels, S slips.

    soils (D, 6).  slip (S,): of the driven wheels.  pull (D, S) [N]: of the vehicle, nan where not balanced.  load (D,
    A, S) [N]: of one wheel.  at, by_load, by_slip (3, D, A, S): drawbar pull [N], torque [N m] and entry angle [rad] of
    one wheel, and their derivatives by its load at constant slip and by slip at constant load.  half_second_derivative
    (3, 1, A, S): half of that of `at` by load, of the first soil and used for all.  balanced (D, S): whether a steady
    state was found.
    """

    axles: Axles
    soils: Array
    slip: Array
    pull: Array
    load: Array
    at: Array
    by_load: Array
    by_slip: Array
    half_second_derivative: Array
    balanced: NDArray[np.bool_]

    def change_at(self, load: Array) -> Array:
        """Return the changes of drawbar pulls, torques and entry angles (3, D, A, S) at other loads (D, A, S)."""
        change = load - self.load
        return np.asarray(change * (self.by_load + self.half_second_derivative * change))


def wheel_table(
    soils: Array,
    rig: Rig,
    model: WheelModel | CompletedModel | UncertainModel,
    slip: Array,
    start: WheelTable | None = None,
    tolerance: float = NEWTON_TOLERANCE,
    driven: NDArray[np.bool_] | None = None,
) -> WheelTable:
    """Return the steady level driving on D soils at S slips.

    soils (D, 6): the last belong to the perturbed models of an uncertain model, which have the mean's derivatives.
    slip (S,): of the driven wheels.  rig: with a chassis, else ValueError.  start: table of the same rig on similar
    soils.  tolerance: step of pull and load, as a share of the weight, below which Newton's method stops.  driven (W,):
    which wheels are driven; None for all.
    """
    n_soils, n_slips = len(soils), len(slip)
    uncertain = UncertainModel.over(model)
    drives = np.ones(len(rig.wheels), bool) if driven is None else driven
    if start is not None and not (
        start.pull.shape == (n_soils, n_slips)
        and np.array_equal(start.slip, slip)
        and np.array_equal(start.axles.driven[start.axles.of_wheel, 0], drives)
    ):
        start = None
    axles = start.axles if start is not None and start.axles.chassis == rig.chassis else Axles.of(rig, drives)
    options = rig.options.measurements
    # a track without thrust does not slip
    rolling = np.where(np.asarray(axles.length) > 0.0, 0.0, options.rolling_slip)
    slips = np.where(axles.driven, np.broadcast_to(slip, (n_soils, len(axles.count), n_slips)), rolling)
    if start is not None:
        pull, angle = _extrapolated(start, soils)
        pull = np.where(start.balanced, pull, 0.0)
        angle = np.where(start.balanced[:, None], angle, np.nan).clip(max=MAX_ENTRY_ANGLE)
    else:
        pull, angle = np.zeros((n_soils, n_slips)), np.full((n_soils, len(axles.count), n_slips), np.nan)
    load = np.broadcast_to(axles.loads(pull, 0.0), angle.shape).copy()
    unknown = np.isnan(angle).any(axis=(1, 2))
    if unknown.any():
        guess = _state(soils[unknown], axles, slips[unknown], angle[unknown])
        angle[unknown] = entry_angle_for_load(load[unknown], guess, uncertain.mean.model, tolerance=1e-2)
    last_step = tolerance * axles.weight
    with np.errstate(all="ignore"):
        of_row = np.arange(n_soils) - (n_soils - len(uncertain.perturbed))
        now = _newton_step(soils, axles, uncertain, of_row, slips, pull, load, angle, options.max_rolling_skid)
        for _ in range(MAX_NEWTON_STEPS - 1):
            rows = np.flatnonzero((now.step_size > last_step).any(axis=1))
            if not len(rows):
                break
            angle[rows] = np.clip(now.at[ANGLE, rows], 0.5 * angle[rows], 2.0 * angle[rows]).clip(max=MAX_ENTRY_ANGLE)
            at_rows = of_row[rows], now.slip[rows], now.pull[rows], now.load[rows], angle[rows]
            step = _newton_step(soils[rows], axles, uncertain, *at_rows, options.max_rolling_skid)
            for whole, part in zip(now, step, strict=True):
                whole[(slice(None),) * (part.ndim == 4) + (rows,)] = part
    pull, load, at, by_load, by_slip, slips, step_size = now
    balanced = np.isfinite(at[ANGLE]).all(axis=1) & (load > 0.0).all(axis=1) & (step_size <= last_step)
    half_second = _half_second_derivative(
        soils[:1], axles, uncertain.mean, slips[:1], load[:1], at[:, :1], by_load[:, :1]
    )
    pull = np.where(balanced, pull, np.nan)
    return WheelTable(axles, soils, slip, pull, load, at, by_load, by_slip, half_second, balanced)


def _extrapolated(start: WheelTable, soils: Array) -> tuple[Array, Array]:
    """Pull (D, S) and entry angle (D, A, S) on other soils, by ridge regression on the soils' logarithms."""
    n_soils, n_slips = start.pull.shape
    logs, other = np.log(np.maximum(start.soils, LEAST_POSITIVE)), np.log(np.maximum(soils, LEAST_POSITIVE))
    with np.errstate(all="ignore"):
        values = np.concatenate([start.pull, np.log(start.at[ANGLE]).reshape(n_soils, -1)], axis=1)
    apart, change = logs - logs[0], values - values[0]
    spread = apart.T @ apart
    ridge = RELATIVE_REGULARISATION * np.trace(spread) + LEAST_POSITIVE
    slopes = np.linalg.solve(spread + ridge * np.eye(len(spread)), apart.T @ np.where(np.isfinite(change), change, 0.0))
    values = values + (other - logs) @ slopes
    return values[:, :n_slips], np.exp(values[:, n_slips:]).reshape(start.load.shape)


class _Step(NamedTuple):
    """Result of a Newton step: as in WheelTable, with the slips (D, A, S) and the size of the step [N] (D, S)."""

    pull: Array
    load: Array
    at: Array
    by_load: Array
    by_slip: Array
    slip: Array
    step_size: Array


def _newton_step(
    soils: Array, axles: Axles, model: UncertainModel, of_row: NDArray[np.intp], slip: Array, pull: Array, load: Array,
    angle: Array, max_skid: float,
) -> _Step:  # fmt: skip
    """One Newton step of entry angles, loads and pull; a wheel that is not driven skids to torque 0, within a limit."""
    forces, d = model.forces_and_slopes(_state(soils, axles, slip, angle), ~axles.front, load, of_row)
    by_carried = np.stack([d.by_angle[1], d.by_angle[2], np.ones_like(d.by_angle[0])]) / d.by_angle[0]
    by_load = by_carried * (1.0 - d.by_load[0])
    by_load[:2] += d.by_load[1:]
    by_slip = -by_carried * d.by_slip[0]
    by_slip[:2] += d.by_slip[1:]
    carried, drawbar, torque = forces
    off = load - carried
    by_torque = np.where(axles.driven, 0.0, -by_slip / by_slip[TORQUE])  # of the slip change that makes the torque zero
    rolled = torque + by_carried[TORQUE] * off
    rolled_by_load = by_load[TORQUE].copy()
    by_load += by_torque * rolled_by_load
    gain = (axles.count * axles.lever * by_load[DRAWBAR]).sum(axis=1) - 1.0
    next_drawbar = drawbar + by_carried[DRAWBAR] * off + by_torque[DRAWBAR] * rolled
    change = -((axles.count * next_drawbar).sum(axis=1) - pull) / gain
    shift = axles.lever * change[:, None]
    step = off + shift
    slower = np.where(axles.driven, 0.0, (rolled + rolled_by_load * shift) / by_slip[TORQUE])
    at = by_carried * off + by_load * shift + by_torque * rolled
    at[:2] += forces[1:]
    at[ANGLE] += angle
    step_size = np.maximum(np.abs(change), np.abs(step).max(axis=1))
    slip = np.clip(slip - slower, -max_skid, None)
    return _Step(pull + change, load + shift, at, by_load, by_slip * axles.driven, slip, step_size)


def _half_second_derivative(
    soil: Array, axles: Axles, model: CompletedModel, slip: Array, load: Array, at: Array, by_load: Array
) -> Array:
    """Half the second derivative by load, from a second evaluation at LOAD_RATIO times the load."""
    change = (LOAD_RATIO - 1.0) * load
    linear = at + change * by_load
    with np.errstate(all="ignore"):
        forces = model.forces(
            _state(soil, axles, slip, np.clip(linear[ANGLE], 0.0, MAX_ENTRY_ANGLE)), ~axles.front, load + change
        )
        exact = np.stack([forces[1], forces[2], linear[ANGLE]]) + by_load * (load + change - forces[0])
        return np.asarray((exact - linear) / change**2 * axles.driven)


def _state(soils: Array, axles: Axles, slip: Array, angle: Array) -> WheelState:
    """State of every kind of wheel on every soil at every slip; each field has the shape (D, A, S)."""
    k_c, k_phi, n, phi, c, K = soils.T[:, :, None, None]
    modulus = lumped_modulus(k_c, k_phi, axles.width)
    state: list[Any] = [angle, slip, axles.radius, axles.width, modulus, n, np.tan(phi), c, K]
    if isinstance(axles.length, np.ndarray):
        state.append(axles.length)
    fields = np.empty((len(state), *angle.shape))
    for field, values in zip(fields, state, strict=True):
        field[...] = values
    return WheelState(*fields)
