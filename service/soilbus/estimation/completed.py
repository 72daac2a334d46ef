"""A window's residuals under a wheel-soil model that effects complete.

The parameters of the effects take their place beside the gain errors of the sensors: each
as (parameter - value) / std, zero with variance one before any data.  Soil, latents and
parameters go through the effects' hooks with their derivatives (see terra.dual), and there
is one integration for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.effect_parameters import Free, active_at, varied_at
from soilbus.estimation.linearised import Latents
from soilbus.estimation.residuals import MAX_TURN, Lateness, Response, WindowProblem
from soilbus.estimation.window import Rig, Window
from soilbus.terra.dual import UNIT, Dual, slope_of, value_of
from soilbus.terra.effects.along import through_low_pass
from soilbus.terra.effects.effect import (
    Active,
    Effect,
    Forces,
    Surroundings,
    reactions_with,
    true_draft,
    wheel_with,
)
from soilbus.terra.stress import lumped_modulus
from soilbus.terra.tangent import forces_along
from soilbus.terra.vehicle import GRAVITY
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

LOAD_ROUNDS, LITTLE_TURN = 6, 0.01
"""Steps to the entry angles that carry the loads, and the relative one that is the last."""
_LATENTS = ("entry_angle", "load", "speed", "ground_speed")
_SOIL = Soil._fields


_POWERS = tuple((i, j) for i in range(3) for j in range(5))
"""Powers of load and of slip through which torques go: within 0.1 % of the model's over a recording."""


class _Contact(NamedTuple):
    """Load, drawbar pull and torque between wheels and ground, sinkage (N, W), what effects depend on."""

    forces: Forces
    depth: Any
    around: Surroundings


