"""The reference tractor in balance by brute force: nested scipy root finding, moments written out."""

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


def brute_with_rolling(soil: Soil, slip: float, rolling: str) -> tuple[float, dict[str, np.ndarray]]:
    """Level pull [N] where the wheels of one axle ("front", "rear") take no torque and the others slip.

    And by axle the (load, pull, torque, entry angle, slip) of one wheel.
    """
    sizes = {"front": (0.50, 0.26), "rear": (0.62, 0.38)}

    def of_axle(name: str, load: float) -> np.ndarray:
        def torque(s: float) -> float:
            return float(wheel(soil, load, s, *sizes[name])[2])

        s = brentq(torque, -0.6, 0.3, xtol=1e-8) if name == rolling else slip
        return np.append(wheel(soil, load, s, *sizes[name]), s)

    def axles_at(pull: float) -> dict[str, np.ndarray]:
        front = (WEIGHT * 0.95 - pull * 0.45) / 1.95
        return {"front": of_axle("front", front / 2.0), "rear": of_axle("rear", (WEIGHT - front) / 2.0)}

    def left(pull: float) -> float:
        return 2.0 * sum(float(of[1]) for of in axles_at(pull).values()) - pull

    pull = float(brentq(left, -0.75 * WEIGHT, 0.6 * WEIGHT, xtol=1.0))
    return pull, axles_at(pull)
