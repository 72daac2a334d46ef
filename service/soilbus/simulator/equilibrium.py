"""Equilibrium of the simulated vehicle: slips, draft and entry angles at which loads and pulls balance.

    for each wheel   W(theta_i, s_i) = load_i(D)
                     s_i = s + deviation_i + lead_i, with one condition of the drive line (simulator/drivetrain.py)
    once             sum of DP(theta_i, s_i) = D + resistance
    the driver       s = min(s where D meets the demand, slip limit, s where a motor is at its torque limit)

Unknown at each instant are the common slip s, the draft D, and for each wheel an entry angle theta_i and the lead_i of
its slip, which is zero behind a motor of its own. Newton's method solves the three conditions of the driver at once:
draft and torque grow with slip, so the smallest of the three steps leads to the condition that holds. The slip limit
may be passed as long as the draft would be below its least value. A vehicle that tows nothing climbs instead: D is then
the part m g sin(pitch) of its weight. Effects take part by finite differences, starting from the equilibrium without.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.simulator.drivetrain import Drivetrain
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
_LEAST_WHEEL_SLIP = -1.0
"""Least slip of a wheel: its rim is half as fast as the ground."""
_RESIDUAL_TOLERANCE = 1e-10
"""Residual over the vehicle's weight, plus step of slip, that ends the iteration."""
_MAX_NEWTON_STEPS = 60
_RELATIVE_DIFFERENCE = 1e-6
"""Step of the finite differences; Newton's steps need not be exact."""
_SPEED_WEIGHT = 0.05
"""Weight of relative speeds against torques over load and radius where a coupling changes over from one condition to
the other. Solutions do not depend on it: of 128 drives with limited slip none is lost at 0.03 to 0.1, half at 1."""
_STEEPEST_SINE = 0.9
"""Sine of the steepest slope, 64 degrees: no soil holds a vehicle there."""
_COARSE_STRIDE = 10
"""Every tenth instant is solved first; its neighbours then start next to their solution."""


class Situation(NamedTuple):
    """Given quantities at N instants for M wheels; all arrays end in N.

    Attributes
    ----------
    t, distance, ground_speed, acceleration
        Motion (N,) [s], [m], [m/s], [m/s^2].
    resistance
        Pull that slope and inertia take [N] (N,).
    level_load, load_per_draft, upright_load
        Wheel loads without draft [N] (M, N), their change with draft (M, N), and the part of them (M, N) that goes down
        with the cosine of a pitch that holds the vehicle back in place of a draft; zero where a draft does.
    deviation
        Each motor's slip beyond the common one, for each of its wheels (M, N).
    radius, width, length
        Of the wheels [m] (M, N); length that of a track's contact, 0 of a wheel.
    soil
        Parameters (6, M, N) in the order of wheel.Soil.
    demand
        Draft asked for [N] (N,); inf for as much as possible.
    slip_limit
        (N,).
    torque_limit
        [N m] (L, N), in the order of Drivetrain.limited.
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
    upright_load: Array
    deviation: Array
    radius: Array
    width: Array
    length: Array
    soil: Array
    demand: Array
    slip_limit: Array
    torque_limit: Array
    least_draft: Array

    def load(self, draft: Array) -> Array:
        """Return the wheel loads [N] (M, N)."""
        cosine = np.sqrt(1.0 - self._sine(draft) ** 2)
        return np.asarray(self.level_load + self.load_per_draft * draft + self.upright_load * (cosine - 1.0))

    def load_slope(self, draft: Array) -> Array:
        """Return the derivatives (M, N) of the wheel loads by the draft."""
        sine, weight = self._sine(draft), self.level_load.sum(axis=0)
        return np.asarray(self.load_per_draft - self.upright_load * sine / np.sqrt(1.0 - sine**2) / weight)

    def _sine(self, draft: Array) -> Array:
        """Sine (N,) of the pitch whose share of the weight is this."""
        return np.asarray(np.clip(draft / self.level_load.sum(axis=0), -_STEEPEST_SINE, _STEEPEST_SINE))


class Mechanics(NamedTuple):
    """The wheel-soil model, effects on it, and what they may depend on (see Surroundings).

    Attributes
    ----------
    rear
        Which wheels run in the rut of another (M,).
    mass, duration, length
        Of the vehicle [kg], of the drive [s] and [m].
    drivetrain
        What turns the wheels.
    climbs
        Nothing is towed: what is called draft is the share of the weight along the slope.
    """

    model: WheelModel
    rear: NDArray[np.bool_]
    mass: float
    duration: float
    length: float
    drivetrain: Drivetrain
    effects: Sequence[Active] = ()
    climbs: bool = False

    @property
    def plain(self) -> bool:
        """Whether no effect changes the forces at the wheels."""
        return all(effect.wheel is None and effect.forces is None for effect, _ in self.effects)


class _Slopes(NamedTuple):
    """Forces (3, M, N) and their derivatives by entry angle, slip of the wheel and draft."""

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
    lead
        Slips of the wheels beyond the common one and the given deviation (M, N).
    entry_angle
        [rad] (M, N).
    forces
        (3, M, N) by wheel.FORCES.
    found
        Whether an equilibrium was found (N,).
    """

    slip: Array
    draft: Array
    lead: Array
    entry_angle: Array
    forces: Array
    found: NDArray[np.bool_]