class _Wheels(NamedTuple):
    """Wheels as the effects' hooks leave them, their sinkages (N, W), and what effects depend on."""

    state: WheelState
    model: WheelModel
    depth: Any
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
        angle = base.entry_angle

        def excess(angle: Array) -> Array:
            wheels = self._wheels(soil, active, base, angle)
            contact = self._contact(wheels, active, wheel_forces(wheels.state, wheels.model))
            return np.asarray(self._excess(contact, active, base))

        off = excess(angle)
        with np.errstate(all="ignore"):
            slope = (2.0 * soil.n + 1.0) * base.load  # of small angles, by the angle's logarithm
            for _ in range(LOAD_ROUNDS):
                step = np.where(slope > 0.0, -off / slope, 0.0)
                turned = np.clip(angle * np.exp(np.clip(step, -0.5, 0.5)), MIN_ENTRY_ANGLE, MAX_ENTRY_ANGLE * 0.98)
                if np.abs(step).max(initial=0.0) < LITTLE_TURN:
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
        return np.broadcast_to(self._wheels(soil, active, latents, latents.entry_angle).depth, latents.load.shape)

    def _response(self, soil: Soil, gains: Array, latents: Latents) -> Response:
        if not self.effects:
            return super()._response(soil, gains, latents)
        pulls = gains[self.n_sensors :]
        active = varied_at(self.effects, self.free, pulls, self.n_wheels)
        varied = Latents(**{name: Dual(getattr(latents, name), {name: UNIT}) for name in _LATENTS})  # type: ignore[arg-type]
        wheels = self._wheels(_varied(soil), active, varied, varied.entry_angle)
        contact = self._contact(wheels, active, forces_along(wheels.state, wheels.model))
        load, drawbar, torque, depth = self._told(contact, active, varied)
        around = self._surroundings(latents)
        pull = self._pull(contact.forces[1].only(int), active, around)
        at, by_latents, by_soil, by_effects = _gathered(
            (load, drawbar, torque, depth), len(self.free), (self.n, self.n_wheels)
        )
        np.divide(by_soil[:, 1], self.rig.width, out=by_soil[:, 0])  # both act through K_L = k_c/b + k_phi
        pull_by_effects = np.zeros((len(self.free), self.n))
        for i in range(len(self.free)):
            pull_by_effects[i] = slope_of(pull, i)
        by_angle, by_load, by_speed, by_ground = by_latents.swapaxes(0, 1)
        slope, off = by_angle[0], -at[0]
        along = by_angle[1:] / slope  # what a load more turns into, by way of the entry angle

        def held(d: Array) -> Array:
            """Derivatives (3, ..., N, W) with the entry angle following the load."""
            return np.asarray(d[1:] - (along[:, None] if d.ndim == 4 else along) * d[0])

        value = at[1:] + along * off
        return Response(
            value=value,
            by_load=held(by_load),
            by_speed=held(by_speed),
            by_ground=held(by_ground),
            by_soil=held(by_soil),
            load_by_slip=by_speed[0] * self.rig.radius * latents.speed**2 / latents.ground_speed[:, None],
            load_by_soil=by_soil[0],
            load_by_effects=by_effects[0],
            load_slope=slope,
            off=off,
            by_effects=held(by_effects),
            pull=np.asarray(value_of(pull)),
            pull_by_effects=pull_by_effects,
        )

    def _wheels_in_contact(self, soil: Soil, gains: Array, latents: Latents) -> tuple[WheelState, WheelModel]:
        if not self.effects:
            return super()._wheels_in_contact(soil, gains, latents)
        wheels = self._wheels(soil, self.active(gains[self.n_sensors :]), latents, latents.entry_angle)
        return wheels.state, wheels.model

    def _wheels(self, soil: Soil, active: Sequence[Active], latents: Latents, angle: Array) -> _Wheels:
        """The wheels at given entry angles: these and the circles that effects make of the wheels give the sinkages."""
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        K_L = lumped_modulus(soil.k_c, soil.k_phi, self.rig.width)
        state = WheelState(angle, slip, self.rig.radius, self.rig.width, K_L, soil.n, np.tan(soil.phi), soil.c, soil.K)
        around = self._surroundings(latents)
        state, model = wheel_with(active, state, self.model, around)
        return _Wheels(state, model, sinkage(angle, state.radius), around)

    def _contact(self, wheels: _Wheels, active: Sequence[Active], forces: Forces) -> _Contact:
        """What happens between wheels and ground, from the integrated forces."""
        forces = reactions_with(active, forces, wheels.state, wheels.around)
        return _Contact(forces, wheels.depth, wheels.around)

    def _excess(self, contact: _Contact, active: Sequence[Active], latents: Latents) -> Any:
        """Load (N, W) that the soil carries beyond what it must."""
        excess = contact.forces[0] - latents.load
        for effect, values in active:
            if effect.load is not None:
                excess = excess + effect.load(contact.around, values)
        return excess

    def _told(self, contact: _Contact, active: Sequence[Active], latents: Latents) -> tuple[Any, Any, Any, Any]:
        """Load that the soil carries beyond what it must, drawbar pull, torque reading and sinkage (N, W)."""
        _, pull, torque = contact.forces
        for effect, values in active:
            if effect.torque is not None:
                torque = effect.torque(torque, contact.around, values)
        return self._excess(contact, active, latents), pull, torque, contact.depth

    def _pull(self, pull: Dual, active: Sequence[Active], around: Surroundings) -> Any:
        """What the wheels, which pull so much (N, W), must pull besides what the readings ask for (N,) [N]."""
        missing, draft = self._unread(active, around, pull.sum(axis=1))
        return missing + draft - self.draft

    def _unread(self, active: Sequence[Active], around: Surroundings, pull: Any) -> tuple[Any, Any]:
        """Resistances (N,) in no reading, and drafts (N,) without what effects add to theirs.

        Both go by the draft and the acceleration that the whole balance tells, not by their
        readings: a reading's own noise beside the error that is proportional to it would
        make a greater draft, and a smaller mass, look better (errors in variables).
        """

        def resistance(around: Surroundings) -> Any:
            told = [effect.resistance(around, values) for effect, values in active if effect.resistance is not None]
            return sum(told, np.zeros(self.n))

        draft = true_draft(active, self.draft, around)
        off = self.demand - self.draft + draft + resistance(around) - pull
        by_draft, by_acceleration = self._shares
        told = around._replace(acceleration=around.acceleration - (by_acceleration * off)[:, None])
        errors = [(effect.draft, values) for effect, values in active if effect.draft is not None]
        if errors:
            true = draft - by_draft * off
            draft = self.draft - sum(error(true, told, values) for error, values in errors)
        return resistance(told), draft

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

    def lateness(self, gains: Array, latents: Latents, torque: Array) -> Lateness | None:
        """Of readings y that are late by d and a low pass of tau: x(t) = (1 + tau d/dt) y(t + d).

        y(t + d) is y(t) + s(t + d) - s(t) with the curve s of the readings (see local_cubics): the noise of an instant
        stays with it, else every delay would pair other noises and some would seem to fit better.  For torques, which
        the model predicts, the low pass goes over the prediction instead, and so do derivatives: slopes of readings
        have noise that would count as information.
        """
        places = {(f.effect, f.parameter.name): i for i, f in enumerate(self.free)}
        pulls, W, P = gains[self.n_sensors :], self.n_wheels, len(self.free)
        found: dict[str, tuple[Array, Array]] = {}
        predicted, by_predicted = self._nothing_late("torque", P)
        for effect in self.effects:
            for quantity, (delay, time_constant) in effect.late.items():
                at = places[effect.name, delay], places[effect.name, time_constant]
                if all(self.free[i].std == 0.0 and self.free[i].value == 0.0 for i in at):
                    continue
                added, by = found.setdefault(quantity, self._nothing_late(quantity, P))
                d, tau = (self.free[i].at(float(pulls[i])) for i in at)
                std, of_tau = (self.free[i].std for i in at)
                if quantity == "torque":
                    predicted, rate, by_tau = self._behind(tau, latents, torque)
                    by_predicted[at[0]], by_predicted[at[1]] = -std * rate, of_tau * by_tau
                    tau, std, of_tau = 0.0, 0.0, 0.0
                for column, series in enumerate(self._curves.of(quantity)):
                    curve = series.faithful if quantity == "torque" else series.smooth
                    value, slope, second = curve.at(self.t + d)
                    added[:, column] += np.nan_to_num(value - curve.at(self.t)[0] + tau * slope)
                    by[at[0], :, column] += std * np.nan_to_num(slope + tau * second)
                    by[at[1], :, column] += of_tau * np.nan_to_num(slope)
        if not found:
            return None
        read, load, ground, draft, pitch = (
            found.get(q) or self._nothing_late(q, P) for q in ("torque", "load", "ground_speed", "draft", "pitch")
        )
        measured, by_measured = np.zeros((self.n, 2 * W + 1)), np.zeros((P, self.n, 2 * W + 1))
        measured[:, :W], measured[:, 2 * W] = load[0] * self.usable, ground[0][:, 0]
        by_measured[:, :, :W], by_measured[:, :, 2 * W] = load[1] * self.usable, ground[1][:, :, 0]
        weight = 0.0 if self.rig.chassis is None else self.rig.chassis.mass * GRAVITY * np.cos(self.pitch)
        return Lateness(
            torque=read[0],
            measured=measured,
            demand=draft[0][:, 0] + weight * pitch[0][:, 0],
            predicted=predicted,
            by_torque=read[1],
            by_measured=by_measured,
            by_demand=draft[1][:, :, 0] + weight * pitch[1][:, :, 0],
            by_predicted=by_predicted,
        )

    def _behind(self, tau: float, latents: Latents, torque: Array) -> tuple[Array, Array, Array]:
        """What a low pass of tau [s] adds to the torques (N, W) of the model; the slope behind it; derivative by tau.

        Between the instants, and where some are left out, torques follow from the curves of loads and speeds: by a
        polynomial through the model's own torques over load and slip.
        """
        off, slope, by_tau = (np.zeros(torque.shape) for _ in range(3))
        loads, speeds, (ground,) = (
            [series.smooth for series in self._curves.of(q)] for q in ("load", "speed", "ground_speed")
        )
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        for w, (load, speed) in enumerate(zip(loads, speeds, strict=True)):
            used = self.usable[:, w]
            if len(load.t) < 2 or np.count_nonzero(used) < 2 * len(_POWERS):
                continue
            states = np.stack([latents.load[used, w], slip[used, w]])
            rim = np.maximum(self.rig.radius[w] * speed.at(load.t)[0], 1e-3)
            way = np.clip(np.stack([load.value, 1.0 - ground.at(load.t)[0] / rim]).T, *np.sort(states)[:, [0, -1]].T)
            middle, size = states.mean(1)[:, None], np.maximum(states.std(1), 1e-9)[:, None]
            basis = _monomials((states - middle) / size)
            by_power = np.linalg.lstsq(basis, torque[used, w], rcond=None)[0]
            along = _monomials((way.T - middle) / size) @ by_power
            late = through_low_pass(load.t, along[:, None], tau)
            rate = (along[:, None] - late) / tau if tau > 0.0 else np.gradient(along, load.t)[:, None]
            behind = through_low_pass(load.t, rate, tau)
            off[:, w] = np.interp(self.t, load.t, late[:, 0] - along) * used
            slope[:, w] = np.interp(self.t, load.t, rate[:, 0]) * used
            by_tau[:, w] = -np.interp(self.t, load.t, behind[:, 0]) * used
        return off, slope, by_tau

    def _nothing_late(self, quantity: str, n_effects: int) -> tuple[Array, Array]:
        """Nothing (N, columns), with no derivatives (P, N, columns)."""
        columns = self._curves.number_of(quantity)
        return np.zeros((self.n, columns)), np.zeros((n_effects, self.n, columns))

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


