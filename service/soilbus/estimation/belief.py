"""What is known of the soil and of the sensors' gain errors, jointly Gaussian."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.posterior import PARAMETERS, Estimate, Posterior, SoilPrior
from soilbus.terra.wheel import Soil

if TYPE_CHECKING:
    from soilbus.estimation.form import FormLeft

Array = NDArray[np.float64]

_SOIL = len(PARAMETERS)
_K_C = PARAMETERS.index("k_c")
FAINT = 1e-3
"""Least share of the variance of log k_c by which data lessen it."""


@dataclass(frozen=True, slots=True)
class Belief:
    """Typical soil (6,) in SI and gain errors (G,), with their covariance (6 + G, 6 + G).

    Typical by its mean in the coordinates in which a window is nearest to Gaussian (see
    `moments`).  The covariance is that of the soil parameters' logarithms and the gains; what is held
    has none.  A window tells combinations of soil and gains, so what it leaves behind is
    kept jointly: gains do not change from window to window, and forgetting them would
    count the same ignorance as news each time.

    With k_c_off it is what data alone told (`apart_from`): Gaussian in k_c, not in its logarithm.
    The covariance then is that of k_c in units of the soil's, and its mean is 1 + k_c_off of these.
    All is of the model's configured form; form is what that leaves open, None where it was not asked for.
    """

    soil: Array
    gains: Array
    covariance: Array
    k_c_off: float | None = None
    form: FormLeft | None = None

    @classmethod
    def of(cls, prior: SoilPrior, gain_std: Array) -> Belief:
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

    def mixed(self, other: Belief, share: float) -> Belief:
        """The same with the spread, about it, of what is this with probability 1 - share and another with share."""
        held = np.diag(self.covariance)[:_SOIL] == 0.0
        off = np.concatenate([np.where(held, 0.0, np.log(other.soil / self.soil)), other.gains - self.gains])
        of_other = other.covariance + np.outer(off, off)
        return replace(self, covariance=(1.0 - share) * self.covariance + share * of_other)

    def given(self, parameter: int, log: float) -> Belief:
        """What is known of everything else if the logarithm of a free parameter is this: held from then on."""
        along = self.covariance[:, parameter] / self.covariance[parameter, parameter]
        covariance = self.covariance - np.outer(along, self.covariance[parameter])
        covariance[parameter] = covariance[:, parameter] = 0.0
        return self.moved(along * (log - np.log(self.soil[parameter])), covariance)

    def moved(self, step: Array, covariance: Array) -> Belief:
        """The same after a step (6 + G,) of the logarithms and gains, with another covariance."""
        soil, gains = self.soil * np.exp(step[:_SOIL]), self.gains + step[_SOIL:]
        if self.k_c_off is None:
            return Belief(soil, gains, covariance)
        soil[_K_C] = self.soil[_K_C]
        return Belief(soil, gains, covariance, self.k_c_off + float(step[_K_C]))

    def apart_from(self, prior: SoilPrior) -> Belief:
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
        return replace(self, k_c_off=0.0).moved(off, self.covariance + np.outer(along, along) / untold)

    def variance_of_k_c(self, prior: SoilPrior) -> float:
        """Of its logarithm, the prior counted in."""
        own = float(self.covariance[_K_C, _K_C])
        return own if self.k_c_off is None else 1.0 / (1.0 / own + float(prior.log_std[_K_C] ** -2))

    def drifted(self, soil: Array, gains: Array) -> Belief:
        """Later: the soil's logarithms may have changed with covariance (6, 6), the gains with variance (G,)."""
        covariance = self.covariance.copy()
        covariance[:_SOIL, :_SOIL] += soil
        covariance[range(_SOIL, len(covariance)), range(_SOIL, len(covariance))] += gains
        return replace(self, covariance=covariance)

    def of_another_soil(self, prior: SoilPrior) -> Belief:
        """What is left on another soil, of which only the prior is known: the gains."""
        covariance = self.covariance.copy()
        covariance[:_SOIL] = covariance[:, :_SOIL] = 0.0
        covariance[range(_SOIL), range(_SOIL)] = prior.log_std**2
        return Belief(prior.median, self.gains, covariance)
