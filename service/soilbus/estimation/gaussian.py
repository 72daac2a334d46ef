"""What is known of the soil and of the sensors' gain errors, jointly Gaussian.

What was known before a window, as residuals of soil and gains beside those of its data.
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
    from soilbus.estimation.model_form import FormLeft


_SOIL = len(PARAMETERS)
_K_C = PARAMETERS.index("k_c")
FAINT = 1e-3
"""Least share of the variance of log k_c by which data lessen it."""


@dataclass(frozen=True, slots=True)
class Gaussian:
    """Typical soil (6,) in SI and gain errors (G,), with their covariance (6 + G, 6 + G).

    Typical by its mean in the coordinates in which a window is nearest to Gaussian (see
    `moments`).  The covariance is that of the soil parameters' logarithms and the gains; what is held
    has none.  A window tells combinations of soil and gains, so what it leaves behind is
    kept jointly: gains do not change from window to window, and forgetting them would
    count the same ignorance as news each time.

    With k_c_off it is what data alone told (`likelihood_factor`): Gaussian in k_c, not in its logarithm.
    The covariance then is that of k_c in units of the soil's, and its mean is 1 + k_c_off of these.
    All is of the model's configured form; form is what that leaves open, None where it was not asked for.
    """

    soil: Array
    gains: Array
    covariance: Array
    k_c_offset: float | None = None
    form: FormLeft | None = None

    @classmethod
    def of(cls, prior: SoilPrior, gain_std: Array) -> Gaussian:
        """Before any window: the configured prior, and gain errors of this std (G,)."""
        variance = np.concatenate([prior.log_std, gain_std]) ** 2
        return cls(prior.median, np.zeros(len(gain_std)), np.diag(variance))

    @property
    def posterior(self) -> Posterior:
        """What is known of the soil alone."""
        return Posterior(Soil(*self.soil.tolist()), self.covariance[:_SOIL, :_SOIL])

    def gain(self, index: int) -> Estimate:
        """What is known of one gain error."""
        return Estimate(float(self.gains[index]), float(np.sqrt(self.covariance[_SOIL + index, _SOIL + index])))

    def mixture(self, other: Gaussian, share: float) -> Gaussian:
        """The same with the spread, about it, of what is this with probability 1 - share and another with share."""
        held = np.diag(self.covariance)[:_SOIL] == 0.0
        off = np.concatenate([np.where(held, 0.0, np.log(other.soil / self.soil)), other.gains - self.gains])
        of_other = other.covariance + np.outer(off, off)
        return replace(self, covariance=(1.0 - share) * self.covariance + share * of_other)

    def conditioned_on(self, parameter: int, log: float) -> Gaussian:
        """What is known of everything else if the logarithm of a free parameter is this: held from then on."""
        along = self.covariance[:, parameter] / self.covariance[parameter, parameter]
        covariance = self.covariance - np.outer(along, self.covariance[parameter])
        covariance[parameter] = covariance[:, parameter] = 0.0
        return self.shifted(along * (log - np.log(self.soil[parameter])), covariance)

    def shifted(self, step: Array, covariance: Array) -> Gaussian:
        """The same after a step (6 + G,) of the logarithms and gains, with another covariance."""
        soil, gains = self.soil * np.exp(step[:_SOIL]), self.gains + step[_SOIL:]
        if self.k_c_offset is None:
            return Gaussian(soil, gains, covariance)
        soil[_K_C] = self.soil[_K_C]
        return Gaussian(soil, gains, covariance, self.k_c_offset + float(step[_K_C]))

    def likelihood_factor(self, prior: SoilPrior) -> Gaussian:
        """What data alone told, where this is the mode of what they and the prior of log k_c say, with its curvature.

        Forces are all but linear in k_c, so that windows add up as Gaussians of k_c, and everything that makes up for
        k_c does so in proportion to it.  In its logarithm, of which a window may tell less than the
        prior does, neither is true: window after window would seem to tell against much of it.
        """
        variance, along = float(prior.log_std[_K_C] ** 2), self.covariance[:, _K_C]
        if variance == 0.0:
            return self
        untold = max(variance - float(along[_K_C]), FAINT * variance)
        off = along * (math.log(self.soil[_K_C] / prior.median[_K_C]) / untold)
        return replace(self, k_c_offset=0.0).shifted(off, self.covariance + np.outer(along, along) / untold)

    def variance_of_k_c(self, prior: SoilPrior) -> float:
        """Of its logarithm, the prior counted in."""
        own = float(self.covariance[_K_C, _K_C])
        return own if self.k_c_offset is None else 1.0 / (1.0 / own + float(prior.log_std[_K_C] ** -2))

    def drifted(self, soil: Array, gains: Array) -> Gaussian:
        """Later: the soil's logarithms may have changed with covariance (6, 6), the gains with variance (G,)."""
        covariance = self.covariance.copy()
        covariance[:_SOIL, :_SOIL] += soil
        covariance[range(_SOIL, len(covariance)), range(_SOIL, len(covariance))] += gains
        return replace(self, covariance=covariance)

    def of_another_soil(self, prior: SoilPrior) -> Gaussian:
        """What is left on another soil, of which only the prior is known: the gains."""
        covariance = self.covariance.copy()
        covariance[:_SOIL] = covariance[:, :_SOIL] = 0.0
        covariance[range(_SOIL), range(_SOIL)] = prior.log_std**2
        return Gaussian(prior.median, self.gains, covariance)