def solve(situation: Situation, mechanics: Mechanics, near: Equilibrium | None = None) -> Equilibrium:
    """Return the equilibrium at each instant; residuals are below 1e-10 of the vehicle's weight where `found`.

    All instants start from the last one of `near`. Without it every tenth is solved first, and the others start from
    values interpolated between these.
    """
    n_instants = len(situation.demand)
    if near is not None:
        slip, draft = (np.full(n_instants, a[-1]) for a in (near.slip, near.draft))
        lead, angles = (np.repeat(a[:, -1:], n_instants, axis=1) for a in (near.lead, near.entry_angle))
        return _from_near(situation, mechanics, _Guess(slip, draft, lead, angles))
    coarse = np.unique(np.append(np.arange(0, n_instants, _COARSE_STRIDE), n_instants - 1))
    knots = _from_scratch(_at(situation, coarse), mechanics)
    good = coarse[knots.found]
    if not len(good):
        return _from_scratch(situation, mechanics)

    def between(values: Array) -> Array:
        return np.interp(np.arange(n_instants), good, values[knots.found])

    lead, angles = (np.stack([between(row) for row in rows]) for rows in (knots.lead, knots.entry_angle))
    return _from_near(situation, mechanics, _Guess(between(knots.slip), between(knots.draft), lead, angles))


def _from_near(situation: Situation, mechanics: Mechanics, guess: _Guess) -> Equilibrium:
    """The equilibrium from a guess, and from scratch where that does not lead to one."""
    forces = _exact(mechanics.model) if mechanics.plain else _by_differences(mechanics)
    result = _newton(situation, mechanics.drivetrain, guess, forces)
    lost = np.flatnonzero(~result.found)
    if len(lost):
        again = _from_scratch(_at(situation, lost), mechanics)
        for whole, part in zip(result, again, strict=True):
            whole[..., lost] = part
    return result


def surroundings(situation: Situation, mechanics: Mechanics, slip: Array, draft: Array) -> Surroundings:
    """Return what effects may depend on, instants first: (N, M) or (N, 1).

    Slips of the wheels are (M, N), the draft [N] is (N,).
    """
    towed = np.zeros_like(draft) if mechanics.climbs else draft
    return Surroundings(
        t=situation.t[:, None],
        distance=situation.distance[:, None],
        load=situation.load(draft).T,
        ground_speed=situation.ground_speed[:, None],
        wheel_speed=(situation.ground_speed / (situation.radius * (1.0 - slip))).T,
        rear=mechanics.rear,
        draft=towed[:, None],
        acceleration=situation.acceleration[:, None],
        mass=mechanics.mass,
        duration=mechanics.duration,
        length=mechanics.length,
    )


def sinkages(situation: Situation, mechanics: Mechanics, at: Equilibrium) -> Array:
    """Return the sinkages [m] (M, N), with the radii that effects give the wheels."""
    slip = wheel_slips(situation, at)
    state, around = _transposed(situation, slip, at.entry_angle), surroundings(situation, mechanics, slip, at.draft)
    changed, _ = wheel_with(mechanics.effects, state, mechanics.model, around)
    return np.asarray(sinkage(at.entry_angle, np.transpose(changed.radius)))


def wheel_slips(situation: Situation, at: Equilibrium) -> Array:
    """Return the slips of the wheels (M, N)."""
    return np.asarray(at.slip + situation.deviation + at.lead)


def _transposed(situation: Situation, slip: Array, entry_angle: Array) -> WheelState:
    """States (N, M), as effects want them."""
    return WheelState(*(np.transpose(a) for a in wheel_state(situation, slip, entry_angle)))


def wheel_state(situation: Situation, slip: Array, entry_angle: Array) -> WheelState:
    """Return the states of all wheels (M, N) at their slips (M, N) and entry angles [rad] (M, N)."""
    soil = Soil(*situation.soil)
    return state_on(soil, entry_angle, slip, situation.radius, situation.width, situation.length)


def _at(situation: Situation, index: NDArray[np.intp]) -> Situation:
    return Situation(*(a[..., index] for a in situation))


