"""Wheels with effects in steady driving: what the motor must give for which pull, with derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.effects.effect import Active, Surroundings, forces_with, wheel_with
from soilbus.terra.wheel import WheelModel, WheelState, sinkage, wheel_forces, wheel_forces_and_slopes

STEP = 1e-6
"""Relative step of the differences."""
LEAST_STEP = 1e-9
ROUNDS = 12
"""Fixed-point rounds from a sinkage to an entry angle."""


class Wheel(NamedTuple):
    """Radius and width [m], whether on the rear axle, and load [N]; arrays that broadcast."""

    radius: Array
    width: Array
    rear: Any
    load: Array


class Slopes(NamedTuple):
    """Derivatives (3, ...) of load, pull and torque by entry angle, by slip, and by the load that effects go by."""

    by_angle: Array
    by_slip: Array
    by_load: Array


@dataclass(frozen=True, slots=True)
class CompletedModel:
    """Wheel-soil model with effects whose parameters are known, at a ground speed [m/s].

    Of the effects count those that act on wheels of any ground: not on sensors of load and
    draft, not on one wheel alone, and not those that describe the ground of one record.
    """

    model: WheelModel
    effects: tuple[Active, ...] = ()
    ground_speed: float = 1.0

    @classmethod
    def of(cls, model: WheelModel, effects: Sequence[Active], ground_speed: float) -> CompletedModel:
        """Return the model with those effects that act on steady forces."""
        kept = [a for a in effects if not (a.effect.of_record or a.effect.each_wheel or a.effect.late)]
        acting = [a for a in kept if a.effect.wheel or a.effect.forces or a.effect.torque]
        return cls(model, tuple(acting), ground_speed)

    @classmethod
    def over(cls, model: WheelModel | CompletedModel) -> CompletedModel:
        """Return a wheel-soil model as one without effects, and a completed one unchanged."""
        return model if isinstance(model, CompletedModel) else cls(model)

    def forces(self, state: WheelState, rear: Any, load: Array) -> Array:
        """Return the load, drawbar pull and the motor's torque at the wheel (3, ...).

        rear says which wheels are on the rear axle, load [N] what they carry.
        """
        if not self.effects:
            return wheel_forces(state, self.model)
        around = self._around(state, rear, load)
        forces = forces_with(self.effects, state, self.model, around)
        for effect, values in self.effects:
            if effect.torque is not None:
                forces = np.stack([*forces[:2], effect.torque(forces[2], around, values)])
        return forces

    def forces_and_slopes(self, state: WheelState, rear: Any, load: Array) -> tuple[Array, Slopes]:
        """Return `forces` with derivatives: exact without effects, by differences with them."""
        if not self.effects:
            forces, by = wheel_forces_and_slopes(state, self.model)
            return forces, Slopes(by[:, 0], by[:, 1], np.zeros_like(forces))
        at, more = self.forces(state, rear, load), STEP * np.maximum(load, 1.0)
        angle, slip = _step(state.entry_angle), _step(state.slip)
        return at, Slopes(
            (self.forces(state._replace(entry_angle=state.entry_angle + angle), rear, load) - at) / angle,
            (self.forces(state._replace(slip=state.slip + slip), rear, load) - at) / slip,
            (self.forces(state, rear, load + more) - at) / more,
        )

    def sinkage(self, angle: Array, wheel: Wheel) -> Array:
        """Return the sinkage [m] at an entry angle [rad]: of the circle that effects make of the wheel."""
        if not self.effects:
            return np.asarray(sinkage(angle, wheel.radius))
        state = WheelState(angle, 0.0, wheel.radius, wheel.width, 1.0, 1.0, 1.0, 1.0, 1.0)  # on any soil
        now, _ = wheel_with(self.effects, state, self.model, self._around(state, wheel.rear, wheel.load))
        return np.asarray(sinkage(angle, now.radius))

    def angle_of_sinkage(self, depth: float, wheel: Wheel) -> Array:
        """Return the entry angle [rad] at which a wheel has sunk so deep [m], a right angle at most."""
        angle = np.arccos(1.0 - np.minimum(depth / wheel.radius, 1.0))
        for _ in range(ROUNDS if self.effects and depth > 0.0 else 0):
            circle = self.sinkage(angle, wheel) / sinkage(angle, 1.0)
            angle = np.arccos(1.0 - np.minimum(depth / circle, 1.0))
        return np.asarray(angle)

    def _around(self, state: WheelState, rear: Any, load: Array) -> Surroundings:
        """Steady driving; draft and mass act on a wheel by its load alone."""
        speed = self.ground_speed / (state.radius * (1.0 - state.slip))
        now = np.zeros((1, 1))
        return Surroundings(now, now, load, self.ground_speed, speed, rear, np.nan, now, np.nan, 0.0)


def _step(value: Any) -> Any:
    return np.maximum(STEP * np.abs(value), LEAST_STEP)
