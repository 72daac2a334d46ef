"""Bayes-risk bound: the least error of any estimate of a window's soil, from posterior samples.

    loss  L(x, theta) = (x - theta)^2 / b(theta)^2                      b: Cramer-Rao bound at theta
    best  x* = E[theta w / b^2] / E[w / b^2],    w = b^(-p)             p: WEIGHT_POWERS
    risk  E[w L(x*, theta)] / E[w]

At one soil alone an estimate can be arbitrarily good, by always returning that soil. Averaged over soils with weights
that do not depend on the window, the posterior mean above has the least risk (Berger, Statistical Decision Theory and
Bayesian Analysis, 1985, sect. 4.4.2). What no estimate goes below on average, none goes below on all these soils, so
the greatest of these averages is the bound (ibid., sect. 5.3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array

WEIGHT_POWERS = (-1.0, 0.0, 1.0, 2.0)
"""Powers p of the weights b^(-p): the greater, the more the soils with small Cramer-Rao bounds count."""
UNWEIGHTED = WEIGHT_POWERS.index(0.0)
"""Index of the power 0, at which all soils count alike."""
MAX_SUM_OF_SQUARED_SHARES = 0.5
"""Greatest sum of squared shares that the correction for few samples, 1 / (1 - sum), assumes."""


class BayesRisk(NamedTuple):
    """Bayes risk of one window for quantities (Q,).

    Attributes
    ----------
    error
        Error (Q,) of the estimate with the least mean square error in units of the bounds.
    risk, weight
        (WEIGHT_POWERS, Q): weighted mean square error and weight; the ratio of their sums over windows is the risk.
    effective
        Number of independent samples with the same information.
    """

    error: Array
    risk: Array
    weight: Array
    effective: float


def bayes_risk(value: Array, share: Array, bound: Array, truth: Array) -> BayesRisk:
    """Bayes risk from posterior samples.

    Parameters
    ----------
    value
        Logarithms (M, Q).
    share
        Posterior probabilities (M,).
    bound
        Cramer-Rao bounds at the samples (M, Q), as standard deviations.
    truth
        Logarithms (Q,).
    """
    bound = np.where(bound > 0.0, bound, 1.0)  # of what is held
    tilt = np.array(WEIGHT_POWERS)[:, None, None]
    weight = share[:, None] * bound**-tilt
    counted = weight / bound**2
    part = counted / counted.sum(axis=1, keepdims=True)
    best = (part * value).sum(axis=1)
    own = np.minimum((part**2).sum(axis=1), MAX_SUM_OF_SQUARED_SHARES)  # the mean is theirs, too
    risk = (counted * (value - best[:, None]) ** 2).sum(axis=1) / (1.0 - own)
    return BayesRisk(best[UNWEIGHTED] - truth, risk, weight.sum(axis=1), float(1.0 / (share @ share)))
