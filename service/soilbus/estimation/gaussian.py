"""Joint Gaussian of soil and gains, and the prior factor that it is in the next window's objective.

Equations.  With x = (log soil, gains), mean m and covariance C, the prior's residuals and objective are

    p = x - m,    -2 log prior = p' C^-1 p                                         (log-normal in all parameters)

or, for a likelihood factor, which is Gaussian in y = k_c, n, tan phi and c themselves and in log K_L in place of
log k_phi (`deviations`), with offset e in units of their change with the logarithm at the soil y0,

    p_y = (y - y0) / (dy/dlog)_0 - e,    p_R = log parameter - log prior median
    -2 log prior = p' diag(C^-1, prior sd^-2) p - value at y0

A window determines combinations of soil and gains, so its posterior is kept jointly.  Gains do not change from
window to window; without their covariance with the soil the same ignorance would count as new information each
time.  Forces are linear in c and tan phi and nearly so in k_c, the logarithm of pressure is linear in n, so several
windows multiply as Gaussians of these and not of their logarithms: a likelihood factor is a posterior with their
log-normal priors divided out, in that form.  At one load a window determines A c + W tan phi alone, a straight line in
(c, tan phi) and a curve in logarithms: two windows linearised at two points of the curve would seem to determine c
where they cross.
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
_K_C, _K_PHI, _N, _PHI, _C = (PARAMETERS.index(name) for name in ("k_c", "k_phi", "n", "phi", "c"))
LINEAR = np.array([_K_C, _N, _PHI, _C])
"""Parameters in which forces, of n the logarithm of pressure, are linear, of phi in its tangent."""


def deviations(soil: Array, base: Array, width: float) -> tuple[Array, Array]:
    """Return changes (6,) from a base (6,) to a soil (6,) in which windows are linear, and their derivatives.

    Each is that of the parameter's logarithm at the base.  There and elsewhere the LINEAR parameters change linearly;
    that of k_phi is log K_L less the part of k_c, K_L = k_c / width + k_phi; K changes by its logarithm.

    Returns
    -------
    (6,), (6, 6)
    """
    values = np.where(base > 0.0, [soil, base], 1.0)  # a held one may be zero
    change, slopes = np.log(values[0] / values[1]), np.eye(len(soil))
    new, old = values.tolist()
    for i in (_K_C, _N, _C):
        change[i], slopes[i, i] = (new[i] - old[i]) / old[i], new[i] / old[i]
    tan, tan_at_base = math.tan(new[_PHI]), math.tan(old[_PHI])
    unit = old[_PHI] * (1.0 + tan_at_base**2)
    change[_PHI], slopes[_PHI, _PHI] = (tan - tan_at_base) / unit, new[_PHI] * (1.0 + tan**2) / unit
    K_L_at_base = old[_K_PHI] + old[_K_C] / width
    k_phi, ratio = old[_K_PHI], K_L_at_base / (new[_K_PHI] + new[_K_C] / width)
    change[_K_PHI] = (-math.log(ratio) * K_L_at_base - (new[_K_C] - old[_K_C]) / width) / k_phi
    slopes[_K_PHI, _K_PHI] = ratio * new[_K_PHI] / k_phi
    slopes[_K_PHI, _K_C] = (ratio - 1.0) * new[_K_C] / width / k_phi
    return change, slopes


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
    offset : (6,), optional
        Only for a likelihood factor: Gaussian in the `deviations` from this soil, with this mean.
    form : FormPosterior, optional
        What the model's form leaves open; everything else is of the configured form.
    """

    soil: Array
    gains: Array
    covariance: Array
    offset: Array | None = None
    form: FormPosterior | None = None

    @classmethod
    def of(cls, prior: SoilPrior, gain_std: Array) -> Gaussian:
        """Return the joint prior before any window: the configured soil, and gains with mean 0 and this sd (G,)."""
        variance = np.concatenate([prior.log_std, gain_std]) ** 2
        return cls(prior.median, np.zeros(len(gain_std)), np.diag(variance))

    @property
    def posterior(self) -> Posterior:
        """The marginal of the soil."""
        return Posterior(Soil(*self.soil.tolist()), self.covariance[:_SOIL, :_SOIL])

    def gain(self, index: int) -> Estimate:
        """Return the marginal of one gain."""
        return Estimate(float(self.gains[index]), float(np.sqrt(self.covariance[_SOIL + index, _SOIL + index])))

    def shifted(self, step: Array, covariance: Array) -> Gaussian:
        """Return the Gaussian with its mean shifted by a step (6 + G,), and with another covariance."""
        gains = self.gains + step[_SOIL:]
        if self.offset is None:
            return Gaussian(self.soil * np.exp(step[:_SOIL]), gains, covariance)
        return Gaussian(self.soil, gains, covariance, self.offset + step[:_SOIL])

    def drifted(self, soil: Array, gains: Array) -> Gaussian:
        """Return the Gaussian after a random walk of the soil (covariance (6, 6)) and the gains (variance (G,))."""
        covariance = self.covariance.copy()
        covariance[:_SOIL, :_SOIL] += soil
        covariance[range(_SOIL, len(covariance)), range(_SOIL, len(covariance))] += gains
        return replace(self, covariance=covariance)

    def with_prior_soil(self, prior: SoilPrior) -> Gaussian:
        """Return the marginal of the gains with the prior of the soil, as on another soil."""
        covariance = self.covariance.copy()
        covariance[:_SOIL] = covariance[:, :_SOIL] = 0.0
        covariance[range(_SOIL), range(_SOIL)] = prior.log_std**2
        return Gaussian(prior.median, self.gains, covariance)

    def likelihood_factor(self, prior: SoilPrior) -> Gaussian:
        """Return the posterior with the priors of the logarithms of LINEAR divided out.

        Parameters
        ----------
        prior
            The prior that the posterior holds; the Gaussian is the posterior's mode and curvature.

        Notes
        -----
        Windows multiply as Gaussians of k_c, tan phi and c, and what compensates for k_c or c is proportional to it.
        In logarithms, of which a window may determine less than the prior does, neither holds: window after window
        would seem to exclude large k_c, and to determine c where only the strength at one pressure is measured.
        """
        free, covariance = self._without_priors(prior)
        if not len(free):
            return self
        off = covariance[:, free] @ (np.log(self.soil[free] / prior.median[free]) / prior.log_std[free] ** 2)
        return replace(self, offset=np.zeros(_SOIL)).shifted(off, covariance)

    def _without_priors(self, prior: SoilPrior) -> tuple[NDArray[np.intp], Array]:
        """Free parameters of LINEAR, and the covariance (6 + G, 6 + G) without the priors of their logarithms."""
        free = LINEAR[prior.log_std[LINEAR] > 0.0]
        unit, along = prior.log_std[free], self.covariance[:, free]
        # data that remove no variance leave a finite factor, too
        removed, axes = np.linalg.eigh(np.eye(len(free)) - along[free] / np.outer(unit, unit))
        inverse = (axes / np.maximum(removed, 1e-3)) @ axes.T / np.outer(unit, unit)
        return free, self.covariance + along @ inverse @ along.T


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
    """

    information: Array
    gradient: Array
    neg2_log_prior: float


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
    width
        Mean width [m] of the tyres.

    Attributes
    ----------
    precision : (R, R)
        Of the residuals.  R is F + A, and one more for each free parameter of LINEAR where the prior is a likelihood
        factor: besides the parameter's own residual there is one of its logarithm, by the configured prior.
    value_at_mean : float
        -2 log of likelihood factor and these priors together at the mean, which is subtracted from every value.

    Raises
    ------
    ValueError
        Where `gaussian_prior` has no proper covariance.
    """

    def __init__(self, gaussian_prior: Gaussian, prior: SoilPrior, active: NDArray[np.intp], width: float) -> None:
        self._gaussian_prior, self._prior, self._free, self._active = gaussian_prior, prior, prior.free, active
        unknowns = np.concatenate([self._free, _SOIL + active])
        inverse = solve_with_inverse(gaussian_prior.covariance[unknowns[:, None], unknowns], np.zeros(len(unknowns)))
        if inverse is None:
            raise ValueError("the prior has no proper covariance")
        self.precision = inverse[1]
        self._mean = np.concatenate([np.log(gaussian_prior.soil[self._free]), gaussian_prior.gains[active]])
        self._width = width
        self.value_at_mean = 0.0
        self._offset = np.zeros(_SOIL) if gaussian_prior.offset is None else gaussian_prior.offset
        self._is_likelihood_factor = gaussian_prior.offset is not None
        self._last_deviations: tuple[Array, tuple[Array, Array]] | None = None
        if self._is_likelihood_factor:
            self._linear = LINEAR[np.isin(LINEAR, self._free)]
            self._place = np.searchsorted(self._free, self._linear)
            n = len(self.precision)
            self.precision = np.pad(self.precision, (0, len(self._linear)))
            self.precision[range(n, len(self.precision)), range(n, len(self.precision))] = (
                prior.log_std[self._linear] ** -2
            )
            of_linear = gaussian_prior.covariance[np.ix_(self._linear, self._linear)]
            off = self._offset[self._linear]
            logs = np.log(gaussian_prior.soil[self._linear] / prior.median[self._linear])
            of_logs = logs / prior.log_std[self._linear]
            self.value_at_mean = float(off @ np.linalg.solve(of_linear, off) + of_logs @ of_logs)

    def quadratic_at(self, soil: Array, gains: Array, by_logs: Array) -> PriorQuadratic:
        """Return -2 log prior about a soil (6,) with gains (G,).

        by_logs (F + A, F + A): derivatives of logarithms and gains by coordinates and gains.
        """
        off, slopes = self.residuals(soil, gains), self.jacobian(soil, by_logs)
        weighted = self.precision @ off
        value = float(off @ weighted) - self.value_at_mean
        return PriorQuadratic(slopes.T @ self.precision @ slopes, slopes.T @ weighted, value)

    def residuals(self, soil: Array, gains: Array) -> Array:
        """Return the residuals (R,) of a soil (6,) with gains (G,)."""
        off = np.concatenate([np.log(soil[self._free]), gains[self._active]]) - self._mean
        if not self._is_likelihood_factor:
            return np.asarray(off)
        changes, _ = self._deviations(soil)
        off[: len(self._free)] = (changes - self._offset)[self._free]
        return np.append(off, np.log(soil[self._linear] / self._prior.median[self._linear]))

    def jacobian(self, soil: Array, by_logs: Array) -> Array:
        """Return the derivatives (R, M) of the residuals at a soil (6,) by M unknowns.

        by_logs (F + A, M): derivatives of logarithms and gains by the unknowns.
        """
        if not self._is_likelihood_factor:
            return by_logs
        free = len(self._free)
        slopes = self._deviations(soil)[1][self._free[:, None], self._free]
        return np.vstack([slopes @ by_logs[:free], by_logs[free:], by_logs[self._place]])

    def _deviations(self, soil: Array) -> tuple[Array, Array]:
        """`deviations` from the mean to a soil (6,), kept for the next call with the same one."""
        last = self._last_deviations
        if last is None or last[0] is not soil:
            last = self._last_deviations = soil, deviations(soil, self._gaussian_prior.soil, self._width)
        return last[1]

    def jacobian_by_mean(self, soil: Array, gains: Array, shift: Array) -> tuple[Array, Array, Array]:
        """Return the derivatives (R, M) of the residuals by M shifts (6 + G, M) of the mean."""
        by_mean = -shift[np.concatenate([self._free, _SOIL + self._active])]
        if self._is_likelihood_factor:  # the priors of the logarithms do not shift
            by_mean = np.vstack([by_mean, np.zeros((len(self._linear), by_mean.shape[1]))])
        return by_mean, self.precision, self.residuals(soil, gains)


def solve_with_inverse(information: Array, gradient: Array) -> tuple[Array, Array] | None:
    """Return information^-1 gradient (F,) and information^-1 (F, F); None where it is singular."""
    scale = 1.0 / np.sqrt(information.diagonal())
    scales = scale[:, None] * scale
    try:
        inverse = np.linalg.inv(information * scales)
    except np.linalg.LinAlgError:
        return None
    inverse = inverse * scales
    return (inverse @ gradient, inverse) if np.isfinite(inverse).all() else None
