"""Prior and posterior of the soil's parameters, and quantities that follow from them.

Equations.

    prior, posterior    log parameter ~ N(log value, covariance)          (log-normal; a held one has variance 0)
    derived quantity    var q = (dq/dlog parameter)' covariance (dq/dlog parameter)
    e.g.                bearing pressure = (k_c / b_ref + k_phi) z_ref^n

Free parameters are positive and spread over decades, so both distributions are Gaussian in the parameters'
logarithms.  `SoilPrior` and `Posterior` hold them; an `Estimate` is what is reported.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.options import ESTIMATOR
from soilbus.terra.wheel import Soil

__all__ = ["NORMAL_95", "PARAMETERS", "Estimate", "Posterior", "SoilPrior", "pressure_gradient"]

PARAMETERS = Soil._fields
"""Names of the soil parameters, in the order of every vector of them."""
_PHI, _C = PARAMETERS.index("phi"), PARAMETERS.index("c")
NORMAL_95 = 1.959964
"""Standard deviations on either side of the mean that hold 95 % of a normal distribution."""


@dataclass(frozen=True, slots=True, eq=False)
class SoilPrior:
    """Log-normal prior: median (6,) in SI and sd of the logarithm (6,); sd 0 holds the parameter."""

    median: Array
    log_std: Array

    @classmethod
    def from_value_std(cls, values: Mapping[str, tuple[float, float]]) -> SoilPrior:
        """Return the prior from (median, median times the coefficient of variation) of each parameter, in SI.

        Examples
        --------
        >>> values = dict.fromkeys(PARAMETERS, (2.0, 1.0)) | {"K": (0.025, 0.0)}
        >>> prior = SoilPrior.from_value_std(values)
        >>> prior.free
        array([0, 1, 2, 3, 4])
        >>> prior.log_std.round(3)
        array([0.472, 0.472, 0.472, 0.472, 0.472, 0.   ])
        """
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
    """Log-normal posterior of the parameters."""

    soil: Soil  # in SI: the mean in the window's coordinates (see `gaussian.Gaussian`)
    log_covariance: Array  # (6, 6), of the parameters' logarithms; rows of held ones are zero

    def parameters(self) -> dict[str, Estimate]:
        """Return each parameter with its median and the root mean square deviation from it.

        E (x / median - 1)^2 = exp(2 v) - 2 exp(v / 2) + 1 for log variance v: value +- 1.96 std holds 94 to 97 %.
        """
        variance = np.diag(self.log_covariance).copy()
        variance[_PHI] = self._covariance(np.eye(len(PARAMETERS))[_PHI][None])[0, 0]
        variance = np.minimum(variance, ESTIMATOR.posterior.max_log_variance)
        relative = np.sqrt(np.expm1(2.0 * variance) - 2.0 * np.expm1(0.5 * variance))
        return {n: Estimate(v, v * r) for n, v, r in zip(PARAMETERS, self.soil, relative.tolist(), strict=True)}

    def propagate(self, gradient: Array) -> float:
        """Return the sd of a scalar with this gradient (6,) by the parameters, to first order."""
        variance = float(self._covariance((gradient * np.asarray(self.soil))[None])[0, 0])
        return math.sqrt(max(variance, 0.0))  # rounding may take it below zero

    def _covariance(self, by_logs: Array) -> Array:
        """Covariance (S, S) of scalars with these derivatives (S, 6) by the logarithms."""
        # First order, but for c: strength is linear in it, so phi follows c itself, which is log-normal, and not its
        # logarithm: E (c / median - 1)^2 = exp(2 v) - 2 exp(v / 2) + 1 in place of v = var(log c).
        covariance, v = by_logs @ self.log_covariance @ by_logs.T, float(self.log_covariance[_C, _C])
        if v <= 0.0:
            return np.asarray(covariance)
        along = by_logs[:, [_PHI, _C]] @ self.log_covariance[[_PHI, _C], _C] / v
        v = min(v, ESTIMATOR.posterior.max_log_variance)
        square = math.expm1(2.0 * v) - 2.0 * math.expm1(0.5 * v)
        return np.asarray(covariance + np.outer(along, along) * (square - v))

    def bearing_pressure(self, z_ref: float, b_ref: float) -> Estimate:
        """Return the pressure [Pa] under a plate of width b_ref [m] at depth z_ref [m] (Bekker)."""
        gradient = pressure_gradient(self.soil, z_ref, b_ref)
        return Estimate(self.soil.bearing_pressure(z_ref, b_ref), self.propagate(gradient))

    def tan_phi(self) -> Estimate:
        """Return the tangent of the internal friction angle."""
        tan = math.tan(self.soil.phi)
        return Estimate(tan, self.propagate(np.array([0.0, 0.0, 0.0, 1.0 + tan**2, 0.0, 0.0])))

    def shear_strength(self, pressure: float) -> Estimate:
        """Return the strength c + p tan phi [Pa] below a pressure p [Pa]."""
        tan = math.tan(self.soil.phi)
        gradient = np.array([0.0, 0.0, 0.0, pressure * (1.0 + tan**2), 1.0, 0.0])
        return Estimate(self.soil.c + pressure * tan, self.propagate(gradient))

    def with_added_covariance(self, more: Array, prior: SoilPrior, shift: Array | None = None) -> Posterior:
        """Return the posterior with a covariance (6, 6) of the logarithms added, as by considered parameters.

        Principal variances of the sum, in units of the prior's, are clipped to 1.  shift (6,): of the logarithms, from
        this soil to the mean over the considered parameters.
        """
        free = prior.free
        if not len(free):
            return self
        unit, at = np.outer(prior.log_std[free], prior.log_std[free]), np.ix_(free, free)
        variance, axes = np.linalg.eigh((self.log_covariance + more)[at] / unit)
        covariance = np.zeros_like(self.log_covariance)
        covariance[at] = (axes * np.clip(variance, 0.0, 1.0)) @ axes.T * unit
        wider = Posterior(self.soil, covariance)
        return wider if shift is None else wider.shifted(shift, prior)

    def shifted(self, logs: Array, prior: SoilPrior) -> Posterior:
        """Return the posterior with its logarithms shifted (6,), each by at most the prior's sd."""
        step = np.clip(logs, -prior.log_std, prior.log_std)
        return Posterior(Soil(*(np.asarray(self.soil) * np.exp(step)).tolist()), self.log_covariance)


def pressure_gradient(soil: Soil, z_ref: float, b_ref: float) -> Array:
    """Return the gradient (6,) of `Posterior.bearing_pressure` by the parameters."""
    by_k_phi, pressure = z_ref**soil.n, soil.bearing_pressure(z_ref, b_ref)
    return np.array([by_k_phi / b_ref, by_k_phi, pressure * math.log(z_ref), 0.0, 0.0, 0.0])