class PriorQuadratic(NamedTuple):
    """What was known before, as a parabola of coordinates and active gains: information, half its gradient, cost.

    of_data: of the gradient, what data told of which k_c is Gaussian.
    """

    information: Array
    gradient: Array
    neg2_log_prior: float
    of_data: Array


class PriorFactor:
    """What was known before of the free parameters and active gains (F + A).

    Each has a residual: its logarithm's, or the gain's, deviation.  Of what data alone told
    (Belief.apart_from) k_c's is that of k_c itself, in units of the soil's known before, and the prior of
    its logarithm, which they do not hold, is one more: R are F + A, or one more.

    precision (R, R) is that of the residuals; surplus is what data and the prior of k_c cost together at
    least, which no cost counts.
    """

    def __init__(self, gaussian_prior: Gaussian, prior: SoilPrior, active: NDArray[np.intp]) -> None:
        """Active are the gains that are not held; raises ValueError where `gaussian_prior` has no proper covariance."""
        self._gaussian_prior, self._prior, self._free, self._active = gaussian_prior, prior, prior.free, active
        kept = np.concatenate([self._free, _SOIL + active])
        inverse = solve_with_inverse(gaussian_prior.covariance[kept[:, None], kept], np.zeros(len(kept)))
        if inverse is None:
            raise ValueError("what was known before has no proper covariance")
        self.precision = inverse[1]
        self._mean = np.concatenate([np.log(gaussian_prior.soil[self._free]), gaussian_prior.gains[active]])
        self._none = np.zeros(len(kept))
        self.surplus = 0.0
        self._of_data = gaussian_prior.k_c_offset is not None and _K_C in self._free
        if self._of_data:
            self.precision = np.pad(self.precision, (0, 1))
            self.precision[-1, -1] = prior.log_std[_K_C] ** -2
            self.surplus = self._least()

    def quadratic_at(self, soil: Array, gains: Array, by_logs: Array) -> PriorQuadratic:
        """From a soil (6,) with gains (G,); by_logs (F + A, F + A): derivatives of logarithms and gains."""
        off, slopes = self.residuals(soil, gains), self.jacobian(soil, by_logs)
        pull = self.precision @ off
        gradient, of_data = slopes.T @ pull, self._none
        if self._of_data:
            of_data = gradient.copy()
            of_data[_K_C] -= pull[-1]
        return PriorQuadratic(slopes.T @ self.precision @ slopes, gradient, float(off @ pull) - self.surplus, of_data)

    def residuals(self, soil: Array, gains: Array) -> Array:
        """The residuals (R,) of a soil (6,) with gains (G,)."""
        off = np.concatenate([np.log(soil[self._free]), gains[self._active]]) - self._mean
        if not self._of_data:
            return np.asarray(off)
        of_prior = np.log(soil[_K_C] / self._prior.median[_K_C])
        off[_K_C] = soil[_K_C] / self._gaussian_prior.soil[_K_C] - 1.0 - self._gaussian_prior.k_c_offset
        return np.append(off, of_prior)

    def jacobian_by_mean(self, soil: Array, gains: Array, shift: Array) -> tuple[Array, Array, Array]:
        """Derivatives (R, M) of the residuals by what shifts the mean by (6 + G, M), with precision and residuals."""
        by_mean = -shift[np.concatenate([self._free, _SOIL + self._active])]
        if self._of_data:
            by_mean[_K_C] *= 1.0 + (self._gaussian_prior.k_c_offset or 0.0)
            by_mean = np.vstack([by_mean, np.zeros((1, by_mean.shape[1]))])  # the prior of its logarithm stays
        return by_mean, self.precision, self.residuals(soil, gains)

    def jacobian(self, soil: Array, by_logs: Array, by_k_c: Array | None = None) -> Array:
        """Derivatives (R, M) of the residuals, from those (F + A, M) of logarithms and gains by some M.

        by_k_c (M,) are those of the relative change of k_c, where they are not its logarithm's.
        """
        if not self._of_data:
            return by_logs
        slopes = np.vstack([by_logs, by_logs[_K_C]])
        slopes[_K_C] = by_logs[_K_C] if by_k_c is None else by_k_c
        slopes[_K_C] *= soil[_K_C] / self._gaussian_prior.soil[_K_C]
        return slopes

    def _least(self) -> float:
        """Least cost that what data told of k_c and its prior have together."""
        gaussian_prior, spread = self._gaussian_prior, self._prior.log_std[_K_C]
        deviation = np.linspace(-4.0, 4.0, 161)
        k_c = self._prior.median[_K_C] * np.exp(spread * deviation) / gaussian_prior.soil[_K_C]
        off = k_c - 1.0 - gaussian_prior.k_c_offset
        return float(np.min(off**2 / gaussian_prior.covariance[_K_C, _K_C] + deviation**2))


def solve_with_inverse(information: Array, gradient: Array) -> tuple[Array, Array] | None:
    """information^-1 gradient and information^-1, (F,) and (F, F); None where it is singular."""
    scale = 1.0 / np.sqrt(information.diagonal())
    scales = scale[:, None] * scale
    try:
        inverse = np.linalg.inv(information * scales)
    except np.linalg.LinAlgError:
        return None
    inverse = inverse * scales
    return (inverse @ gradient, inverse) if np.isfinite(inverse).all() else None
