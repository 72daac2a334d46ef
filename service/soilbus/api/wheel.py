"""One wheel on a soil: from load, or sinkage, and slip to drawbar pull and torque."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active
from soilbus.terra.effects.steady import CompletedModel, Wheel
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import MAX_ENTRY_ANGLE, MIN_ENTRY_ANGLE, Soil, WheelModel, WheelState, state_on
from soilbus.words import did_you_mean

__all__ = ["WheelForces", "wheel_forces"]

TOLERANCE = 1e-9
"""Relative error of the load that ends the search for an entry angle with effects: below any sensor's noise."""
MAX_STEPS = 60
"""Steps of that search; 3 to 10 are usual."""
NOT_ALONE = frozenset({"multipass", "inertia"})
"""Effects that need a wheel ahead, or an acceleration."""


@dataclass(frozen=True, slots=True)
class WheelForces:
    """Load W [N], drawbar pull [N], torque [N m], entry angle [rad] from the vertical and sinkage [m] of a wheel.

    Floats, or arrays of the shape that the inputs broadcast to.
    """

    load: Any
    drawbar_pull: Any
    torque: Any
    entry_angle: Any
    sinkage: Any


def wheel_forces(
    soil: Soil | str,
    load: Any,
    slip: Any,
    *,
    radius: Any,
    width: Any,
    sinkage: Any = None,
    model: WheelModel | str = "exponential",
    effects: Mapping[str, float] | None = None,
) -> WheelForces:
    """Return drawbar pull, torque and sinkage of a wheel that carries a load at a slip.

    Parameters
    ----------
    soil
        A soil, or the name of a known one (`soilbus.soil_named`).
    load
        W [N]; None where the sinkage is given.
    slip
        1 - V/(r omega); negative where the wheel brakes.
    radius, width, sinkage
        r, b and, in place of the load, z [m].
    model
        Shear law, "exponential" (Janosi & Hanamoto) or "rational" (Xi et al. 2024), or a whole wheel-soil model.
    effects
        Values of effects (docs/effects.md) that act on a single wheel, steadily at 1 m/s: {"slip_sinkage": 0.4,
        "hardpan.depth": 0.05}; a name alone is the effect's first parameter.

    Returns
    -------
    WheelForces
        Inputs broadcast against each other. All is nan where the soil does not carry the load (the wheel is buried).

    Raises
    ------
    ValueError
        No such soil, shear law or effect, not one of load and sinkage, or a value that no wheel has.

    Examples
    --------
    >>> import soilbus
    >>> at = soilbus.wheel_forces("loam", 6000.0, [0.1, 0.2, 0.3], radius=0.5, width=0.3)
    >>> at.drawbar_pull.round(), (1e3 * at.sinkage).round()  # N, mm
    (array([ 215.,  734., 1063.]), array([45., 45., 44.]))
    >>> round(soilbus.wheel_forces("loam", None, 0.2, radius=0.5, width=0.3, sinkage=0.05).load)
    6860
    """
    soil = _soil(soil)
    model = _model(model)
    radius, width, slip = (np.asarray(a, float) for a in (radius, width, slip))
    for name, value in (("radius", radius), ("width", width)):
        if not np.all(value > 0.0):
            raise ValueError(f"{name} must be above 0 m")
    if np.any(slip > 1.0):
        raise ValueError(f"a slip of {np.max(slip):g} is above 1: is it in per cent?")
    if (load is None) == (sinkage is None):
        raise ValueError("give either the load or the sinkage, and None for the other")
    if load is not None and np.any(np.asarray(load, float) < 0.0):
        raise ValueError(f"a load of {np.min(load):g} N is below 0: it counts downwards")
    completed = CompletedModel.of(model, active := _active(effects or {}), ground_speed=1.0)
    if active and sinkage is not None:
        raise ValueError("effects need the load: leave out the sinkage")
    guess = state_on(soil, np.nan, slip, radius, width)
    if sinkage is not None:
        state = guess._replace(entry_angle=_entry_angle(np.asarray(sinkage, float), radius))
    else:
        load = np.asarray(load, float)
        state = guess._replace(entry_angle=entry_angle_for_load(load, guess, model))
        if active:
            state = _carrying(load, state, completed)
    wheel = Wheel(radius, width, False, np.asarray(np.nan if load is None else load, float))
    forces = completed.forces(state, False, wheel.load)
    angle = np.broadcast_to(state.entry_angle, forces.shape[1:])
    found = (*forces, angle, completed.sinkage(angle, wheel))
    return WheelForces(*(values if np.ndim(values) else float(values) for values in found))


def _active(effects: Mapping[str, float]) -> list[Active]:
    """The effects with all their parameters; ValueError for a name that the catalogue does not have."""
    values: dict[str, dict[str, float]] = {}
    for key, value in effects.items():
        name, _, parameter = key.partition(".")
        if name not in CATALOGUE:
            raise ValueError(f"no effect is named {name}{did_you_mean(name, CATALOGUE)}")
        known = CATALOGUE[name].neutral
        parameter = parameter or next(iter(known))
        if parameter not in known:
            raise ValueError(f"{name} has no parameter {parameter}; known: {', '.join(known)}")
        values.setdefault(name, known)[parameter] = value
    active = [Active(effect, values[name]) for name, effect in CATALOGUE.items() if name in values]
    acting = CompletedModel.of(WheelModel(), active, 1.0).effects
    for one in active:
        if one not in acting or one.effect.name in NOT_ALONE:
            raise ValueError(f"{one.effect.name} does not act on a single wheel that drives steadily")
    return active


def _carrying(load: Any, state: WheelState, model: CompletedModel) -> WheelState:
    """The state at whose entry angle a wheel with effects carries the load [N]; nan where none does.

    Newton's method on logarithms from the entry angle without effects, in which the load is nearly straight.
    """
    load, angle = np.broadcast_arrays(load, np.asarray(state.entry_angle))
    for _ in range(MAX_STEPS):
        forces, by = model.forces_and_slopes(state._replace(entry_angle=angle), False, load)
        with np.errstate(invalid="ignore", divide="ignore"):
            miss = np.log(forces[0] / load)
            step = miss * forces[0] / (by.by_angle[0] * angle)
        if not np.any(np.abs(miss) > TOLERANCE):
            break
        angle = np.clip(angle * np.exp(-np.clip(step, -0.5, 0.5)), MIN_ENTRY_ANGLE, MAX_ENTRY_ANGLE)
    return state._replace(entry_angle=np.where(np.abs(miss) <= TOLERANCE, angle, np.nan))


def _soil(soil: Soil | str) -> Soil:
    if isinstance(soil, Soil):
        return soil
    try:
        return soil_named(soil)
    except KeyError as error:
        raise ValueError(error.args[0]) from None


def _model(model: WheelModel | str) -> WheelModel:
    if isinstance(model, WheelModel):
        return model
    if model not in ("exponential", "rational"):
        raise ValueError(f"no shear law is named {model}; known: exponential, rational")
    return WheelModel(shear_law=model)


def _entry_angle(sinkage: Any, radius: Any) -> Any:
    """Entry angle [rad] of a sinkage [m]: acos(1 - z/r) (eq. 1 of Xi et al. 2024)."""
    deepest = 1.0 - np.cos(MAX_ENTRY_ANGLE)
    if np.any((sinkage <= 0.0) | (sinkage >= radius * deepest)):
        raise ValueError(f"the sinkage must be above 0 and below {deepest:.2f} of the radius")
    return np.arccos(1.0 - sinkage / radius)
