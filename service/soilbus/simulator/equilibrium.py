"""Equilibrium of the simulated vehicle: slip, draft and entry angles at which loads and pulls balance.

    for each wheel   W(theta_i, s + deviation_i) = level load_i + load per draft_i D
    once             sum of DP(theta_i, s + deviation_i) = D + resistance
    the driver       s = min(s where D meets the demand, slip limit, s where a motor is at its torque limit)

Unknown at each instant are the common slip s, the draft D and an entry angle theta_i for each wheel. Newton's method
solves the three conditions of the driver at once: draft and torque grow with slip, so the smallest of the three steps
leads to the condition that holds. The slip limit may be passed as long as the draft would be below its least value.
Effects take part by finite differences, starting from the equilibrium without effects.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.terra.effects.effect import Active, Surroundings, forces_with, wheel_with
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.wheel import (
    MAX_ENTRY_ANGLE,
    MIN_ENTRY_ANGLE,
    Soil,
    WheelModel,
    WheelState,
    sinkage,
    state_on,
    wheel_forces_and_derivatives,
)

MAX_SLIP = 0.95
"""Beyond this common slip the tractor counts as bogged down."""
_MIN_SLIP = -0.5
"""Least common slip: a wheel that is braked."""
_RESIDUAL_TOLERANCE = 1e-10
"""Residual over the vehicle's weight, plus step of slip, that ends the iteration."""
_MAX_NEWTON_STEPS = 60
_RELATIVE_DIFFERENCE = 1e-6
"""Step of the finite differences; Newton's steps need not be exact."""
_COARSE_STRIDE = 10
"""Every tenth instant is solved first; its neighbours then start next to their solution."""


class Situation(NamedTuple):
    """What is given at N instants for M wheels; all arrays end in N.

    Attributes
    ----------
    t, distance, ground_speed, acceleration
        Motion (N,) [s], [m], [m/s], [m/s^2].
    resistance
        Pull that slope and inertia take [N] (N,).
    level_load, load_per_draft
        Wheel loads without draft [N] (M, N), and their change with draft (M, N).
    deviation
        Each wheel's slip beyond the common one (M, N).
    radius, width, length
        Of the wheels [m] (M, N); length that of a track's contact, 0 of a wheel.
    soil
        Parameters (6, M, N) in the order of wheel.Soil.
    demand
        Draft asked for [N] (N,); inf for as much as possible.
    slip_limit
        (N,).
    torque_limit
        [N m] (M, N).
    least_draft
        Draft [N] (N,) below which the slip limit is passed.
    """

    t: Array
    distance: Array
    ground_speed: Array
    acceleration: Array
    resistance: Array
    level_load: Array
    load_per_draft: Array
    deviation: Array
    radius: Array
    width: Array
    length: Array
    soil: Array
    demand: Array
    slip_limit: Array
    torque_limit: Array
    least_draft: Array


class Mechanics(NamedTuple):
    """The wheel-soil model, effects on it, and what they may depend on (see Surroundings).

    Attributes
    ----------
    rear
        Which wheels run in the rut of another (M,).
    mass, duration, length
        Of the vehicle [kg], of the drive [s] and [m].
    """

    model: WheelModel
    rear: NDArray[np.bool_]
    mass: float
    duration: float
    length: float
    effects: Sequence[Active] = ()

    @property
    def plain(self) -> bool:
        """Whether no effect changes the forces at the wheels."""
        return all(effect.wheel is None and effect.forces is None for effect, _ in self.effects)


class _Slopes(NamedTuple):
    """Forces (3, M, N) and their derivatives by entry angle, common slip and draft."""

    forces: Array
    by_angle: Array
    by_slip: Array
    by_draft: Any


_Forces = Callable[[Situation, Array, Array, Array], _Slopes]


class Equilibrium(NamedTuple):
    """Solution at N instants.

    Attributes
    ----------
    slip, draft
        Common slip and draft [N] (N,).
    entry_angle
        [rad] (M, N).
    forces
        (3, M, N) by wheel.FORCES.
    found
        Whether an equilibrium was found (N,).
    """

    slip: Array
    draft: Array
    entry_angle: Array
    forces: Array
    found: NDArray[np.bool_]


