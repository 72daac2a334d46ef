"""Wheels with effects in steady driving: what the motor must give for which pull, with derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from soilbus.terra.effects.effect import Active, Surroundings, forces_with
from soilbus.terra.stress import Array
from soilbus.terra.wheel import INPUTS, WheelModel, WheelState, wheel_forces_and_derivatives

STEP = 1e-6
"""Relative step of the differences."""
LEAST_STEP = 1e-9


@dataclass(frozen=True, slots=True)
class CompletedModel:
    """A wheel-soil model with effects whose parameters are known, at a ground speed [m/s] that some depend on.

    Of the effects count those that act on wheels of any ground: not on sensors of load and
    draft, not on one wheel alone, and not those that describe the ground of one record.
    """

    model: WheelModel
    effects: tuple[Active, ...] = ()
    ground_speed: float = 1.0

    @classmethod
    def of(cls, model: WheelModel, effects: Sequence[Active], ground_speed: float) -> CompletedModel:
        """With those of the effects that count."""
        kept = [a for a in effects if not (a.effect.of_record or a.effect.each_wheel or a.effect.mixes_instants)]
        acting = [a for a in kept if a.effect.wheel or a.effect.forces or a.effect.torque]
        return cls(model, tuple(acting), ground_speed)

    def forces_and_derivatives(
        self, state: WheelState, rear: Any, load: Array, draft: Array, mass: float
    ) -> tuple[Array, Array]:
        """Load, drawbar pull and the motor's torque at the wheel (3, ...), with derivatives (3, 7, ...) by INPUTS.

        Exact without effects, by differences with them.  rear tells which wheels are on the
        rear axle, load [N] what they carry about, draft [N] and mass [kg] are the vehicle's.
        """
        if not self.effects:
            return wheel_forces_and_derivatives(state, self.model)
        at = self._forces(state, rear, load, draft, mass)
        d = np.empty((3, len(INPUTS), *at.shape[1:]))
        for i, name in enumerate(INPUTS):
            value = getattr(state, name)
            step = STEP * np.maximum(np.abs(value), LEAST_STEP / STEP)
            d[:, i] = (self._forces(state._replace(**{name: value + step}), rear, load, draft, mass) - at) / step
        return at, d

    def _forces(self, state: WheelState, rear: Any, load: Array, draft: Array, mass: float) -> Array:
        speed = self.ground_speed / (state.radius * (1.0 - state.slip))
        now = np.zeros((1, 1))
        around = Surroundings(now, now, load, self.ground_speed, speed, rear, draft, now, mass, 0.0)
        forces = forces_with(self.effects, state, self.model, around)
        for effect, values in self.effects:
            if effect.torque is not None:
                forces = np.stack([*forces[:2], effect.torque(forces[2], around, values)])
        return forces
