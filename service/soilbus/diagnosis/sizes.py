"""Evidence for an effect of which nobody knows how great it is.

The catalogue's prior ranges are those of large effects.  Held to them alone, one with
eight parameters that is there, but small, has to beat eight large penalties, and one
beyond its range another.  So the evidence is that of a mixture: the parameters that say
how great an effect is have, together, one of several times their prior std (a scale
mixture of Gaussians, as heavy-tailed as it is peaked: Andrews & Mallows 1974, J. R. Stat.
Soc. B 36:99).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.effect_parameters import Free

Array = NDArray[np.float64]

SCALES = tuple(2.0**k for k in range(-4, 3))
"""Times the prior std, all as likely."""


def evidence_of_any_size(information: Array, pull: Array, free: Sequence[Free]) -> float:
    """-2 log evidence over that of the effect's absence, from what the data tell of its parameters.

    Of parameters (P,) in units of their prior std the data's log likelihood is
    pull u - u information u / 2, whatever all else may be.
    """
    sized = np.array([f.parameter.neutral == 0.0 for f in free])
    found = [_evidence(information, pull, np.where(sized, scale, 1.0)) for scale in SCALES]
    return float(-2.0 * np.logaddexp.reduce(-0.5 * np.array(found)) + 2.0 * np.log(len(SCALES)))


def correction(pulls: Array, covariance: Array, free: Sequence[Free]) -> float:
    """What that changes of a -2 log evidence found with the prior std themselves, from what the fit came to."""
    precision = np.linalg.inv(covariance)
    information, pull = precision - np.eye(len(pulls)), precision @ pulls
    return evidence_of_any_size(information, pull, free) - _evidence(information, pull, np.ones(len(pulls)))


def _evidence(information: Array, pull: Array, scales: Array) -> float:
    scaled, pull = np.eye(len(pull)) + scales[:, None] * information * scales, scales * pull
    return float(np.linalg.slogdet(scaled)[1] - pull @ np.linalg.solve(scaled, pull))