def solve(situation: Situation, mechanics: Mechanics) -> Equilibrium:
    """The equilibrium at each instant.

    Parameters
    ----------
    situation
        N instants of M wheels.
    mechanics
        Model and effects.

    Returns
    -------
    Residuals are below 1e-10 of the vehicle's weight where `found`.

    Notes
    -----
    Every tenth instant is solved first; the others start from values interpolated between them.
    """
    n_instants = len(situation.demand)
    coarse = np.unique(np.append(np.arange(0, n_instants, _COARSE_STRIDE), n_instants - 1))
    knots = _from_scratch(_at(situation, coarse), mechanics)
    good = coarse[knots.found]
    if not len(good):
        return _from_scratch(situation, mechanics)

    def between(values: Array) -> Array:
        return np.interp(np.arange(n_instants), good, values[knots.found])

    angles = np.stack([between(row) for row in knots.entry_angle])
    result = _newton(situation, (between(knots.slip), between(knots.draft), angles), _forces_of(mechanics))
    lost = np.flatnonzero(~result.found)
    if len(lost):
        again = _from_scratch(_at(situation, lost), mechanics)
        for whole, part in zip(result, again, strict=True):
            whole[..., lost] = part
    return result


def surroundings(situation: Situation, mechanics: Mechanics, slip: Array, draft: Array) -> Surroundings:
    """What effects may depend on.

    Parameters
    ----------
    slip
        Common slip (N,).
    draft
        [N] (N,).

    Returns
    -------
    Arrays with instants first, (N, M) or (N, 1).
    """
    column = slip + situation.deviation
    return Surroundings(
        t=situation.t[:, None],
        distance=situation.distance[:, None],
        load=(situation.level_load + situation.load_per_draft * draft).T,
        ground_speed=situation.ground_speed[:, None],
        wheel_speed=(situation.ground_speed / (situation.radius * (1.0 - column))).T,
        rear=mechanics.rear,
        draft=draft[:, None],
        acceleration=situation.acceleration[:, None],
        mass=mechanics.mass,
        duration=mechanics.duration,
        length=mechanics.length,
    )


def sinkages(situation: Situation, mechanics: Mechanics, at: Equilibrium) -> Array:
    """Sinkages [m] (M, N), for the wheel radii that effects leave."""
    state, around = (
        _transposed(situation, at.slip, at.entry_angle),
        surroundings(situation, mechanics, at.slip, at.draft),
    )
    changed, _ = wheel_with(mechanics.effects, state, mechanics.model, around)
    return np.asarray(sinkage(at.entry_angle, np.transpose(changed.radius)))


def _transposed(situation: Situation, slip: Array, entry_angle: Array) -> WheelState:
    """States (N, M), as effects want them."""
    return WheelState(*(np.transpose(a) for a in wheel_state(situation, slip, entry_angle)))


def wheel_state(situation: Situation, slip: Array, entry_angle: Array) -> WheelState:
    """States of all wheels (M, N) at a common slip (N,) and entry angles [rad] (M, N)."""
    soil = Soil(*situation.soil)
    slips = slip + situation.deviation
    return state_on(soil, entry_angle, slips, situation.radius, situation.width, situation.length)


def _at(situation: Situation, index: NDArray[np.intp]) -> Situation:
    return Situation(*(a[..., index] for a in situation))


def _from_scratch(situation: Situation, mechanics: Mechanics) -> Equilibrium:
    """The equilibrium from little slip and draft and entry angles that carry the level loads, effects added last.

    With tracks from no slip at all: their thrust saturates within s = K/L, and Newton's method nears a point of a
    concave curve from below without overshooting it.
    """
    slip = np.minimum(0.0 if situation.length.any() else 0.1, situation.slip_limit)
    load, model = situation.level_load, mechanics.model
    unknown = wheel_state(situation, slip, np.full_like(load, np.nan))
    angle = entry_angle_for_load(load.ravel(), WheelState(*(np.ravel(a) for a in unknown)), model, tolerance=1e-3)
    angle = np.where(np.isfinite(angle), angle, 1.0).reshape(load.shape)
    plain = _newton(situation, (slip, np.zeros_like(slip), angle), _exact(model))
    if mechanics.plain:
        return plain
    return _newton(situation, (plain.slip, plain.draft, plain.entry_angle), _by_differences(mechanics))


def _forces_of(mechanics: Mechanics) -> _Forces:
    return _exact(mechanics.model) if mechanics.plain else _by_differences(mechanics)


def _exact(model: WheelModel) -> _Forces:
    """Forces of the model without effects."""

    def slopes(situation: Situation, slip: Array, draft: Array, angle: Array) -> _Slopes:
        flat, jacobian = wheel_forces_and_derivatives(wheel_state(situation, slip, angle), model)
        forces = flat.reshape(3, *angle.shape)
        by_angle, by_slip = (jacobian[:, i].reshape(3, *angle.shape) for i in (0, 1))
        return _Slopes(forces, by_angle, by_slip, np.zeros((3, 1, 1)))

    return slopes


