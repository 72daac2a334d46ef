"""Slip, draft and entry angles at which the wheels carry and pull what they must.

At each instant the unknowns are the common slip s, the draft D and an entry angle for each
wheel.  Wheel loads and the draft balance tie them together; a driver's rule closes the
system: s is the smallest of the slips at which the demanded draft is met, the slip limit
is reached (which may be passed as long as no draft at all is held), and a motor is at its
torque limit.  Draft and torque grow with slip, so the smallest Newton step towards any of
these is the step towards the one that holds.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.terra.stress import Array
from soilbus.terra.wheel import (
    MAX_ENTRY_ANGLE,
    MIN_ENTRY_ANGLE,
    Soil,
    WheelModel,
    WheelState,
    entry_angle_for_load,
    state_on,
    wheel_forces_and_derivatives,
)

MAX_SLIP = 0.95
"""Beyond this common slip the tractor counts as bogged down."""
_MIN_SLIP = -0.5
_TOLERANCE = 1e-10
_MAX_STEPS = 60
_STRIDE = 10  # every tenth instant first: its neighbours then start next to their solution


class Situation(NamedTuple):
    """What is given at N instants for M wheels; all arrays end in N.

    `resistance` [N] (N,) is the pull that slope and inertia take, `level_load` [N] (M, N)
    the wheel loads without draft, `load_per_draft` (M, N) their change with it,
    `deviation` (M, N) each wheel's slip beyond the common one, `soil` (6, M, N) in the
    order of wheel.Soil, `demand` [N] (N,) the draft asked for (inf: as much as goes),
    `slip_limit` (N,), `torque_limit` [N m] (M, N), `least_draft` [N] (N,): below it the slip
    limit gives way.
    """

    resistance: Array
    level_load: Array
    load_per_draft: Array
    deviation: Array
    radius: Array
    width: Array
    soil: Array
    demand: Array
    slip_limit: Array
    torque_limit: Array
    least_draft: Array


class Equilibrium(NamedTuple):
    """Common slip (N,), draft [N] (N,), entry angle [rad] (M, N), forces (3, M, N) by
    wheel.FORCES, and whether an equilibrium was found (N,)."""

    slip: Array
    draft: Array
    entry_angle: Array
    forces: Array
    found: NDArray[np.bool_]


def solve(situation: Situation, model: WheelModel) -> Equilibrium:
    """The equilibrium at each instant, residuals below 1e-10 of the weight where found."""
    n_instants = len(situation.demand)
    coarse = np.unique(np.append(np.arange(0, n_instants, _STRIDE), n_instants - 1))
    knots = _newton(_at(situation, coarse), _from_scratch(_at(situation, coarse), model), model)
    good = coarse[knots.found]
    if not len(good):
        return _newton(situation, _from_scratch(situation, model), model)

    def between(values: Array) -> Array:
        return np.interp(np.arange(n_instants), good, values[knots.found])

    angles = np.stack([between(row) for row in knots.entry_angle])
    result = _newton(situation, (between(knots.slip), between(knots.draft), angles), model)
    lost = np.flatnonzero(~result.found)
    if len(lost):
        again = _newton(_at(situation, lost), _from_scratch(_at(situation, lost), model), model)
        for whole, part in zip(result, again, strict=True):
            whole[..., lost] = part
    return result


def wheel_state(situation: Situation, slip: Array, entry_angle: Array) -> WheelState:
    """States of all wheels (M, N) at a common slip (N,) and entry angles [rad] (M, N)."""
    soil = Soil(*situation.soil)
    return state_on(soil, entry_angle, slip + situation.deviation, situation.radius, situation.width)


def _at(situation: Situation, index: NDArray[np.intp]) -> Situation:
    return Situation(*(a[..., index] for a in situation))


def _from_scratch(situation: Situation, model: WheelModel) -> tuple[Array, Array, Array]:
    """A first guess: little slip and draft, entry angles that carry the level loads."""
    slip = np.minimum(0.1, situation.slip_limit)
    load = situation.level_load
    unknown = wheel_state(situation, slip, np.full_like(load, np.nan))
    angle = entry_angle_for_load(load.ravel(), WheelState(*(np.ravel(a) for a in unknown)), model, tolerance=1e-3)
    angle = np.where(np.isfinite(angle), angle, 1.0).reshape(load.shape)
    return slip, np.zeros_like(slip), angle


def _newton(situation: Situation, guess: tuple[Array, Array, Array], model: WheelModel) -> Equilibrium:
    slip, draft, angle = (np.array(a, float) for a in guess)
    forces = np.empty((3, *angle.shape))
    found = np.zeros(len(slip), bool)
    todo = np.arange(len(slip))
    for _ in range(_MAX_STEPS):
        part = _at(situation, todo)
        forces[..., todo], step, miss = _linearised(part, slip[todo], draft[todo], angle[..., todo], model)
        at_rest = miss + np.abs(step[0]) < _TOLERANCE
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


def _linearised(
    situation: Situation, slip: Array, draft: Array, angle: Array, model: WheelModel
) -> tuple[Array, tuple[Array, Array, Array], Array]:
    """Forces (3, M, N), Newton steps of slip, draft and angles, relative residual (N,)."""
    shape = angle.shape
    flat, jacobian = wheel_forces_and_derivatives(wheel_state(situation, slip, angle), model)
    forces = flat.reshape(3, *shape)
    (W_a, DP_a, T_a), (W_s, DP_s, T_s) = (jacobian[:, i].reshape(3, *shape) for i in (0, 1))
    lever = situation.load_per_draft
    load_miss = situation.level_load + lever * draft - forces[0]
    pull_miss = forces[1].sum(axis=0) - draft - situation.resistance
    weight = situation.level_load.sum(axis=0)
    residual = (np.abs(load_miss).max(axis=0) + np.abs(pull_miss)) / weight

    # Each angle follows from its load: d_angle = (load_miss + lever d_draft - W_s d_slip) / W_a.
    def along_load(by_angle: Array, by_slip: Array, value: Any) -> tuple[Any, Any, Any]:
        """Constant, change with slip and change with draft of a force, angles eliminated."""
        share = by_angle / W_a
        return value + share * load_miss, by_slip - share * W_s, share * lever

    constant, by_slip, by_draft = along_load(DP_a, DP_s, forces[1])
    A = constant.sum(axis=0) - draft - situation.resistance
    B = np.maximum(by_slip.sum(axis=0), 1e-6 * weight)  # past the greatest pull: on to the limits
    C = by_draft.sum(axis=0) - 1.0
    T_0, T_slip, T_draft = along_load(T_a, T_s, forces[2] - situation.torque_limit)
    to_torque = np.min(-(T_0 - T_draft * A / C) / np.maximum(T_slip - T_draft * B / C, 1e-9), axis=0)
    to_demand = -(A + C * (situation.demand - draft)) / B
    to_least = -(A + C * (situation.least_draft - draft)) / B
    to_limit = np.maximum(situation.slip_limit - slip, to_least)
    d_slip = np.minimum.reduce([to_demand, to_limit, to_torque, MAX_SLIP - slip])
    d_slip = np.clip(d_slip, -0.15, 0.15)
    d_draft = -(A + B * d_slip) / C
    return forces, (d_slip, d_draft, (load_miss + lever * d_draft - W_s * d_slip) / W_a), residual
