"""What is known of the soil and of the sensors' gain errors, jointly Gaussian."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.posterior import PARAMETERS, Posterior, SoilPrior
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
