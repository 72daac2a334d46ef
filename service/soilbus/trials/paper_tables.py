"""What Xi et al. 2024 (World Electr. Veh. J. 15:217) print: Tables 2-7.

Soils of Tables 2 and 5 are in terra/soils.py. Units are the paper's: degrees, kN/m^(n+2), per cent, seconds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from soilbus.terra.soil_laws import lumped_modulus
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil
from soilbus.trials.paper import OperatingPoint, Unknowns

__all__ = [
    "RUNS", "SANDY_LOAM", "SINKAGE", "SLIP", "START_ERRORS", "TRACTOR_2", "TRIALS", "WET_CLAY", "Run", "Trial",
    "as_print", "errors_in_percent", "from_print"
]  # fmt: skip

SLIP = 0.2
"""Section 4.2."""
SINKAGE = 0.05
"""Ours [m]: the paper prints neither the sinkage nor W, DP and T of its simulations."""


class Trial(NamedTuple):
    """A soil and a wheel (radius, width [m]) of Table 2 or 5."""

    soil: Soil
    radius: float
    width: float

    @property
    def truth(self) -> Unknowns:
        """The soil's parameters on this tyre."""
        return Unknowns(lumped_modulus(self.soil.k_c, self.soil.k_phi, self.width), self.soil.phi, self.soil.n)

    def at(self, sinkage: float, slip: float = SLIP) -> OperatingPoint:
        """Return the wheel at a sinkage [m] and a slip."""
        return OperatingPoint(sinkage, slip, self.radius, self.width, self.soil.c, self.soil.K)


WET_CLAY = Trial(SOILS["xi_wet_clay"], 0.5, 0.3)
SANDY_LOAM = Trial(SOILS["xi_sandy_loam"], 0.5, 0.3)
TRACTOR_2 = Trial(SOILS["xi_wet_clay"], 1.09, 0.45)
TRIALS = {"wet clay": WET_CLAY, "sandy loam": SANDY_LOAM, "wet clay, tractor 2": TRACTOR_2}


class Run(NamedTuple):
    """One column of results: phi [deg], K_L [kN/m^(n+2)], n; errors in per cent, time in s."""

    table: int
    on: str
    trial: Trial
    start: tuple[float, float, float]
    result: tuple[float, float, float]
    errors: tuple[float, float, float]
    seconds: float


RUNS = (
    Run(3, "wet clay", WET_CLAY, (11.2, 515.92, 0.68), (13.9671, 635.522, 0.8498), (0.235, 1.8, 0.024), 0.37),
    Run(3, "sandy loam", SANDY_LOAM, (23.2, 1226.16, 0.56), (29.004, 1539.01, 0.703), (0.014, 0.411, 0.429), 0.73),
    Run(4, "wet clay", WET_CLAY, (7.0, 322.45, 0.425), (14.13, 635.522, 0.8498), (0.9, 1.8, 0.024), 0.44),
    Run(4, "sandy loam", SANDY_LOAM, (14.5, 766.35, 0.35), (29.004, 1533.9, 0.705), (0.014, 0.0783, 0.714), 0.84),
    Run(6, "tractor 1", WET_CLAY, (11.2, 515.92, 0.68), (13.9671, 635.522, 0.8498), (0.235, 1.8, 0.024), 0.37),
    Run(6, "tractor 2", TRACTOR_2, (11.2, 476.8, 0.68), (13.999, 596.18, 0.8503), (0.007, 0.03, 0.035), 0.33),
    Run(7, "tractor 1", WET_CLAY, (7.0, 322.45, 0.425), (14.13, 635.522, 0.8498), (0.9, 1.8, 0.024), 0.44),
    Run(7, "tractor 2", TRACTOR_2, (14.5, 766.35, 0.35), (29.004, 1533.9, 0.705), (0.014, 0.0783, 0.714), 0.57),
)
"""Tables 3, 4, 6 and 7 as printed."""
START_ERRORS = {3: 20, 4: 50, 6: 20, 7: 50}
"""What each table says the start values are off by [%]."""


def from_print(values: tuple[float, float, float]) -> Unknowns:
    """Return SI values of a printed phi [deg], K_L [kN/m^(n+2)] and n."""
    phi, K_L, n = values
    return Unknowns(1e3 * K_L, math.radians(phi), n)


def as_print(x: Unknowns) -> tuple[float, float, float]:
    """Return phi [deg], K_L [kN/m^(n+2)] and n, in the order of the paper's tables."""
    return math.degrees(x.phi), 1e-3 * x.K_L, x.n


def errors_in_percent(x: Unknowns, truth: Unknowns) -> tuple[float, float, float]:
    """Return the relative errors of phi, K_L and n, in the order of the paper's tables."""
    phi, K_L, n = (100.0 * abs(a / b - 1.0) for a, b in zip(as_print(x), as_print(truth), strict=True))
    return phi, K_L, n