def _from_scratch(situation: Situation, mechanics: Mechanics) -> Equilibrium:
    """The equilibrium from little slip and draft and entry angles that carry the level loads, effects added last.

    With tracks from no slip at all: their thrust saturates within s = K/L, and Newton's method nears a point of a
    concave curve from below without overshooting it.
    """
    slip = np.minimum(0.0 if situation.length.any() else 0.1, situation.slip_limit)
    drivetrain, load, model = mechanics.drivetrain, situation.level_load, mechanics.model
    lead = np.where((drivetrain.leader < 0)[:, None], -slip, np.zeros_like(load))  # a free wheel begins without slip
    unknown = wheel_state(situation, slip + situation.deviation + lead, np.full_like(load, np.nan))
    angle = entry_angle_for_load(load.ravel(), WheelState(*(np.ravel(a) for a in unknown)), model, tolerance=1e-3)
    angle = np.where(np.isfinite(angle), angle, 1.0).reshape(load.shape)
    plain = _newton(situation, drivetrain, _Guess(slip, np.zeros_like(slip), lead, angle), _exact(model))
    if mechanics.plain:
        return plain
    guess = _Guess(plain.slip, plain.draft, plain.lead, plain.entry_angle)
    return _newton(situation, drivetrain, guess, _by_differences(mechanics))


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


class _Guess(NamedTuple):
    """Common slip and draft (N,), leads and entry angles (M, N); or steps of these."""

    slip: Array
    draft: Array
    lead: Array
    angle: Array


def _newton(situation: Situation, drivetrain: Drivetrain, guess: _Guess, slopes: _Forces) -> Equilibrium:
    slip, draft, lead, angle = (np.array(a, float) for a in guess)
    forces = np.empty((3, *angle.shape))
    found = np.zeros(len(slip), bool)
    todo = np.arange(len(slip))
    fastest = 1.0 - (1.0 - MAX_SLIP) / len(angle)  # of the wheels of a motor one turns while the others stand
    for _ in range(_MAX_NEWTON_STEPS):
        part = _at(situation, todo)
        wheel_slip = slip[todo] + part.deviation + lead[:, todo]
        at = slopes(part, wheel_slip, draft[todo], angle[..., todo])
        step, miss = _step(part, drivetrain, _Guess(slip[todo], draft[todo], lead[:, todo], angle[:, todo]), at)
        forces[..., todo] = at.forces
        at_rest = miss + np.abs(step.slip) < _RESIDUAL_TOLERANCE
        found[todo] = at_rest
        todo, wheel_slip, step = todo[~at_rest], wheel_slip[:, ~at_rest], _Guess(*(a[..., ~at_rest] for a in step))
        if not len(todo):
            break
        slip[todo] = np.clip(slip[todo] + step.slip, _MIN_SLIP, MAX_SLIP)
        draft[todo] += step.draft
        lead[:, todo] += np.clip(step.lead, (_LEAST_WHEEL_SLIP - wheel_slip) / 2.0, (fastest - wheel_slip) / 2.0)
        old = angle[..., todo]
        near = np.clip(old + step.angle, old / 2.0, old * 2.0)
        angle[..., todo] = np.clip(near, MIN_ENTRY_ANGLE, MAX_ENTRY_ANGLE)
    pulls = draft > situation.least_draft - 1e-6 * situation.level_load.sum(axis=0)
    return Equilibrium(slip, draft, lead, angle, forces, found & pulls)


