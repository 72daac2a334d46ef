"""Standing parts of every model: what a machine in motion adds to steady wheel forces, and how late its sensors are.

    slip       s + (L / V) ds/dt = 1 - V / (r omega)             relaxation length L of tyre and soil, so by L
               omega + L (omega dV/dt / V - domega/dt) / V
    torque     T = T_soil + J domega/dt                          inertia J of a wheel
    channel    y(t) = x(t - d),   x = y + d dy/dt                d: lateness beside torque and wheel speed

Each parameter is one more gain with a prior of mean 0, linearised at 0, as L / V and d are short beside a second.
Relaxation: Pacejka, Tire and Vehicle Dynamics (3rd ed. 2012), ch. 7.  Lateness: Ljung, System Identification (1999).
"""

from __future__ import annotations

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.instrumentation import rows_in
from soilbus.estimation.window import Rig, Window

__all__ = ["SLOPES", "STANDING", "standing_columns", "standing_std", "wheel_inertia"]

STANDING = (
    "relaxation_length", "wheel_inertia", "lateness.load", "lateness.ground_speed", "lateness.draft",
    "lateness.acceleration",
)  # fmt: skip
"""Names of the parameters, in order: [m], [1: in `wheel_inertia` units], [s]."""
SLOPES = ("speed", "load", "ground_speed", "draft", "acceleration")
"""Quantities whose slopes by time these parts need."""


def standing_std(rig: Rig) -> list[float]:
    """Return the prior sd of each of STANDING; 0, held, for a test rig, whose rows are no motion."""
    given = rig.options.standing
    if rig.chassis is None:
        return [0.0] * len(STANDING)
    return [given.relaxation_length, given.wheel_inertia, given.load, given.ground_speed, given.draft, given.load]


def wheel_inertia(rig: Rig) -> Array:
    """Return the usual inertia (W,) [kg m^2] of each wheel: a disc of 3 % of the vehicle's mass."""
    mass = 0.0 if rig.chassis is None else rig.chassis.mass
    return np.asarray(rig.options.standing.wheel_mass_share * mass * rig.radius**2 / 2.0)


def standing_columns(window: Window, rig: Rig, slopes: Array | None = None) -> tuple[Array, Array]:
    """Return the derivatives by STANDING (S) at every bin of a completed window; 0 where a slope is not known.

    They are of the wheels' torques and the demand (N, W + 1, S), and of loads, speeds and ground speed (N, 2 W + 1, S).
    slopes (N, 2 W + 3): by time, of the columns of SLOPES; by default the differences of neighbouring bins.
    """
    N, W, S = len(window.t), len(rig.wheels), len(STANDING)
    rows, latents = np.zeros((N, W + 1, S)), np.zeros((N, 2 * W + 1, S))
    if N < 3 or rig.chassis is None:
        return rows, latents
    with np.errstate(invalid="ignore", divide="ignore"):
        if slopes is None:
            slopes = np.gradient(np.column_stack([getattr(window, q) for q in SLOPES]), window.t, axis=0)
        slopes = np.where(np.isfinite(slopes), slopes, 0.0)
        speed, forward = slopes[:, :W], window.ground_speed[:, None]
        ground, draft, acceleration = slopes[:, 2 * W :].T
        relaxed = (window.speed / forward * ground[:, None] - speed) / forward
    latents[:, W : 2 * W, 0] = np.where(np.isfinite(relaxed) & rig.drives, relaxed, 0.0)
    rows[:, :W, 1] = -wheel_inertia(rig) * speed
    if all(row.kind == "channel" for row in rows_in(rig, "load")):
        latents[:, :W, 2] = slopes[:, W : 2 * W]
    latents[:, 2 * W, 3], rows[:, W, 4], rows[:, W, 5] = ground, draft, rig.chassis.mass * acceleration
    return rows, latents
