"""How a wheel's forces change with all that effects may change about it, to first order."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from soilbus.terra.stress import Array
from soilbus.terra.wheel import INPUTS, wheel_forces_and_derivatives
from soilbus.terra.wheel_state import WheelModel, WheelState

_FAINT = 1e-9
"""Stiffness of a pan that is none, but that is integrated as any pan is."""
_SHAPES = {
    "peak": ("peak_c1", "peak_c2"),
    "leave": ("exit_ratio", "exit_angle"),
    "exponential_share": ("exponential_share",),
    "pan_stiffness": ("pan_stiffness",),
    "pan_depth": ("pan_depth",),
}
"""Fields of a model on which each of SHAPE depends."""


@dataclass(frozen=True, slots=True)
class Tangent:
    """Wheels with forces (3, ...) and their derivatives (3, ...) by name: INPUTS, radius and some of SHAPE."""

    state: WheelState
    model: WheelModel
    forces: Array
    by: dict[str, Array]

    def at(self, state: WheelState, model: WheelModel) -> Array:
        """Forces (3, ...) of wheels as wide that are a small step away.

        KeyError where the model differs in what was not asked for, ValueError in what has no derivative.
        """
        forces = self.forces.copy()
        for name in (*INPUTS, "radius"):
            _add(forces, self.by[name], getattr(state, name), getattr(self.state, name))
        if model != self.model:
            for name, change in _changes(self.model, model, self.state).items():
                forces += self.by[name] * change
        return forces


def tangent(state: WheelState, model: WheelModel, shape: frozenset[str] = frozenset()) -> Tangent:
    """Forces with derivatives by INPUTS and these of SHAPE, by the radius and, where there is a pan, by its depth."""
    integrated = model
    if model.pan_stiffness or "pan_stiffness" in shape:
        shape |= {"pan_depth"}
        integrated = model if model.pan_stiffness else replace(model, pan_stiffness=_FAINT)
    asked = sorted(shape)
    forces, columns = wheel_forces_and_derivatives(state, integrated, asked)
    by = {name: columns[:, i] for i, name in enumerate((*INPUTS, *asked))}
    return Tangent(state, model, forces, by | {"radius": _by_radius(state, model, forces, by)})


def _by_radius(state: WheelState, model: WheelModel, forces: Array, by: dict[str, Array]) -> Array:
    """From the dimensions of all else: what is measured in lengths of the wheel's own does not change (homogeneity)."""
    lengths = state.n * state.K_L * by["K_L"] - state.K * by["K"]
    lengths += forces
    lengths[2] += forces[2]
    if "pan_depth" in by:
        lengths -= model.pan_depth * by["pan_depth"]
    return np.asarray(lengths / state.radius)


def shape_of_change(one: WheelModel, other: WheelModel) -> frozenset[str]:
    """Which of SHAPE differ between two models; ValueError where something else does."""
    unlike = {f.name for f in fields(one) if getattr(one, f.name) != getattr(other, f.name)} - {"one_off"}
    found = frozenset(name for name, of in _SHAPES.items() if unlike & set(of))
    rest = unlike - {field for name in found for field in _SHAPES[name]}
    if rest:
        raise ValueError(f"no derivatives by {', '.join(sorted(rest))}")
    return found


def _changes(one: WheelModel, other: WheelModel, state: WheelState) -> dict[str, Any]:
    """By how much each of SHAPE changes from one model to another."""
    out: dict[str, Any] = {}
    for name in shape_of_change(one, other):
        if name == "peak":
            out[name] = other.peak_c1 - one.peak_c1 + (other.peak_c2 - one.peak_c2) * state.slip
        elif name == "leave":
            out[name] = other.leave(state.entry_angle) - one.leave(state.entry_angle)
        else:
            out[name] = getattr(other, name) - getattr(one, name)
    return out


def _add(forces: Array, by: Array, value: Any, here: Any) -> None:
    if value is not here and np.any(value != here):
        forces += by * (value - here)
