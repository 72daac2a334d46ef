"""Mean and covariance of a posterior along the share of k_c in K_L, which short windows tell badly.

Tyres of different width tell the share s of k_c in K_L = k_c/b + k_phi, and the model is
all but linear in it; what was known before is Gaussian in log k_c and log k_phi, and so in
log s and log (1 - s) given K_L.  Where the data tell s well, all that is one Gaussian.  Where
they do not, the posterior of log s falls off fast towards large s and as slowly as the
prior towards small s: the curvature at its mode says little of its spread, and less of
that of k_phi and n, which make up for k_c.  Given s the rest is Gaussian, so an integral
over s alone gives its moments (cf. Rue, Martino & Chopin, J. R. Stat. Soc. B 71, 2009, 319).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NODES = 81
REACH = 6.0
"""How far the integral goes, in standard deviations of log s by what was known before."""
MAX_SHARE = 0.99


class Moments(NamedTuple):
    """Mean (P,) of deviations from the mode and covariance (P, P) about the mean: log s, then the others."""

    mean: Array
    covariance: Array


def moments_along_share(quadratic: Array, gradient: Array, share: float) -> Moments | None:
    """Moments of a posterior with its mode at this share; None where the others are not determined.

    With d the deviation of log s and o (P - 1,) those of the others, -2 log posterior is
    z' quadratic z + 2 gradient' z, up to a constant, for z (P + 2,) of the changes of s (over
    s), log s and log (1 - s), and o.
    """
    told = np.diag(quadratic)[3:]
    if not np.all(told > 0.0):
        return None
    scale = 1.0 / np.sqrt(told)
    scaled = quadratic[3:, 3:] * np.outer(scale, scale)
    try:
        np.linalg.cholesky(scaled)  # rounding may have left it without
        inverse = np.linalg.inv(scaled) * np.outer(scale, scale)
    except np.linalg.LinAlgError:
        return None
    along = -inverse @ quadratic[3:, :3]
    own = quadratic[:3, :3] + quadratic[:3, 3:] @ along
    first, second = _over_share(own, gradient[:3] + along.T @ gradient[3:], share)
    spread = np.vstack([[0.0, 1.0, 0.0], along])
    mean, covariance = spread @ first, spread @ second @ spread.T
    mean[1:] -= inverse @ gradient[3:]
    covariance[1:, 1:] += inverse
    return Moments(mean, covariance) if np.isfinite(covariance).all() else None


def _over_share(own: Array, slope: Array, share: float) -> tuple[Array, Array]:
    """Mean (3,) of the changes of s, log s and log (1 - s), and covariance (3, 3) about it.

    The mean is that over log k_c and log k_phi, as the prior counts.  The covariance is taken with Jeffreys'
    measure, the root of the information there: intervals then hold a soil as often as
    they say also where the data tell s and the prior does not (Welch & Peers, J. R. Stat.
    Soc. B 25, 1963, 318).
    """
    at_mode = np.array([1.0, 1.0, -share / (1.0 - share)])
    scale = 1.0 / np.sqrt(at_mode @ own @ at_mode)
    widest = np.arcsinh(REACH / np.sqrt(own[1, 1]) / scale)
    at = np.linspace(-widest, widest, NODES)
    d = np.minimum(scale * np.sinh(at), np.log(MAX_SHARE / share))
    left = 1.0 - share * np.exp(d)
    changes = np.stack([np.expm1(d), d, np.log(left / (1.0 - share))])
    slopes = np.stack([np.exp(d), np.ones(NODES), 1.0 - 1.0 / left])
    cost = (changes * (own @ changes)).sum(0) + 2.0 * slope @ changes
    density = np.cosh(at) * (scale * np.sinh(at) <= d) * np.exp(-0.5 * (cost - cost.min()))
    of_prior = density / left
    mean = changes @ of_prior / of_prior.sum()
    density *= np.sqrt((slopes * (own @ slopes)).sum(0))
    off = changes - mean[:, None]
    return mean, (off * density / density.sum()) @ off.T
