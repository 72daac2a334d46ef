"""Joint Gaussian of soil and gains, and the prior factor that it is in the next window's objective.

Equations.  With x = (log soil, gains), mean m and covariance C, the prior's residuals and objective are

    p = x - m,    -2 log prior = p' C^-1 p                                         (log-normal in all parameters)

or, for a likelihood factor, which is Gaussian in k_c itself with offset e in units of the soil's k_c,

    p_k_c = k_c / k_c0 - 1 - e,    p_R = log k_c - log prior median
    -2 log prior = p' diag(C^-1, prior sd^-2) p - least value

A window determines combinations of soil and gains, so its posterior is kept jointly.  Gains do not change from
window to window; without their covariance with the soil the same ignorance would count as new information each
time.  Forces are nearly linear in k_c, so several windows multiply as Gaussians of k_c and not of log k_c: a
likelihood factor is a posterior with the prior of log k_c divided out, in that form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.posterior import PARAMETERS, Estimate, Posterior, SoilPrior
from soilbus.terra.wheel import Soil

if TYPE_CHECKING:
    from soilbus.estimation.model_form import FormPosterior


_SOIL = len(PARAMETERS)
_K_C = PARAMETERS.index("k_c")
MIN_VARIANCE_REDUCTION = 1e-3
"""Least share [1] of the prior variance of log k_c that data are taken to remove.

Keeps the likelihood factor finite where they remove none.  No evidence recorded.
"""
LEAST_VALUE_SD, LEAST_VALUE_NODES = 4.0, 161
"""Half width in prior sd of log k_c, and nodes, of the grid on which the least -2 log prior is looked for."""


@dataclass(frozen=True, slots=True)
class Gaussian:
    """Mean and covariance of the soil's logarithms and the sensors' gains.

    Attributes
    ----------
    soil : (6,)
        In SI: the mean in the coordinates in which a window is nearest to Gaussian (see `parametrization`).
    gains : (G,)
        Relative errors of the sensors and standardised effect parameters.
    covariance : (6 + G, 6 + G)
        Of the soil's logarithms and the gains; rows of held ones are zero.
    k_c_offset : float, optional
        Only for a likelihood factor: Gaussian in k_c / soil's k_c, with mean 1 + k_c_offset.
    form : FormPosterior, optional
        What the model's form leaves open; everything else is of the configured form.
    """

    soil: Array
    gains: Array
    covariance: Array
    k_c_offset: float | None = None
    form: FormPosterior | None = None

    @classmethod
    def of(cls, prior: SoilPrior, gain_std: Array) -> Gaussian:
        """Before any window: the configured prior, and independent gains with mean 0 and this sd (G,)."""
        variance = np.concatenate([prior.log_std, gain_std]) ** 2
        return cls(prior.median, np.zeros(len(gain_std)), np.diag(variance))

    @property
    def posterior(self) -> Posterior:
        """The marginal of the soil."""
        return Posterior(Soil(*self.soil.tolist()), self.covariance[:_SOIL, :_SOIL])

    def gain(self, index: int) -> Estimate:
        """The marginal of one gain."""
        return Estimate(float(self.gains[index]), float(np.sqrt(self.covariance[_SOIL + index, _SOIL + index])))

    def shifted(self, step: Array, covariance: Array) -> Gaussian:
        """With its mean shifted by a step (6 + G,) of logarithms and gains, and another covariance."""
        soil, gains = self.soil * np.exp(step[:_SOIL]), self.gains + step[_SOIL:]
        if self.k_c_offset is None:
            return Gaussian(soil, gains, covariance)
        soil[_K_C] = self.soil[_K_C]
        return Gaussian(soil, gains, covariance, self.k_c_offset + float(step[_K_C]))

    def conditioned_on(self, parameter: int, log: float) -> Gaussian:
        """Conditional on the logarithm of a free parameter, which is held from then on."""
        along = self.covariance[:, parameter] / self.covariance[parameter, parameter]
        covariance = self.covariance - np.outer(along, self.covariance[parameter])
        covariance[parameter] = covariance[:, parameter] = 0.0
        return self.shifted(along * (log - np.log(self.soil[parameter])), covariance)

    def mixture(self, other: Gaussian, share: float) -> Gaussian:
        """This mean, with the second moment about it of a mixture: this with 1 - share, the other with share."""
        held = np.diag(self.covariance)[:_SOIL] == 0.0
        off = np.concatenate([np.where(held, 0.0, np.log(other.soil / self.soil)), other.gains - self.gains])
        of_other = other.covariance + np.outer(off, off)
        return replace(self, covariance=(1.0 - share) * self.covariance + share * of_other)

    def drifted(self, soil: Array, gains: Array) -> Gaussian:
        """After a random walk of the soil's logarithms, covariance (6, 6), and of the gains, variance (G,)."""
        covariance = self.covariance.copy()
        covariance[:_SOIL, :_SOIL] += soil
        covariance[range(_SOIL, len(covariance)), range(_SOIL, len(covariance))] += gains
        return replace(self, covariance=covariance)

    def with_prior_soil(self, prior: SoilPrior) -> Gaussian:
        """The marginal of the gains with the prior of the soil: on another soil only the gains stay known."""
        covariance = self.covariance.copy()
        covariance[:_SOIL] = covariance[:, :_SOIL] = 0.0
        covariance[range(_SOIL), range(_SOIL)] = prior.log_std**2
        return Gaussian(prior.median, self.gains, covariance)

    def likelihood_factor(self, prior: SoilPrior) -> Gaussian:
        """The posterior with the prior of log k_c divided out.

        Parameters
        ----------
        prior
            The prior that the posterior holds; the Gaussian is the posterior's mode and curvature.

        Notes
        -----
        Windows multiply as Gaussians of k_c, and what compensates for k_c is proportional to it.  In log k_c,
        of which a window may determine less than the prior does, neither holds: window after window would seem
        to exclude large k_c.
        """
        variance, along = float(prior.log_std[_K_C] ** 2), self.covariance[:, _K_C]
        if variance == 0.0:
            return self
        removed = max(variance - float(along[_K_C]), MIN_VARIANCE_REDUCTION * variance)
        off = along * (math.log(self.soil[_K_C] / prior.median[_K_C]) / removed)
        return replace(self, k_c_offset=0.0).shifted(off, self.covariance + np.outer(along, along) / removed)

    def variance_of_k_c(self, prior: SoilPrior) -> float:
        """Variance of log k_c, the prior included."""
        own = float(self.covariance[_K_C, _K_C])
        return own if self.k_c_offset is None else 1.0 / (1.0 / own + float(prior.log_std[_K_C] ** -2))