def _gathered(told: Sequence[Any], n_effects: int, shape: tuple[int, int]) -> tuple[Array, Array, Array, Array]:
    """Values (M, N, W), their derivatives by latents (M, 4, N, W), soil (M, 6, N, W) and parameters (M, P, N, W)."""
    kinds = (), (len(_LATENTS),), (len(_SOIL),), (n_effects,)
    at, by_latents, by_soil, by_effects = (np.zeros((len(told), *kind, *shape)) for kind in kinds)
    for i, one in enumerate(told):
        at[i] = value_of(one)
        for quantity, d in one.by.items() if isinstance(one, Dual) else ():
            if isinstance(quantity, int):
                by_effects[i, quantity] = d
            elif quantity in _LATENTS:
                by_latents[i, _LATENTS.index(quantity)] = d
            else:
                by_soil[i, _SOIL.index(quantity)] = d
    return at, by_latents, by_soil, by_effects


def _monomials(states: Array) -> Array:
    """Products (N, len(_POWERS)) of powers of load and slip (2, N)."""
    load, slip = ([value**i for i in range(most + 1)] for value, most in zip(states, _POWERS[-1], strict=True))
    return np.stack([load[i] * slip[j] for i, j in _POWERS], axis=1)


def _varied(soil: Soil) -> Soil:
    """A soil of which all but k_c carry derivatives by themselves."""
    varied = {name: Dual(getattr(soil, name), {name: UNIT}) for name in _SOIL[1:]}
    return soil._replace(**varied)  # type: ignore[arg-type]