def _step(situation: Situation, drivetrain: Drivetrain, here: _Guess, at: _Slopes) -> tuple[_Guess, Array]:
    """Newton steps, relative residual (N,)."""
    forces, draft = at.forces, here.draft
    (W_a, DP_a, T_a), (W_s, DP_s, T_s), (W_d, DP_d, T_d) = at.by_angle, at.by_slip, at.by_draft
    load_miss = situation.load(draft) - forces[0]
    lever = situation.load_slope(draft) - W_d
    pull_miss = forces[1].sum(axis=0) - draft - situation.resistance
    weight = situation.level_load.sum(axis=0)

    # Each angle follows from its load: d_angle = (load_miss + lever d_draft - W_s d_wheel_slip) / W_a.
    def along_load(by_angle: Array, by_slip: Array, by_draft: Array, value: Any) -> tuple[Any, Any, Any]:
        """Constant, change with the wheel's slip and change with draft of a force, angles eliminated."""
        share = by_angle / W_a
        return value + share * load_miss, by_slip - share * W_s, by_draft + share * lever

    pull, torque = along_load(DP_a, DP_s, DP_d, forces[1]), along_load(T_a, T_s, T_d, forces[2])
    lead, off = _leads(situation, drivetrain, here, forces[2], torque)
    residual = (np.abs(load_miss).max(axis=0) + np.abs(pull_miss)) / weight + off

    # Each lead follows from its condition: d_lead = lead[0] + lead[1] d_slip + lead[2] d_draft.
    def along_lead(value: Any, by_slip: Any, by_draft: Any) -> tuple[Any, Any, Any]:
        """Constant, change with the common slip and change with draft of a force, leads eliminated."""
        return value + by_slip * lead[0], by_slip + by_slip * lead[1], by_draft + by_slip * lead[2]

    constant, by_slip, by_draft = along_lead(*pull)
    A = constant.sum(axis=0) - draft - situation.resistance
    B = np.maximum(by_slip.sum(axis=0), 1e-6 * weight)  # past the greatest pull: on to the limits
    C = by_draft.sum(axis=0) - 1.0
    T_0, T_slip, T_draft = (drivetrain.limited @ (a + np.zeros_like(T_s)) for a in along_lead(*torque))
    T_0 = T_0 - situation.torque_limit
    to_torque = np.min(-(T_0 - T_draft * A / C) / np.maximum(T_slip - T_draft * B / C, 1e-9), axis=0)
    to_demand = -(A + C * (situation.demand - draft)) / B
    to_least = -(A + C * (situation.least_draft - draft)) / B
    to_limit = np.maximum(situation.slip_limit - here.slip, to_least)
    d_slip = np.minimum.reduce([to_demand, to_limit, to_torque, MAX_SLIP - here.slip])
    d_slip = np.clip(d_slip, -0.15, 0.15)
    d_draft = -(A + B * d_slip) / C
    d_lead = lead[0] + lead[1] * d_slip + lead[2] * d_draft
    d_angle = (load_miss + lever * d_draft - W_s * (d_slip + d_lead)) / W_a
    return _Guess(d_slip, d_draft, d_lead, d_angle), residual


def _leads(
    situation: Situation, drivetrain: Drivetrain, here: _Guess, now: Array, torque: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Steps of the leads (3, M, N): constant, by common slip, by draft; and how far off the conditions are (N,).

    Torques [N m] (M, N): `now`, and as `torque` with entry angles that carry the loads.
    """
    value, by_slip, by_draft = torque
    rim = 1.0 / (1.0 - here.slip - situation.deviation - here.lead)
    lever = (situation.level_load * situation.radius).sum(axis=0)  # makes torques numbers
    speed, of_torque = drivetrain.speed, _torque_weights(drivetrain, rim, now / lever)
    by_speed = np.asarray(~of_torque.any(axis=1))  # (M, N)
    motor, lead = drivetrain.is_motor[:, None], here.lead
    of_speed = np.where(motor, speed @ (rim * lead), speed @ rim)
    miss = np.where(by_speed, of_speed, np.einsum("ijn,jn->in", of_torque, value / lever))
    off = np.where(by_speed, of_speed, np.einsum("ijn,jn->in", of_torque, now / lever))
    rate = np.where(motor[:, None], rim + rim**2 * lead, rim**2)  # of a rim speed, or of its product with the lead
    jacobian = np.where(by_speed[:, None], speed[..., None] * rate, of_torque * (by_slip / lever))
    of_slip = np.where(motor, speed @ (rim**2 * lead), speed @ rim**2)
    common = np.where(by_speed, of_slip, np.einsum("ijn,jn->in", of_torque, by_slip / lever))
    draft = np.where(by_speed, 0.0, np.einsum("ijn,jn->in", of_torque, by_draft / lever + np.zeros_like(rim)))
    right = np.stack([miss, common, draft], axis=-1)
    steps = -np.linalg.solve(np.moveaxis(jacobian, 2, 0), np.moveaxis(right, 1, 0))
    return np.moveaxis(steps, 0, 2).swapaxes(0, 1), np.abs(off).max(axis=0)


def _torque_weights(drivetrain: Drivetrain, rim: Array, torque: Array) -> Array:
    """Weights of the torques (M, M, N) in the conditions that hold now; zero where one of speeds does.

    The condition D = clip(D - k d, -B, B) of a coupling is d = 0 within its bounds, else D = B or D = -B.
    """
    total = np.abs(drivetrain.torque) @ torque
    beyond = drivetrain.torque @ torque - _SPEED_WEIGHT * (drivetrain.speed @ rim)
    is_locked = np.isinf(drivetrain.bias)[:, None]
    bias = np.where(is_locked, 0.0, drivetrain.bias[:, None])
    bound = np.where(is_locked, np.inf, bias * np.abs(total))
    slides = (np.abs(beyond) >= bound) & ~drivetrain.is_motor[:, None]
    at_bound = np.sign(beyond) * np.sign(total) * bias
    weight = drivetrain.torque[..., None] - at_bound[:, None] * np.abs(drivetrain.torque)[..., None]
    return np.asarray(np.where(slides[:, None], weight, 0.0))
