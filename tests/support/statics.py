"""The reference tractor in balance by brute force: nested scipy root finding, moments written out."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from soilbus.terra.wheel import Soil, WheelModel, state_on, wheel_forces

MODEL = WheelModel()
WEIGHT = 2300.0 * 9.80665
WHEELS = [0, 0, 1, 1]
"""Column of each wheel in the forces of the two axles."""


def wheel(soil: Soil, load: float, slip: float, radius: float, width: float) -> np.ndarray:
    """(load, pull, torque, entry angle) of one wheel that carries a load."""

    def excess(angle: float) -> float:
        return float(wheel_forces(state_on(soil, angle, slip, radius, width), MODEL)[0] - load)

    angle = brentq(excess, 1e-4, 1.39, xtol=1e-10)
    return np.append(wheel_forces(state_on(soil, angle, slip, radius, width), MODEL), angle)


def axles(soil: Soil, slip: float, draft: float, sine: float) -> np.ndarray:
    """(4, axle) forces and entry angle of one front and one rear wheel."""
    across = WEIGHT * np.sqrt(1.0 - sine**2)
    front = (across * 0.95 - WEIGHT * sine * 0.75 - draft * 0.45) / 1.95
    rear = across - front
    return np.stack([wheel(soil, front / 2, slip, 0.50, 0.26), wheel(soil, rear / 2, slip, 0.62, 0.38)], axis=1)


def brute(soil: Soil, slip: float, draft: float | None = None, sine: float | None = 0.0) -> tuple[float, np.ndarray]:
    """Pull at which draft, slope and wheels balance, and forces of the axles; the duty that is None takes the rest."""

    def split(pull: float) -> tuple[float, float]:
        if draft is not None:
            return draft, (pull - draft) / WEIGHT
        assert sine is not None
        return pull - WEIGHT * sine, sine

    least = (draft or 0.0) - 0.75 * WEIGHT
    pull = brentq(lambda p: 2.0 * axles(soil, slip, *split(p))[1].sum() - p, least, 0.6 * WEIGHT, xtol=1e-3)
    return pull, axles(soil, slip, *split(pull))
