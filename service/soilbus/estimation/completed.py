"""A window's residuals under a wheel-soil model that effects complete.

The parameters of the effects take their place beside the gain errors of the sensors: each
as (parameter - value) / std, zero with variance one before any data.  Derivatives are
differences of the effects' hooks, which are any small functions; the integrals between the
hooks are taken along their tangent, so that there is one integration for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.effect_parameters import Free, active_at
from soilbus.estimation.linearised import Latents
from soilbus.estimation.residuals import MAX_TURN, Response, WindowProblem
from soilbus.estimation.smoothing import smoothed
from soilbus.estimation.window import Rig, Window
from soilbus.terra.effects.effect import Active, Effect, Surroundings, reactions_with, true_draft, wheel_with
from soilbus.terra.stress import lumped_modulus
from soilbus.terra.tangent import Tangent, shape_of_change, tangent
from soilbus.terra.wheel import (
    MAX_ENTRY_ANGLE,
    MIN_ENTRY_ANGLE,
    Soil,
    WheelModel,
    WheelState,
    sinkage,
    wheel_forces,
)

Array = NDArray[np.float64]

STEP = 1e-6
"""Step of the differences: relative, but for effects' parameters in standard deviations."""
LOAD_ROUNDS = 6


class _Contact(NamedTuple):
    """Load, drawbar pull and torque between wheels and ground (3, N, W), sinkage (N, W), what effects depend on."""

    forces: Array
    depth: Array
    around: Surroundings


class _Wheels(NamedTuple):
    """Wheels as the effects' hooks leave them, and what effects depend on."""

    state: WheelState
    model: WheelModel
    around: Surroundings


