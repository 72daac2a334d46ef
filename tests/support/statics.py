"""The reference tractor in balance by brute force: nested root finding, moments written out."""

import math

import numpy as np
from scipy.optimize import brentq

from soilbus.terra.wheel import Soil, WheelModel, state_on, wheel_forces

MODEL = WheelModel()
WEIGHT = 2300.0 * 9.80665
WHEELS = [0, 0, 1, 1]
"""Column of each wheel in the forces of the two axles."""
LIMITS = math.log(1e-4), math.log(1.39)
"""Of the logarithm of an entry angle [rad]."""


def wheels(soil: Soil, load: np.ndarray, slip: float, radius: np.ndarray, width: np.ndarray) -> np.ndarray:
    """(load, pull, torque, entry angle) of wheels (4, N) that carry loads (N,), by a secant in logarithms."""
    power = 2.0 * soil.n + 1.0  # of the angle, with which the load of Bekker's rigid wheel grows
    stiffness = (3.0 - soil.n) * width * (soil.k_c / width + soil.k_phi) * np.sqrt(2.0 * radius)
    depth = (3.0 * load / stiffness) ** (2.0 / power)
    now = np.clip(np.log(np.arccos(np.clip(1.0 - depth / radius, 0.2, 1.0))), *LIMITS)
    before, step = np.full(len(load), np.nan), np.zeros(len(load))
    for _ in range(60):
        found = wheel_forces(state_on(soil, np.exp(now), slip, radius, width), MODEL)
        off = np.log(np.maximum(found[0], 1e-3 * load) / load)
        if np.abs(off).max() < 1e-12:
            return np.vstack([found, np.exp(now)])
        rise = np.divide(off - before, step, out=np.full(len(load), power), where=np.isfinite(before) & (step != 0.0))
        wanted = np.clip(now - off / np.where(rise > 0.1 * power, rise, power), *LIMITS)
        now, step, before = wanted, wanted - now, off
    raise ValueError(f"no entry angle carries {load} N on {soil}")


def wheel(soil: Soil, load: float, slip: float, radius: float, width: float) -> np.ndarray:
    """(load, pull, torque, entry angle) of one wheel that carries a load."""
    return wheels(soil, np.array([load]), slip, np.array([radius]), np.array([width]))[:, 0]


def axles(soil: Soil, slip: float, draft: float, sine: float) -> np.ndarray:
    """(4, axle) forces and entry angle of one front and one rear wheel."""
    across = WEIGHT * np.sqrt(1.0 - sine**2)
    front = (across * 0.95 - WEIGHT * sine * 0.75 - draft * 0.45) / 1.95
    return wheels(soil, np.array([front, across - front]) / 2.0, slip, np.array([0.50, 0.62]), np.array([0.26, 0.38]))


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
