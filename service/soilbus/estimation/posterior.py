"""Prior and posterior of the soil parameters, on the scale where they are near Gaussian.

Free parameters are positive and spread over decades, so both are Gaussian in the
logarithm of the parameter; a held parameter has no variance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soilbus.terra.stress import lumped_modulus
from soilbus.terra.wheel import Soil

Array = NDArray[np.float64]

PARAMETERS = Soil._fields


@dataclass(frozen=True, slots=True)
class SoilPrior:
    """Median (6,) in SI and sd of the logarithm (6,); sd 0 holds the parameter."""

    median: Array
    log_std: Array

    @classmethod
    def from_value_std(cls, values: Mapping[str, tuple[float, float]]) -> SoilPrior:
        """From (value, std) of each parameter: log-normal with that median and std/value as its variation."""
        value, std = np.array([values[name] for name in PARAMETERS], float).T
        ratio = np.divide(std, value, out=np.zeros(len(value)), where=std > 0.0)
        return cls(value, np.sqrt(np.log1p(ratio**2)))

    @property
    def free(self) -> NDArray[np.intp]:
        """Indices of the free parameters."""
        return np.flatnonzero(self.log_std > 0.0)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value and its standard deviation, both in SI."""

    value: float
    std: float


@dataclass(frozen=True, slots=True)
class Posterior:
    """Soil at the mode and covariance (6, 6) of the parameters' logarithms (held ones: 0)."""

    soil: Soil
    log_covariance: Array

    def parameters(self) -> dict[str, Estimate]:
        """Each soil parameter with its standard deviation."""
        std = np.sqrt(np.diag(self.log_covariance))
        return {n: Estimate(v, v * s) for n, v, s in zip(PARAMETERS, self.soil, std.tolist(), strict=True)}

    def propagate(self, gradient: Array) -> float:
        """Std of a scalar with this gradient (6,) by the parameters in SI."""
        g = gradient * np.asarray(self.soil)
        return float(np.sqrt(max(g @ self.log_covariance @ g, 0.0)))

    def bearing_pressure(self, z_ref: float, b_ref: float) -> Estimate:
        """Pressure [Pa] under a plate of width b_ref [m] at depth z_ref [m] (Bekker)."""
        value = self.soil.bearing_pressure(z_ref, b_ref)
        K_L = lumped_modulus(self.soil.k_c, self.soil.k_phi, b_ref)
        gradient = value * np.array([1 / b_ref / K_L, 1 / K_L, np.log(z_ref), 0.0, 0.0, 0.0])
        return Estimate(value, self.propagate(gradient))

    def tan_phi(self) -> Estimate:
        """Tangent of the internal friction angle."""
        tan = float(np.tan(self.soil.phi))
        return Estimate(tan, self.propagate(np.array([0.0, 0.0, 0.0, 1.0 + tan**2, 0.0, 0.0])))