class CompletedProblem(WindowProblem):
    """One window's data and the model with effects; `free` are the effects' parameters (P)."""

    def __init__(
        self,
        window: Window,
        rig: Rig,
        model: WheelModel,
        min_speed: float,
        max_turn: float = MAX_TURN,
        effects: Sequence[Effect] = (),
        free: Sequence[Free] = (),
    ) -> None:
        super().__init__(window, rig, model, min_speed, max_turn)
        self._complete(effects, free)

    def completed(self, effects: Sequence[Effect], free: Sequence[Free]) -> Self:
        """The same data under a model with these effects, and no others, with these parameters."""
        other = copy(self)
        other._complete(effects, free)
        return other

    def _complete(self, effects: Sequence[Effect], free: Sequence[Free]) -> None:
        self.effects, self.free = tuple(effects), tuple(free)
        self._named = {effect.name: effect for effect in self.effects}
        std = [float(f.std > 0.0) for f in self.free]
        self.gain_names = [*self.gain_names[: self.n_sensors], *(f.name for f in self.free)]
        self.gain_std = np.concatenate([self.gain_std[: self.n_sensors], std])

    def active(self, pulls: Array) -> list[Active]:
        """The effects with their values where the parameters are so many std (P,) from their prior values."""
        return active_at(self.effects, self.free, pulls, self.n_wheels)

    def allowed(self, gains: Array) -> Array:
        """Gains with the effects' parameters inside their ranges."""
        inside = [f.allowed(u) for f, u in zip(self.free, gains[self.n_sensors :].tolist(), strict=True)]
        return np.concatenate([gains[: self.n_sensors], inside])

    def gain_bounds(self) -> tuple[Array, Array]:
        """As WindowProblem; the effects' parameters stay inside their ranges."""
        low, high = super().gain_bounds()
        for i, f in enumerate(self.free, self.n_sensors):
            if f.std > 0.0:
                low[i], high[i] = (f.parameter.low - f.value) / f.std, (f.parameter.high - f.value) / f.std
        return low, high

    def carried(self, latents: Latents, soil: Soil, gains: Array | None = None) -> Latents:
        """As WindowProblem; without gains the effects' parameters are at their prior values."""
        solved = np.isfinite(latents.entry_angle).all() and bool(self.effects)
        base = latents if solved else super().carried(latents, soil, gains)
        if not self.effects:
            return base
        active = self.active(np.zeros(len(self.free)) if gains is None else gains[self.n_sensors :])
        angle, nothing = base.entry_angle, np.zeros_like(base.load)

        def excess(angle: Array) -> Array:
            contact = self._contact(self._wheels(soil, active, base, angle), active)
            return np.asarray(self._told(contact, active, base, nothing)[0])

        off = excess(angle)
        with np.errstate(all="ignore"):
            slope = (excess(angle * (1.0 + STEP)) - off) / STEP
            for _ in range(LOAD_ROUNDS):
                step = np.where(slope > 0.0, -off / slope, 0.0)
                turned = np.clip(angle * np.exp(np.clip(step, -0.5, 0.5)), MIN_ENTRY_ANGLE, MAX_ENTRY_ANGLE * 0.98)
                if np.abs(step).max(initial=0.0) < 1e-3:
                    angle = turned
                    break
                still_off = excess(turned)
                along = (still_off - off) / np.log(turned / angle)  # where it tells nothing the last one serves
                slope = np.where((along > 0.0) & np.isfinite(along), along, slope)
                angle, off = turned, still_off
        return Latents(base.load, base.speed, base.ground_speed, angle)

    def sinkages(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """As WindowProblem, of the circles that the effects make of the wheels."""
        if not self.effects:
            return super().sinkages(soil, gains, latents)
        active = self.active(gains[self.n_sensors :])
        return _depth(self._wheels(soil, active, latents, latents.entry_angle).state)

    def _response(self, soil: Soil, gains: Array, latents: Latents) -> Response:
        if not self.effects:
            return super()._response(soil, gains, latents)
        pulls = gains[self.n_sensors :]
        active, angle = self.active(pulls), latents.entry_angle
        here = self._wheels(soil, active, latents, angle)
        others = self._beside(soil, pulls, latents)
        shape = [shape_of_change(here.model, other.model) for _, _, other in others.values() if other is not None]
        near = tangent(here.state, here.model, frozenset().union(*shape))
        contact = self._contact(here, active, near)
        late = self._from_other_instants(active, contact)
        at = self._told(contact, active, latents, late)
        pull = self._pull(contact, active)

        def by_moving(moved: Latents, step: Any) -> Array:
            contact = self._contact(self._wheels(soil, active, moved, moved.entry_angle), active, near)
            return np.asarray((self._told(contact, active, moved, late) - at) / step)

        by_latents = {}
        for name in ("entry_angle", "load", "speed", "ground_speed"):
            value = getattr(latents, name)
            step = STEP * np.abs(value)
            by_latents[name] = by_moving(_with(latents, name, value + step), step if step.ndim == 2 else step[:, None])
        by_angle = by_latents["entry_angle"]
        by_soil = self._by_soil(soil, active, latents, at, near)
        by_effects = np.zeros((4, len(self.free), self.n, self.n_wheels))
        pull_by_effects = np.zeros((len(self.free), self.n))
        for i, (step_of_effect, other, wheels) in others.items():
            moved = contact if wheels is None else self._contact(wheels, other, near)
            effect = self._named[self.free[i].effect]
            if wheels is not None or effect.torque is not None or effect.load is not None:
                told = self._told(moved, other, latents, self._from_other_instants(other, moved))
                by_effects[:, i] = (told - at) / step_of_effect
            if wheels is not None or effect.draft is not None or effect.resistance is not None:
                pull_by_effects[i] = (self._pull(moved, other) - pull) / step_of_effect
        slope, off = by_angle[0], -at[0]
        along = by_angle[1:] / slope  # what a load more turns into, by way of the entry angle

        def held(d: Array) -> Array:
            """Derivatives (3, ..., N, W) with the entry angle following the load."""
            return np.asarray(d[1:] - (along[:, None] if d.ndim == 4 else along) * d[0])

        value = at[1:] + along * off
        return Response(
            value=value,
            by_load=held(by_latents["load"]),
            by_speed=held(by_latents["speed"]),
            by_ground=held(by_latents["ground_speed"]),
            by_soil=held(by_soil),
            load_by_slip=by_latents["speed"][0] * self.rig.radius * latents.speed**2 / latents.ground_speed[:, None],
            load_by_soil=by_soil[0],
            load_by_effects=by_effects[0],
            load_slope=slope,
            off=off,
            by_effects=held(by_effects),
            pull=pull,
            pull_by_effects=pull_by_effects,
        )

    def _beside(
        self, soil: Soil, pulls: Array, latents: Latents
    ) -> dict[int, tuple[float, list[Active], _Wheels | None]]:
        """For each free parameter a step, the effects after it, and the wheels then, None where they stay."""
        others = {}
        for i in np.flatnonzero(self.gain_std[self.n_sensors :] > 0.0).tolist():
            shifted = pulls.copy()
            inward = STEP if self.free[i].within(pulls[i] + STEP) else -STEP
            shifted[i] += inward
            active, effect = self.active(shifted), self._named[self.free[i].effect]
            stays = effect.wheel is None and effect.forces is None
            others[i] = inward, active, None if stays else self._wheels(soil, active, latents, latents.entry_angle)
        return others

    def _by_soil(self, soil: Soil, active: Sequence[Active], latents: Latents, at: Array, near: Tangent) -> Array:
        """Derivatives (4, 6, N, W) by k_c, k_phi, n, phi, c, K at held entry angles."""
        out = np.empty((4, 6, self.n, self.n_wheels))
        for i, name in enumerate(Soil._fields[1:], 1):
            step = STEP * max(abs(getattr(soil, name)), 1e-9)
            changed = soil._replace(**{name: getattr(soil, name) + step})
            contact = self._contact(self._wheels(changed, active, latents, latents.entry_angle), active, near)
            told = self._told(contact, active, latents, self._from_other_instants(active, contact))
            np.divide(told - at, step, out=out[:, i])
        np.divide(out[:, 1], self.rig.width, out=out[:, 0])  # both act through K_L = k_c/b + k_phi
        return out

    def _wheels(self, soil: Soil, active: Sequence[Active], latents: Latents, angle: Array) -> _Wheels:
        """The wheels at given entry angles."""
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        K_L = lumped_modulus(soil.k_c, soil.k_phi, self.rig.width)
        tan_phi = float(np.tan(soil.phi))
        state = WheelState(angle, slip, self.rig.radius, self.rig.width, K_L, soil.n, tan_phi, soil.c, soil.K)
        around = self._surroundings(latents)
        return _Wheels(*wheel_with(active, state, self.model, around), around)

    def _contact(self, wheels: _Wheels, active: Sequence[Active], near: Tangent | None = None) -> _Contact:
        """What happens between wheels and ground; only a small step away from `near`."""
        state, model, around = wheels
        forces = wheel_forces(state, model) if near is None else near.at(state, model)
        return _Contact(reactions_with(active, forces, state, around), _depth(state), around)

    def _told(self, contact: _Contact, active: Sequence[Active], latents: Latents, late: Array) -> Array:
        """Load that the soil carries beyond what it must, drawbar pull, torque reading and sinkage (4, N, W).

        late (N, W) is what other instants add to the torque readings.  It is taken from a
        smoothed torque, and not followed through their latents: each instant is solved for by itself.
        """
        (load, pull, torque), depth, around = contact
        wheels = np.empty((4, *load.shape))
        np.subtract(load, latents.load, out=wheels[0])
        for effect, values in active:
            if effect.torque is not None and not effect.mixes_instants:
                torque = effect.torque(torque, around, values)
            if effect.load is not None:
                wheels[0] += effect.load(around, values)
        wheels[1], wheels[3] = pull, depth
        np.add(torque, late, out=wheels[2])
        return wheels

    def _pull(self, contact: _Contact, active: Sequence[Active]) -> Array:
        """What the wheels must pull besides what the readings ask for (N,) [N]."""
        missing, draft = self._unread(active, contact.around, contact.forces[1].sum(axis=1))
        return np.asarray(missing + draft - self.draft)

    def _unread(self, active: Sequence[Active], around: Surroundings, pull: Array) -> tuple[Array, Array]:
        """Resistances (N,) in no reading, and drafts (N,) without what effects add to theirs.

        Both go by the draft and the acceleration that the whole balance tells, not by their
        readings: a reading's own noise beside the error that is proportional to it would
        make a greater draft, and a smaller mass, look better (errors in variables).
        """

        def resistance(around: Surroundings) -> Array:
            told = [effect.resistance(around, values) for effect, values in active if effect.resistance is not None]
            return np.asarray(sum(told, np.zeros(self.n)))

        draft = true_draft(active, self.draft, around)
        off = self.demand - self.draft + draft + resistance(around) - pull
        by_draft, by_acceleration = self._shares
        told = around._replace(acceleration=around.acceleration - (by_acceleration * off)[:, None])
        errors = [(effect.draft, values) for effect, values in active if effect.draft is not None]
        if errors:
            true = draft - by_draft * off
            draft = self.draft - sum(error(true, told, values) for error, values in errors)
        return resistance(told), np.asarray(draft)

    @property
    def _shares(self) -> tuple[Array, Array]:
        """What the noise of draft [1] and acceleration [1/kg] has of each newton that the balance is off (N,)."""
        mass = 0.0 if self.rig.chassis is None else self.rig.chassis.mass
        known = self.draft_var > 0.0
        by_draft, by_acceleration = (
            np.divide(variance, self.demand_var, out=np.zeros(self.n), where=known)
            for variance in (self.draft_var, mass * self.acceleration_var)
        )
        return by_draft, by_acceleration

    def _from_other_instants(self, active: Sequence[Active], contact: _Contact) -> Array:
        """What effects that mix instants add to the torque readings (N, W)."""
        torque, around = contact.forces[2], contact.around
        late: Array = np.zeros_like(torque)
        mixing = [(e, v) for e, v in active if e.torque is not None and e.mixes_instants]
        if not mixing:
            return late
        smooth = smoothed(self.t, torque)
        for effect, values in mixing:
            if effect.torque is not None:
                late += effect.torque(smooth, around, values) - smooth
        return late

    def _surroundings(self, latents: Latents) -> Surroundings:
        chassis = self.rig.chassis
        return Surroundings(
            t=self.since[:, None],
            distance=self.distance[:, None],
            load=latents.load,
            ground_speed=latents.ground_speed[:, None],
            wheel_speed=latents.speed,
            rear=~self.rig.front,
            draft=self.draft[:, None],
            acceleration=self.acceleration[:, None],
            mass=0.0 if chassis is None else chassis.mass,
            duration=self.duration,
            length=self.length,
        )


def _depth(state: WheelState) -> Array:
    """Sinkage [m] (N, W) of wheels."""
    return np.broadcast_to(sinkage(state.entry_angle, state.radius), np.shape(state.entry_angle))


def _with(latents: Latents, name: str, value: Array) -> Latents:
    parts = {n: getattr(latents, n) for n in ("load", "speed", "ground_speed", "entry_angle")}
    return Latents(**(parts | {name: value}))
