"""One wheel on a soil: from load, or sinkage, and slip to drawbar pull and torque."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import MAX_ENTRY_ANGLE, Soil, WheelModel, state_on
from soilbus.terra.wheel import sinkage as sinkage_of
from soilbus.terra.wheel import wheel_forces as forces_of_state

__all__ = ["WheelForces", "wheel_forces"]


@dataclass(frozen=True, slots=True)
class WheelForces:
    """Forces and place of a wheel; floats, or arrays of the shape that the inputs broadcast to.

    Attributes
    ----------
    load
        W [N].
    drawbar_pull
        DP [N], positive where the wheel pulls.
    torque
        T [N m] about the axle.
    entry_angle
        theta_1 [rad] from the vertical.
    sinkage
        z [m].
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
) -> WheelForces:
    """Drawbar pull, torque and sinkage of a wheel that carries a load at a slip.

    Parameters
    ----------
    soil
        A soil, or the name of a known one (`soilbus.soil_named`).
    load
        W [N]; None where the sinkage is given.
    slip
        1 - V/(r omega); negative where the wheel brakes.
    radius, width
        r and b [m].
    sinkage
        z [m] in place of the load.
    model
        Shear law, "exponential" (Janosi & Hanamoto) or "rational" (Xi et al. 2024), or all choices of the wheel-soil
        model.

    Returns
    -------
    WheelForces
        Inputs broadcast against each other. All is nan where the soil does not carry the load (the wheel is buried).

    Raises
    ------
    ValueError
        No such soil or shear law; load and sinkage both given, or neither; a radius or width that is not above 0; a
        slip above 1; a sinkage that no wheel of this radius rolls at.

    Examples
    --------
    >>> import soilbus
    >>> at = soilbus.wheel_forces("loam", 6000.0, [0.1, 0.2, 0.3], radius=0.5, width=0.3)
    >>> at.drawbar_pull.round()  # N
    array([ 215.,  734., 1063.])
    >>> (1e3 * at.sinkage).round()  # mm
    array([45., 45., 44.])

    The other way round, from a measured sinkage to the load:

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
    if sinkage is None:
        guess = state_on(soil, np.nan, slip, radius, width)
        angle = entry_angle_for_load(load, guess, model)
    else:
        angle = _entry_angle(np.asarray(sinkage, float), radius)
    forces = forces_of_state(state_on(soil, angle, slip, radius, width), model)
    shape = np.broadcast_shapes(np.shape(angle), forces.shape[1:])
    angle = np.broadcast_to(angle, shape)
    return WheelForces(*(_plain(a) for a in (*forces, angle, sinkage_of(angle, radius))))


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


def _plain(values: Any) -> Any:
    """A float of an array without dimensions."""
    return values if np.ndim(values) else float(values)
