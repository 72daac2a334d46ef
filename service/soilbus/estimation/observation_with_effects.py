"""Observation model with effects: the hooks of effects in torque, draft balance and sinkage, and delays of channels.

gains     sensor gains | effect parameters, standardised: (value - prior value) / prior sd
delayed   y(t + d) in place of y(t)
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.linearisation import DelayTerms, Latents, Response
from soilbus.estimation.nuisance_parameters import Free, active_at
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.window import Rig, Window
from soilbus.terra.dual import UNIT, Dual, slope_of, value_of
from soilbus.terra.effects.effect import Active, Effect, Forces, Surroundings, reactions_with, true_draft, wheel_with
from soilbus.terra.tangent import forces_along
from soilbus.terra.vehicle import GRAVITY
from soilbus.terra.wheel import (
    MAX_ENTRY_ANGLE,
    MIN_ENTRY_ANGLE,
    Soil,
    WheelModel,
    WheelState,
    sinkage,
    state_on,
    wheel_forces,
)


class ObservationModelWithEffects(ObservationModel):
    """An observation model whose wheel-soil model has effects; `free` are the effects' P parameters.

    Soil, latents and parameters go through the effects' hooks with their derivatives (see terra.dual) in one
    integration.
    """

    def __init__(
        self,
        window: Window,
        rig: Rig,
        model: WheelModel,
        min_speed: float,
        max_turn: float = 0.15,
        effects: Sequence[Effect] = (),
        free: Sequence[Free] = (),
    ) -> None:
        super().__init__(window, rig, model, min_speed, max_turn)
        self._set_effects(effects, free)

    def with_own_stamps(self) -> Self:
        """As `Measurements.with_own_stamps`, with the same effects."""
        return super().with_own_stamps().with_effects(self.effects, self.free)

    def with_effects(self, effects: Sequence[Effect], free: Sequence[Free]) -> Self:
        """The same measurements under a model with these effects alone and their free parameters."""
        other = copy(self)
        other._set_effects(effects, free)
        return other

    def _set_effects(self, effects: Sequence[Effect], free: Sequence[Free]) -> None:
        self.effects, self.free = tuple(effects), tuple(free)
        std = [float(f.std > 0.0) for f in self.free]
        self.gain_names = [*self.gain_names[: self.n_sensors], *(f.name for f in self.free)]
        self.gain_std = np.concatenate([self.sensor_std, std])
        self.gain_bounds = np.array([(-np.inf, np.inf)] * self.n_sensors + [f.bounds for f in self.free]).T

    def active(self, standardised: Array) -> list[Active]:
        """The effects with their values at standardised parameters (P,)."""
        return active_at(self.effects, self.free, standardised, self.n_wheels)

    def _response(self, soil: Soil, gains: Array, latents: Latents) -> Response:
        if not self.effects:
            return super()._response(soil, gains, latents)
        standardised = gains[self.layout.effects]
        active = active_at(self.effects, self.free, standardised, self.n_wheels, derivatives=True)
        varied = Latents(**{name: Dual(value, {name: UNIT}) for name, value in latents._asdict().items()})  # type: ignore[arg-type]
        # the derivative by k_c is that by k_phi over the width
        varied_soil: dict[str, Any] = {name: Dual(getattr(soil, name), {name: UNIT}) for name in Soil._fields[1:]}
        wheels = self._wheels(soil._replace(**varied_soil), active, varied, varied.entry_angle)
        forces = reactions_with(active, forces_along(wheels.state, wheels.model), wheels.state, wheels.surroundings)
        excess, (_, drawbar, torque) = self._excess_load(forces, wheels, active, varied), forces
        for effect, values in active:
            if effect.torque is not None:
                torque = effect.torque(torque, wheels.surroundings, values)
        found = excess, drawbar, torque, wheels.depth
        at, by_latents, by_soil, by_effects = _gathered(found, len(self.free), latents.load.shape)
        np.divide(by_soil[:, 1], self.rig.width, out=by_soil[:, 0])  # both act through K_L = k_c/b + k_phi
        by_load, by_speed, by_ground, by_angle = by_latents.swapaxes(0, 1)
        slope, off = by_angle[0], -at[0]
        by_carried_load = by_angle[1:] / slope  # derivatives by the load through the entry angle

        def held(d: Array) -> Array:
            """Derivatives (3, ..., N, W) with the entry angle following the load."""
            return np.asarray(d[1:] - (by_carried_load[:, None] if d.ndim == 4 else by_carried_load) * d[0])

        value = at[1:] + by_carried_load * off
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
            load_residual=off,
            by_effects=held(by_effects),
        )

    def _wheels(self, soil: Soil, active: Sequence[Active], latents: Latents, angle: Array) -> _Wheels:
        """The wheels at entry angles (N, W) [rad], with the radii and sinkages that the effects give them."""
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        state = state_on(soil, angle, slip, self.rig.radius, self.rig.width, self.rig.length)
        surroundings = self._surroundings(latents)
        state, model = wheel_with(active, state, self.model, surroundings)
        return _Wheels(state, model, sinkage(angle, state.radius), surroundings)

    def _excess_load(self, forces: Forces, wheels: _Wheels, active: Sequence[Active], latents: Latents) -> Any:
        """Load [N] (N, W) that the soil carries in excess of the latent load."""
        excess = forces[0] - latents.load
        for effect, values in active:
            if effect.load is not None:
                excess = excess + effect.load(wheels.surroundings, values)
        return excess

    def extra_pull(self, gains: Array, latents: Latents, noise: Array | None = None) -> tuple[Array, Array]:
        """As `ObservationModel.extra_pull`."""
        if not self.effects:
            return super().extra_pull(gains, latents)
        active = active_at(self.effects, self.free, gains[self.layout.effects], self.n_wheels, derivatives=True)
        around, reading = self._surroundings(latents), self.draft
        if noise is not None:
            mass = 0.0 if self.rig.chassis is None else self.rig.chassis.mass
            quiet = around.acceleration - (mass * self.acceleration_var * noise)[:, None]
            around, reading = around._replace(acceleration=quiet), reading - self.draft_var * noise
        draft, resistance, error = true_draft(active, reading, around), np.zeros(self.n), np.zeros(self.n)
        for effect, values in active:
            if effect.resistance is not None:
                resistance = resistance + effect.resistance(around, values)
            if effect.draft is not None:
                error = error - effect.draft(draft, around, values)
        by_effects, total = np.zeros((len(self.free), self.n)), resistance + error
        for i in range(len(self.free)):
            by_effects[i] = slope_of(total, i)
        return np.stack([np.asarray(value_of(part)) for part in (resistance, error)]), by_effects

    def _surroundings(self, latents: Latents) -> Surroundings:
        """What effects see of latents of every instant, once or twice."""
        chassis, instant = self.rig.chassis, np.arange(len(value_of(latents.load))) % self.n
        return Surroundings(
            t=self.since[instant, None],
            distance=self.distance[instant, None],
            load=latents.load,
            ground_speed=latents.ground_speed[:, None],
            wheel_speed=latents.speed,
            rear=~self.rig.front,
            draft=self.draft[instant, None],
            acceleration=self.acceleration[instant, None],
            mass=0.0 if chassis is None else chassis.mass,
            duration=self.duration,
            length=self.length,
        )

    def delay_terms(self, gains: Array) -> DelayTerms | None:
        """Corrections for measurements y that are late by d: x(t) = y(t + d) = s(t + d) + c (y(t) - s(t)).

        The noise beside the smooth curve s stays with its instant, and c keeps its variance; else some delay would seem
        to fit better.  A low pass delays by its time constant.
        """
        if not any(effect.late for effect in self.effects):
            return None
        places = {(f.effect, f.parameter.name): i for i, f in enumerate(self.free)}
        standardised, moved = gains[self.layout.effects], False
        columns = {"torque": self.n_wheels, "load": self.n_wheels, "ground_speed": 1, "draft": 1, "pitch": 1}
        found = {q: (np.zeros((self.n, n)), np.zeros((len(self.free), self.n, n))) for q, n in columns.items()}
        for effect in self.effects:
            for quantity, names in effect.late.items():
                own = [(i, self.free[i]) for name in names if (i := places.get((effect.name, name))) is not None]
                if all(f.std == 0.0 and f.value == 0.0 for _, f in own):
                    continue
                (added, by), moved = found[quantity], True
                d = sum(f.at(float(standardised[i])) for i, f in own)
                for column, curve in enumerate(self.curves_of(quantity)):
                    added[:, column] += np.nan_to_num(self.shifted(quantity, column, curve, d))
                    slope = np.nan_to_num(curve.at(self.t + d)[1])
                    for i, f in own:
                        by[i, :, column] += f.std * slope
        if not moved:
            return None
        torques, load, ground, draft, pitch = found.values()
        loads, speed = self.layout.loads, self.layout.ground_speed
        measured = np.zeros((self.n, self.layout.n_latents))
        by_measured = np.zeros((len(self.free), *measured.shape))
        measured[:, loads], measured[:, speed] = load[0] * self.usable, ground[0][:, 0]
        by_measured[:, :, loads], by_measured[:, :, speed] = load[1] * self.usable, ground[1][:, :, 0]
        weight = 0.0 if self.rig.chassis is None else self.rig.chassis.mass * GRAVITY * np.cos(self.pitch)[:, None]
        if self._latent_matrix is not None:
            measured, by_measured = measured @ self._latent_matrix.T, by_measured @ self._latent_matrix.T
        rows, by_rows = (
            np.concatenate([self.torque_rows(torque), of_draft + weight * of_pitch], axis=-1)
            for torque, of_draft, of_pitch in zip(torques, draft, pitch, strict=True)
        )
        return DelayTerms(rows, measured, by_rows, by_measured)

    def with_entry_angles(self, latents: Latents, soil: Soil, gains: Array | None = None) -> Latents:
        """Return the latents with the entry angles that carry their loads; gains None: effects at prior values."""
        if not (self.effects and np.isfinite(latents.entry_angle).all()):
            latents = super().with_entry_angles(latents, soil, gains)
        if not self.effects:
            return latents
        active = self.active(np.zeros(len(self.free)) if gains is None else gains[self.layout.effects])
        angle = latents.entry_angle

        def excess(angle: Array) -> Array:
            wheels = self._wheels(soil, active, latents, angle)
            free_of_effects = wheel_forces(wheels.state, wheels.model)
            forces = reactions_with(active, free_of_effects, wheels.state, wheels.surroundings)
            return np.asarray(self._excess_load(forces, wheels, active, latents))

        off = excess(angle)
        with np.errstate(all="ignore"):
            slope = (2.0 * soil.n + 1.0) * latents.load  # by the angle's logarithm, for small angles; then secants
            for _ in range(6):
                step = np.where(slope > 0.0, -off / slope, 0.0)
                before, off_before = angle, off
                angle = np.clip(angle * np.exp(np.clip(step, -0.5, 0.5)), MIN_ENTRY_ANGLE, MAX_ENTRY_ANGLE * 0.98)
                if np.abs(step).max(initial=0.0) < 0.01:
                    break
                off = excess(angle)
                secant = (off - off_before) / np.log(angle / before)  # where not positive the last slope stays
                slope = np.where((secant > 0.0) & np.isfinite(secant), secant, slope)
        return latents._replace(entry_angle=angle)

    def sinkages(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """As `ObservationModel.sinkages`, with the radii that the effects give the wheels."""
        if not self.effects:
            return super().sinkages(soil, gains, latents)
        active = self.active(gains[self.layout.effects])
        return np.broadcast_to(self._wheels(soil, active, latents, latents.entry_angle).depth, latents.load.shape)

    def _wheels_in_contact(
        self, soil: Soil, gains: Array, latents: Latents, instants: NDArray[np.intp]
    ) -> tuple[WheelState, WheelModel]:
        if not self.effects:
            return super()._wheels_in_contact(soil, gains, latents, instants)
        active = self.active(gains[self.layout.effects])
        some = Latents(*[own[instants] for own in latents])
        wheels = self.part(instants)._wheels(soil, active, some, some.entry_angle)
        return wheels.state, wheels.model


class _Wheels(NamedTuple):
    """Wheel states and model after the effects' `wheel` hooks, sinkages [m] (N, W), surroundings."""

    state: WheelState
    model: WheelModel
    depth: Any
    surroundings: Surroundings


def _gathered(predicted: Sequence[Any], n_effects: int, shape: tuple[int, int]) -> tuple[Array, Array, Array, Array]:
    """Values (M, N, W), their derivatives by latents (M, 4, N, W), soil (M, 6, N, W) and parameters (M, P, N, W)."""
    place = {name: i for i, name in enumerate((*Latents._fields, *Soil._fields, *range(n_effects)))}
    at, by = np.zeros((len(predicted), *shape)), np.zeros((len(predicted), len(place), *shape))
    for i, one in enumerate(predicted):
        at[i] = value_of(one)
        for quantity, d in one.by.items() if isinstance(one, Dual) else ():
            by[i, place[quantity]] = d
    by_latents, by_soil, by_effects = np.split(by, [4, 10], axis=1)
    return at, by_latents, by_soil, by_effects
