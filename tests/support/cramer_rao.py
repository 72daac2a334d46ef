"""Cramer-Rao bound of a window: the least covariance of an unbiased estimate of its soil.

    I = J' R^-1 J + diag(1 / prior var),      cov(log soil) >= [I^-1] of the soil,      all at the true soil

Measured are the samples (truth times one plus a gain error, plus noise); each gain error counts as one measurement of
zero with its sd, each free soil parameter as one measurement by its prior. Unknown are the logarithms of the free
parameters, the gains, and at each instant the loads and speeds, which are eliminated. No unbiased estimator has a
smaller covariance (Kay, Fundamentals of Statistical Signal Processing, vol. I, 1993, sect. 3.7). A biased one may; and
where a window leaves soils far from the true one possible, no estimator may reach the bound.
"""

import numpy as np

from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import PARAMETERS, Posterior, SoilPrior
from soilbus.terra.wheel import Soil

_SOIL = len(PARAMETERS)
_ROUNDS = 3
"""Linearisations that bring the latents from their first guess to their values at the truth."""


def cramer_rao(noiseless: ObservationModel, prior: SoilPrior, soil: Soil) -> Posterior:
    """The Cramer-Rao bound at a soil.

    Parameters
    ----------
    noiseless
        The window as perfect sensors would have measured it, with the variances of the real ones.
    prior
        Only its spread counts.
    soil
        The true soil.

    Returns
    -------
    The true soil with the least covariance of the logarithms.

    Raises
    ------
    numpy.linalg.LinAlgError
        The information is not finite.
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
