"""Joint Gaussian of soil and gains, and the solution of normal equations.

A window determines combinations of soil and gains, so its posterior is kept jointly.  Another marginal of some gains
moves the rest by its regression,

    B = C_xg C_gg^-1,    x += B (g' - g),    C += B (C_gg' - C_gg) B'
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.posterior import PARAMETERS, Estimate, Posterior, SoilPrior
from soilbus.terra.wheel import Soil

if TYPE_CHECKING:
    from soilbus.estimation.model_form import FormPosterior


_SOIL = len(PARAMETERS)


@dataclass(frozen=True, slots=True)
class Gaussian:
    """Mean and covariance of the soil's logarithms and the sensors' gains."""

    soil: Array  # (6,) in SI: the mean in the coordinates of `parametrization`
    gains: Array  # (G,), relative errors of the sensors and standardised effect parameters
    covariance: Array  # (6 + G, 6 + G), of the soil's logarithms and the gains; rows of held ones are zero
    form: FormPosterior | None = None  # what the model's form leaves open; everything else is of the configured form

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

    def drifted(self, soil: Array) -> Gaussian:
        """Return the Gaussian after a random walk of the soil (covariance (6, 6))."""
        covariance = self.covariance.copy()
        covariance[:_SOIL, :_SOIL] += soil
        return replace(self, covariance=covariance)

    def forgotten(self, kept: float, std: Array) -> Gaussian:
        """Return the Gaussian whose gains have the density p^kept p_0^(1 - kept), p_0 of mean 0 and this sd (G,).

        Stabilised forgetting (Kulhavy & Zarrop 1993, Int. J. Control 58:905): an error that all windows share does not
        outweigh the prior in time.
        """
        at = np.flatnonzero(std > 0.0)
        prior, own = np.diag(std[at] ** 2), self.covariance[np.ix_(_SOIL + at, _SOIL + at)]
        share = np.linalg.solve(kept * prior + (1.0 - kept) * own, prior).T  # (k C^-1 + (1 - k) C_0^-1)^-1 C^-1
        return self._with_gains(at, kept * share @ self.gains[at], share @ own)

    def wandered(self, kept: float, std: Array) -> Gaussian:
        """Return the Gaussian after a time in which gain errors, of mean 0 and this sd (G,), keep an autocorrelation.

        Stationary process (Uhlenbeck & Ornstein 1930, Phys. Rev. 36:823): a gain g is drawn back to k g with variance
        k^2 var + (1 - k^2) std^2.
        """
        k = np.concatenate([np.ones(_SOIL), kept * (std > 0.0)])
        covariance = k[:, None] * self.covariance * k
        covariance[_SOIL:, _SOIL:] += np.diag((1.0 - k[_SOIL:] ** 2) * std**2)
        return replace(self, gains=k[_SOIL:] * self.gains, covariance=covariance)

    def given(self, at: NDArray[np.intp], gains: Array) -> Gaussian:
        """Return the Gaussian where the gains at these places (K,) have these values (K,)."""
        return self._with_gains(at, gains, np.zeros((len(at), len(at))))

    def _with_gains(self, at: NDArray[np.intp], gains: Array, covariance: Array) -> Gaussian:
        """The Gaussian with another mean (K,) and covariance (K, K) of the gains at these places."""
        old = self.covariance[np.ix_(_SOIL + at, _SOIL + at)]
        sd = np.sqrt(old.diagonal())[:, None]
        by_gains = (np.linalg.lstsq(old / (sd * sd.T), self.covariance[_SOIL + at] / sd, rcond=None)[0] / sd).T
        moved = by_gains @ (gains - self.gains[at])
        return replace(
            self,
            soil=self.soil * np.exp(moved[:_SOIL]),
            gains=self.gains + moved[_SOIL:],
            covariance=self.covariance + by_gains @ (covariance - old) @ by_gains.T,
        )

    def with_prior_soil(self, prior: SoilPrior) -> Gaussian:
        """Return the marginal of the gains with the prior of the soil, as on another soil."""
        covariance = self.covariance.copy()
        covariance[:_SOIL] = covariance[:, :_SOIL] = 0.0
        covariance[range(_SOIL), range(_SOIL)] = prior.log_std**2
        return Gaussian(prior.median, self.gains, covariance)


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