class PriorQuadratic(NamedTuple):
    """-2 log prior about a point, by F coordinates and A active gains.

    Attributes
    ----------
    information : (F + A, F + A)
        Half the Gauss-Newton Hessian.
    gradient : (F + A,)
        Half the gradient.
    neg2_log_prior : float
        The value.
    gradient_of_data : (F + A,)
        The part of the gradient that is Gaussian in k_c: without the prior of log k_c; 0 where all of it is
        log-normal.
    """

    information: Array
    gradient: Array
    neg2_log_prior: float
    gradient_of_data: Array


class PriorFactor:
    """The prior of a window's free parameters and active gains, as R residuals with a precision.

    Parameters
    ----------
    gaussian_prior
        Joint prior of soil and gains, or a likelihood factor.
    prior
        The configured prior of the soil.
    active : (A,)
        Indices of the gains that are not held.

    Attributes
    ----------
    precision : (R, R)
        Of the residuals.  R is F + A, and one more where the prior is a likelihood factor: its residual of k_c
        itself comes with one of log k_c by the configured prior.
    least_value : float
        Least -2 log of likelihood factor and prior of log k_c together, which is subtracted from every value.

    Raises
    ------
    ValueError
        Where `gaussian_prior` has no proper covariance.
    """

    def __init__(self, gaussian_prior: Gaussian, prior: SoilPrior, active: NDArray[np.intp]) -> None:
        self._gaussian_prior, self._prior, self._free, self._active = gaussian_prior, prior, prior.free, active
        unknowns = np.concatenate([self._free, _SOIL + active])
        inverse = solve_with_inverse(gaussian_prior.covariance[unknowns[:, None], unknowns], np.zeros(len(unknowns)))
        if inverse is None:
            raise ValueError("the prior has no proper covariance")
        self.precision = inverse[1]
        self._mean = np.concatenate([np.log(gaussian_prior.soil[self._free]), gaussian_prior.gains[active]])
        self._zero_gradient = np.zeros(len(unknowns))
        self.least_value = 0.0
        self._is_likelihood_factor = gaussian_prior.k_c_offset is not None and _K_C in self._free
        if self._is_likelihood_factor:
            self.precision = np.pad(self.precision, (0, 1))
            self.precision[-1, -1] = prior.log_std[_K_C] ** -2
            self.least_value = self._least()

    def quadratic_at(self, soil: Array, gains: Array, by_logs: Array) -> PriorQuadratic:
        """-2 log prior about a soil (6,) with gains (G,).

        Parameters
        ----------
        soil, gains
            In SI, and (G,).
        by_logs : (F + A, F + A)
            Derivatives of logarithms and gains by coordinates and gains.
        """
        off, slopes = self.residuals(soil, gains), self.jacobian(soil, by_logs)
        weighted = self.precision @ off
        gradient, of_data = slopes.T @ weighted, self._zero_gradient
        if self._is_likelihood_factor:
            of_data = gradient.copy()
            of_data[_K_C] -= weighted[-1]
        value = float(off @ weighted) - self.least_value
        return PriorQuadratic(slopes.T @ self.precision @ slopes, gradient, value, of_data)

    def residuals(self, soil: Array, gains: Array) -> Array:
        """The residuals (R,) of a soil (6,) with gains (G,)."""
        off = np.concatenate([np.log(soil[self._free]), gains[self._active]]) - self._mean
        if not self._is_likelihood_factor:
            return np.asarray(off)
        of_prior = np.log(soil[_K_C] / self._prior.median[_K_C])
        off[_K_C] = soil[_K_C] / self._gaussian_prior.soil[_K_C] - 1.0 - self._gaussian_prior.k_c_offset
        return np.append(off, of_prior)

    def jacobian(self, soil: Array, by_logs: Array, by_k_c: Array | None = None) -> Array:
        """Derivatives (R, M) of the residuals by M unknowns.

        Parameters
        ----------
        soil : (6,)
            In SI.
        by_logs : (F + A, M)
            Derivatives of logarithms and gains by the unknowns.
        by_k_c : (M,), optional
            Those of the relative change of k_c, where they are not those of log k_c.
        """
        if not self._is_likelihood_factor:
            return by_logs
        slopes = np.vstack([by_logs, by_logs[_K_C]])
        slopes[_K_C] = by_logs[_K_C] if by_k_c is None else by_k_c
        slopes[_K_C] *= soil[_K_C] / self._gaussian_prior.soil[_K_C]
        return slopes

    def jacobian_by_mean(self, soil: Array, gains: Array, shift: Array) -> tuple[Array, Array, Array]:
        """Derivatives (R, M) of the residuals by M shifts (6 + G, M) of the mean, with precision and residuals."""
        by_mean = -shift[np.concatenate([self._free, _SOIL + self._active])]
        if self._is_likelihood_factor:
            by_mean[_K_C] *= 1.0 + (self._gaussian_prior.k_c_offset or 0.0)
            by_mean = np.vstack([by_mean, np.zeros((1, by_mean.shape[1]))])  # the prior of log k_c does not shift
        return by_mean, self.precision, self.residuals(soil, gains)

    def _least(self) -> float:
        """Least -2 log of the likelihood factor of k_c and the prior of log k_c together, on a grid."""
        gaussian_prior, spread = self._gaussian_prior, self._prior.log_std[_K_C]
        deviation = np.linspace(-LEAST_VALUE_SD, LEAST_VALUE_SD, LEAST_VALUE_NODES)
        k_c = self._prior.median[_K_C] * np.exp(spread * deviation) / gaussian_prior.soil[_K_C]
        off = k_c - 1.0 - gaussian_prior.k_c_offset
        return float(np.min(off**2 / gaussian_prior.covariance[_K_C, _K_C] + deviation**2))


def solve_with_inverse(information: Array, gradient: Array) -> tuple[Array, Array] | None:
    """information^-1 gradient (F,) and information^-1 (F, F), scaled to a unit diagonal; None where it is singular."""
    scale = 1.0 / np.sqrt(information.diagonal())
    scales = scale[:, None] * scale
    try:
        inverse = np.linalg.inv(information * scales)
    except np.linalg.LinAlgError:
        return None
    inverse = inverse * scales
    return (inverse @ gradient, inverse) if np.isfinite(inverse).all() else None
