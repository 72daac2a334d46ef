"""What is known of the soil and of the sensors' gain errors, jointly Gaussian."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.posterior import PARAMETERS, Estimate, Posterior, SoilPrior
from soilbus.terra.wheel import Soil

Array = NDArray[np.float64]

_SOIL = len(PARAMETERS)


@dataclass(frozen=True, slots=True)
class Belief:
    """Typical soil (6,) in SI and gain errors (G,), with their covariance (6 + G, 6 + G).

    Typical by its mean in the coordinates in which a window is nearest to Gaussian (see
    `moments`).  The covariance is that of the soil parameters' logarithms and the gains; what is held
    has none.  A window tells combinations of soil and gains, so what it leaves behind is
    kept jointly: gains do not change from window to window, and forgetting them would
    count the same ignorance as news each time.
    """

    soil: Array
    gains: Array
    covariance: Array

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
        off = along * (log - np.log(self.soil[parameter]))
        covariance = self.covariance - np.outer(along, self.covariance[parameter])
        covariance[parameter] = covariance[:, parameter] = 0.0
        return Belief(self.soil * np.exp(off[:_SOIL]), self.gains + off[_SOIL:], covariance)

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