def _by_differences(mechanics: Mechanics) -> _Forces:
    """Forces of the model with its effects."""

    def forces(situation: Situation, slip: Array, draft: Array, angle: Array) -> Array:
        state = _transposed(situation, slip, angle)
        around = surroundings(situation, mechanics, slip, draft)
        return np.swapaxes(forces_with(mechanics.effects, state, mechanics.model, around), 1, 2)

    def slopes(situation: Situation, slip: Array, draft: Array, angle: Array) -> _Slopes:
        here = forces(situation, slip, draft, angle)
        turn, pull = _RELATIVE_DIFFERENCE * angle, _RELATIVE_DIFFERENCE * situation.level_load.sum(axis=0)
        return _Slopes(
            here,
            (forces(situation, slip, draft, angle + turn) - here) / turn,
            (forces(situation, slip + _RELATIVE_DIFFERENCE, draft, angle) - here) / _RELATIVE_DIFFERENCE,
            (forces(situation, slip, draft + pull, angle) - here) / pull,
        )

    return slopes


def _newton(situation: Situation, guess: tuple[Array, Array, Array], slopes: _Forces) -> Equilibrium:
    slip, draft, angle = (np.array(a, float) for a in guess)
    forces = np.empty((3, *angle.shape))
    found = np.zeros(len(slip), bool)
    todo = np.arange(len(slip))
    for _ in range(_MAX_NEWTON_STEPS):
        part = _at(situation, todo)
        at = slopes(part, slip[todo], draft[todo], angle[..., todo])
        step, miss = _step(part, slip[todo], draft[todo], at)
        forces[..., todo] = at.forces
        at_rest = miss + np.abs(step[0]) < _RESIDUAL_TOLERANCE
        found[todo] = at_rest
        todo, d_slip, d_draft, d_angle = todo[~at_rest], *(a[..., ~at_rest] for a in step)
        if not len(todo):
            break
        slip[todo] = np.clip(slip[todo] + d_slip, _MIN_SLIP, MAX_SLIP)
        draft[todo] += d_draft
        old = angle[..., todo]
        near = np.clip(old + d_angle, old / 2.0, old * 2.0)
        angle[..., todo] = np.clip(near, MIN_ENTRY_ANGLE, MAX_ENTRY_ANGLE)
    pulls = draft > situation.least_draft - 1e-6 * situation.level_load.sum(axis=0)
    return Equilibrium(slip, draft, angle, forces, found & pulls)


def _step(situation: Situation, slip: Array, draft: Array, at: _Slopes) -> tuple[tuple[Array, Array, Array], Array]:
    """Newton steps of slip, draft and angles, relative residual (N,)."""
    forces = at.forces
    (W_a, DP_a, T_a), (W_s, DP_s, T_s), (W_d, DP_d, T_d) = at.by_angle, at.by_slip, at.by_draft
    load_miss = situation.level_load + situation.load_per_draft * draft - forces[0]
    lever = situation.load_per_draft - W_d
    pull_miss = forces[1].sum(axis=0) - draft - situation.resistance
    weight = situation.level_load.sum(axis=0)
    residual = (np.abs(load_miss).max(axis=0) + np.abs(pull_miss)) / weight

    # Each angle follows from its load: d_angle = (load_miss + lever d_draft - W_s d_slip) / W_a.
    def along_load(by_angle: Array, by_slip: Array, by_draft: Array, value: Any) -> tuple[Any, Any, Any]:
        """Constant, change with slip and change with draft of a force, angles eliminated."""
        share = by_angle / W_a
        return value + share * load_miss, by_slip - share * W_s, by_draft + share * lever

    constant, by_slip, by_draft = along_load(DP_a, DP_s, DP_d, forces[1])
    A = constant.sum(axis=0) - draft - situation.resistance
    B = np.maximum(by_slip.sum(axis=0), 1e-6 * weight)  # past the greatest pull: on to the limits
    C = by_draft.sum(axis=0) - 1.0
    T_0, T_slip, T_draft = along_load(T_a, T_s, T_d, forces[2] - situation.torque_limit)
    to_torque = np.min(-(T_0 - T_draft * A / C) / np.maximum(T_slip - T_draft * B / C, 1e-9), axis=0)
    to_demand = -(A + C * (situation.demand - draft)) / B
    to_least = -(A + C * (situation.least_draft - draft)) / B
    to_limit = np.maximum(situation.slip_limit - slip, to_least)
    d_slip = np.minimum.reduce([to_demand, to_limit, to_torque, MAX_SLIP - slip])
    d_slip = np.clip(d_slip, -0.15, 0.15)
    d_draft = -(A + B * d_slip) / C
    return (d_slip, d_draft, (load_miss + lever * d_draft - W_s * d_slip) / W_a), residual
