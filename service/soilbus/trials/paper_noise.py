"""What sensor noise does to the paper's one operating point, at the least.

cov(K_L, phi, n) = J^-1 cov(W, DP, T) J^-T    (Cramer-Rao: three equations, three unknowns)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.report.table import table
from soilbus.trials.paper import EXACT, SIMPSON, Equations, OperatingPoint, Unknowns, WheelEquations
from soilbus.trials.paper_tables import SANDY_LOAM, WET_CLAY

__all__ = ["LEVELS", "K_L_bound", "Noise", "best_depth", "bounds", "cramer_rao", "noise_table", "noise_text"]


class Noise(NamedTuple):
    """Standard deviations: relative of W, DP and T, absolute of sinkage [m] and slip [-]."""

    W: float
    DP: float
    T: float
    sinkage: float
    slip: float


LEVELS = {
    "0.1 %": Noise(0.001, 0.001, 0.001, 0.0001, 0.001),
    "1 %": Noise(0.01, 0.01, 0.02, 0.003, 0.01),
}
"""Levels of noise by name."""


def cramer_rao(point: OperatingPoint, x: Unknowns, noise: Noise, equations: Equations = EXACT) -> Array:
    """Least covariance (3, 3) of the relative errors of K_L, phi and n from one operating point.

    The inverse Jacobian (eq. 42) takes the noise of the forces, and of sinkage and slip through the forces, to the
    unknowns.
    """
    wheel = WheelEquations(point, equations)
    y = np.array(wheel.forces(x))
    covariance = np.diag((np.array(noise[:3]) * y) ** 2)
    for field, sd in (("sinkage", noise.sinkage), ("slip", noise.slip)):
        h = 1e-5 * getattr(point, field)
        ends = (point._replace(**{field: getattr(point, field) + d}) for d in (h, -h))
        high, low = (np.array(WheelEquations(p, equations).forces(x)) for p in ends)
        covariance += sd**2 * np.outer(high - low, high - low) / (2.0 * h) ** 2
    inverse = np.linalg.inv(wheel.jacobian(x)) / np.array(x)[:, None]
    return np.asarray(inverse @ covariance @ inverse.T)


def best_depth(covariance: Array, n: float) -> float:
    """Depth [m] at which the bearing pressure K_L z^n has the least relative variance."""
    return math.exp(-covariance[0, 2] / (covariance[2, 2] * n))


def bounds(covariance: Array, n: float, depth: float) -> Array:
    """Relative standard deviations (4,) of K_L, phi, n and of the bearing pressure at a depth [m]."""
    by_pressure = np.array([1.0, 0.0, n * math.log(depth)])
    return np.sqrt([*np.diag(covariance).tolist(), float(by_pressure @ covariance @ by_pressure)])


def K_L_bound(sinkage: float, noise: Noise, equations: Equations) -> float:
    """Least relative standard deviation of K_L of wet clay from one instant at a sinkage [m]."""
    return float(np.sqrt(cramer_rao(WET_CLAY.at(sinkage), WET_CLAY.truth, noise, equations)[0, 0]))


def noise_table(sinkage: float) -> str:
    """The bounds of one instant at a sinkage [m] as a table, for two soils and LEVELS of noise."""
    rows = []
    for soil, trial in (("wet clay", WET_CLAY), ("sandy loam", SANDY_LOAM)):
        for level, noise in LEVELS.items():
            covariance, n = cramer_rao(trial.at(sinkage), trial.truth, noise), trial.truth.n
            depth = best_depth(covariance, n)
            least = (f"{100.0 * value:.3g}" for value in bounds(covariance, n, depth))
            rows.append((soil, level, *least, f"{1e3 * depth:.0f} mm"))
    return table(("soil", "noise", "K_L %", "phi %", "n %", "p %", "at"), rows)


def noise_text(sinkage: float) -> str:
    """What the table shows, and what the paper's accuracy would need."""
    levels = "; ".join(
        f"{name}: W {100 * s.W:g} %, DP {100 * s.DP:g} %, T {100 * s.T:g} %, sinkage {1e3 * s.sinkage:g} mm, "
        f"slip {s.slip:g}" for name, s in LEVELS.items()
    )  # fmt: skip
    level = LEVELS["0.1 %"]
    forces_only = level._replace(sinkage=0.0, slip=0.0)
    exact, simpson = (100 * K_L_bound(sinkage, level, rule) for rule in (EXACT, SIMPSON))
    needed = forces_only.W * 0.02 / K_L_bound(sinkage, forces_only, EXACT)
    return (
        f"Standard deviations by level: {levels}. The table has the Cramer-Rao bounds of one instant, linear however "
        f"large; p is the bearing pressure K_L z^n at the depth where one instant determines it best. With Simpson's "
        f"rule the bound of K_L of wet clay at 0.1 % is {simpson:.3g} % instead of {exact:.3g} %. A hundred instants "
        f"at the same point would divide the bounds by 10. For K_L to 2 %, W, DP and T must be right to {needed:.1e} "
        f"of their values, with sinkage and slip exact."
    )
