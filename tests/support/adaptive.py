"""One wheel's forces by adaptive integration of the paper's equations, independent of the package's quadrature."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

from soilbus.terra.wheel import WheelModel, WheelState

EXACT = {"epsabs": 0.0, "epsrel": 1e-11, "limit": 200}


def exponential(x: float) -> float:
    return 1.0 - math.exp(-x)


def rational(x: float) -> float:
    return x / (x + 1.0)


def adaptive_forces(
    state: WheelState,
    model: WheelModel,
    pressure: Callable[[float], float] | None = None,
    mobilised: Callable[[float], float] | None = None,
    kink: float = math.inf,
) -> np.ndarray:
    """W, DP and T of one wheel by scipy.integrate.quad, equation by equation (numbers of Xi et al. 2024).

    Of the model only the angles and the shear law are read.  pressure [Pa] at a depth [m]
    stands in for Bekker's, with a kink at a depth [m]; mobilised, the share of the shear
    strength at j/K >= 0, for the shear law.
    """
    theta1, slip, r, b, K_L, n, tan_phi, c, K = (float(v) for v in state[:9])
    ahead = model.peak_c1 + model.peak_c2 * slip / (
        1.0 - (1.0 - abs(slip)) * model.peak_bend / (1.0 + model.peak_bend)
    )  # eq. 4 without a bend
    theta_m = min(max(ahead, 0.05), 0.8) * theta1
    theta2 = max((model.exit_ratio + model.exit_slip * max(slip, 0.0)) * theta1 + model.exit_angle, -0.95 * theta1)
    share = mobilised or (exponential if model.shear_law == "exponential" else rational)

    def sigma(theta: float) -> float:
        """Eqs. 7 and 8, with the bracket that eq. 8 has lost (notes.md)."""
        front = theta if theta >= theta_m else theta1 - (theta - theta2) / (theta_m - theta2) * (theta1 - theta_m)
        # cos(front) - cos(theta1), without cancellation
        z = 2.0 * r * math.sin((theta1 + front) / 2.0) * math.sin((theta1 - front) / 2.0)
        return K_L * max(z, 0.0) ** n if pressure is None else pressure(max(z, 0.0))

    def displacement(theta: float) -> float:
        """Eqs. 15 and 16: the integral of the rim's slip velocity."""
        return r * ((theta1 - theta) - (1.0 - slip) * (math.sin(theta1) - math.sin(theta)))

    def tau(theta: float) -> float:
        """Eqs. 11 and 12; in skid the shear acts the other way."""
        x = displacement(theta) / K
        return math.copysign((c + sigma(theta) * tan_phi) * share(abs(x)), x)

    # Each end of each part gets sixth-power nodes: sigma may start as z**0.1 there.
    splits = {theta2, theta_m, theta1}
    if kink < r * (math.cos(theta_m) - math.cos(theta1)):
        front = math.acos(math.cos(theta1) + kink / r)
        splits |= {front, theta2 + (theta1 - front) / (theta1 - theta_m) * (theta_m - theta2)}
    grid = np.linspace(theta2, theta1, 400)[:-1]
    values = [displacement(theta) for theta in grid]
    for i in range(len(grid) - 1):
        if values[i] * values[i + 1] < 0.0:
            splits.add(brentq(displacement, grid[i], grid[i + 1], xtol=1e-15))

    def integral(f: Callable[[float], float]) -> float:
        total = 0.0
        for low, high in pairwise(sorted(splits)):
            half = (high - low) / 2.0
            for end, way in ((low, half), (high, -half)):
                total += half * quad(lambda u: f(end + way * u**6) * 6.0 * u**5, 0.0, 1.0, **EXACT)[0]  # noqa: B023
        return total

    W = r * b * integral(lambda t: sigma(t) * math.cos(t) + tau(t) * math.sin(t))  # eq. 20
    DP = r * b * integral(lambda t: tau(t) * math.cos(t) - sigma(t) * math.sin(t))  # eq. 21
    T = r * r * b * integral(tau)  # eq. 22
    return np.array([W, DP, T])
