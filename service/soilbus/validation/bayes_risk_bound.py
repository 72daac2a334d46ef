"""The least error of any estimate of a window's soil, by the Cramér-Rao bounds of all soils that the window allows.

At any one soil an estimate may be as good as one likes, by always saying this soil.  But an error in
units of the bound of the soil that is the true one, squared and averaged over soils by any weights that do not
depend on the window, is least for the mean of these soils by their posterior probability times
the weight over the squared bound (Berger, Statistical Decision Theory and Bayesian Analysis, 1985,
sect. 4.4.2).  And what no estimate goes below on average, none goes below on all these soils: the greatest of
these averages is closest to what the best estimate must allow somewhere (ibid., sect. 5.3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array

WEIGHT_POWERS = (-1.0, 0.0, 1.0, 2.0)
"""Powers of the bound that soils are weighed down by: the greater, the more those count that are told well."""
UNWEIGHTED = WEIGHT_POWERS.index(0.0)
MAX_SUM_OF_SQUARED_SHARES = 0.5
"""Greatest weight that a few samples may have, squared and summed, for the error about their mean to be known."""


class BayesRisk(NamedTuple):
    """What a posterior's samples say of quantities (Q,), of which `effective` many are independent.

    error (Q,): of the estimate with the least mean square error in units of the bounds; risk and weight
    (TILTS, Q): that error's mean square times the weight of the soils, and this weight, whose sums over windows
    give the average.
    """

    error: Array
    risk: Array
    weight: Array
    effective: float


def bayes_risk(value: Array, share: Array, bound: Array, truth: Array) -> BayesRisk:
    """From samples' logarithms (M, Q), their shares (M,) of the probability and bounds (M, Q), and the truth (Q,)."""
    bound = np.where(bound > 0.0, bound, 1.0)  # of what is held
    tilt = np.array(WEIGHT_POWERS)[:, None, None]
    weight = share[:, None] * bound**-tilt
    counted = weight / bound**2
    part = counted / counted.sum(axis=1, keepdims=True)
    best = (part * value).sum(axis=1)
    own = np.minimum((part**2).sum(axis=1), MAX_SUM_OF_SQUARED_SHARES)  # the mean is theirs, too
    risk = (counted * (value - best[:, None]) ** 2).sum(axis=1) / (1.0 - own)
    return BayesRisk(best[UNWEIGHTED] - truth, risk, weight.sum(axis=1), float(1.0 / (share @ share)))
