"""Forces of a wheel together with their derivatives by all that its state and its contact's shape depend on."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.dual import Dual, value_of
from soilbus.terra.wheel import INPUTS, wheel_forces_and_derivatives
from soilbus.terra.wheel_state import WheelModel, WheelState

_FAINT = 1e-9
"""Stiffness of a pan that is none, but that is integrated as any pan is."""
_SHAPES = {
    "peak": ("peak_c1", "peak_c2", "peak_bend"),
    "leave": ("exit_ratio", "exit_angle", "exit_slip"),
    "exponential_share": ("exponential_share",),
    "pan_stiffness": ("pan_stiffness",),
    "pan_depth": ("pan_depth",),
}
"""Fields of a model on which each of SHAPE depends."""


def forces_along(state: WheelState, model: WheelModel) -> tuple[Dual, Dual, Dual]:
    """Return load [N], drawbar pull [N] and torque [N m] with the derivatives that state and model carry.

    ValueError where a field carries derivatives that none by the forces are known for.
    """
    here = WheelState(*(value_of(a) for a in state))
    varied = {f.name: value for f in fields(model) if isinstance(value := getattr(model, f.name), Dual)}
    there = replace(model, **{name: field.value for name, field in varied.items()}) if varied else model
    shape = {name for name, of in _SHAPES.items() if not varied.keys().isdisjoint(of)}
    if unknown := varied.keys() - {field for name in shape for field in _SHAPES[name]}:
        raise ValueError(f"no derivatives by {', '.join(sorted(unknown))}")
    if isinstance(state.width, Dual) or isinstance(state.length, Dual):
        raise ValueError("no derivatives by width and length")
    forces, by = _derivatives(here, there, shape, of_radius=isinstance(state.radius, Dual))
    changes = {name: getattr(state, name) for name in (*INPUTS, "radius")}
    if "peak" in shape:
        changes["peak"] = model.peak(here.slip)
    if "leave" in shape:
        changes["leave"] = model.leave(here.entry_angle, here.slip)
    changes |= {name: field for name, field in varied.items() if name in shape}
    slopes: dict[object, Array] = {}
    for name, change in changes.items():
        for quantity, d in change.by.items() if isinstance(change, Dual) else ():
            part = by[name] * d
            slopes[quantity] = slopes[quantity] + part if quantity in slopes else part
    load, pull, torque = (Dual(forces[i], {q: d[i] for q, d in slopes.items()}) for i in range(3))
    return load, pull, torque


def _derivatives(
    state: WheelState, model: WheelModel, shape: set[str], of_radius: bool
) -> tuple[Array, dict[str, Array]]:
    """Forces (3, ...) and their derivatives (3, ...) by INPUTS, these of SHAPE and, where asked for, the radius."""
    integrated = model
    asked = shape | {"pan_depth"} if of_radius and (model.pan_stiffness or "pan_stiffness" in shape) else shape
    if of_radius and np.any(state.length):
        asked = asked | {"length"}
    if "pan_stiffness" in shape and not model.pan_stiffness:
        integrated = replace(model, pan_stiffness=_FAINT)
    names = sorted(asked)
    forces, columns = wheel_forces_and_derivatives(state, integrated, names)
    by = {name: columns[:, i] for i, name in enumerate((*INPUTS, *names))}
    if of_radius:
        by["radius"] = _by_radius(state, model, forces, by)
    return forces, by


def _by_radius(state: WheelState, model: WheelModel, forces: Array, by: dict[str, Array]) -> Array:
    """From the dimensions of all else: what is measured in lengths of the wheel's own does not change (homogeneity)."""
    lengths = state.n * state.K_L * by["K_L"] - state.K * by["K"]
    lengths += forces
    lengths[2] += forces[2]
    if "pan_depth" in by:
        lengths -= model.pan_depth * by["pan_depth"]
    if "length" in by:
        lengths -= state.length * by["length"]
    return np.asarray(lengths / state.radius)
