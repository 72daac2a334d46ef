"""The Cramér-Rao bound of a window: how well its soil can be known at all.

What is measured: the readings (truth times one plus the sensor's gain error, plus noise);
gain errors, once each, as zero with their std; and the free soil parameters, once each, as
the prior's median with its spread (so a prior is a measurement like any other, and the bound
holds where its median is off by as much as it says).  What is unknown: the logarithms of
the free parameters, the gains, and at each instant the loads and speeds.  The bound is the
part of the inverse information of all that, taken at the truth, that belongs to the soil:
no unbiased estimator has a smaller covariance (Kay, Fundamentals of Statistical Signal
Processing, vol. I, 1993, sect. 3.7).  A biased one may, for instance where the prior keeps
a parameter from going astray; and where the window tells so little that the bound spans
soils of which the truth is not typical, none may reach it.
"""

from __future__ import annotations

import numpy as np

from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import PARAMETERS, Posterior, SoilPrior
from soilbus.terra.wheel import Soil

_SOIL = len(PARAMETERS)
_ROUNDS = 3
"""Linearisations that bring the latents from their first guess to their values at the truth."""


def cramer_rao(noiseless: ObservationModel, prior: SoilPrior, soil: Soil) -> Posterior:
    """The true soil with the least covariance of the logarithms that an unbiased estimate can have.

    `noiseless` holds what perfect sensors would have read in the window, with the variances
    of the real ones.  Only the spread of the prior counts, not its median.  Raises
    numpy.linalg.LinAlgError where the information is not finite.
    """
    no_gains = np.zeros(len(noiseless.gain_std))
    latents = noiseless.start(soil)
    for _ in range(_ROUNDS):
        at = noiseless.linearise(soil, no_gains, latents)
        latents = noiseless.updated(at, latents, np.zeros(_SOIL), no_gains)
    known = np.concatenate([prior.log_std, noiseless.gain_std])
    unknown = np.flatnonzero(known > 0.0)
    by_log = np.concatenate([np.asarray(soil), np.ones(len(no_gains))])
    information = (at.normal[1:, 1:] * np.outer(by_log, by_log))[np.ix_(unknown, unknown)]
    information += np.diag(1.0 / known[unknown] ** 2)
    if not np.isfinite(information).all():
        raise np.linalg.LinAlgError("the model is not finite at this soil")
    free = unknown[unknown < _SOIL]
    covariance = np.zeros((_SOIL, _SOIL))
    covariance[np.ix_(free, free)] = np.linalg.inv(information)[: len(free), : len(free)]
    return Posterior(soil, covariance)
