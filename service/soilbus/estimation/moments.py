"""Moments of a posterior along a parameter that a window tells badly.

The model is all but linear in k_c itself, while what was known of it before is Gaussian
in its logarithm.  Where the window tells k_c well both are one; where it does not, the
posterior of the logarithm leans: it falls off as fast as the data say towards large k_c
and as slowly as the prior towards small ones.  The curvature at its mode then says little
of its spread, nor of that of k_phi and n, which make up for k_c.  All else being Gaussian
given k_c, one integral over k_c gives mean and covariance (a Laplace approximation nested
in a quadrature; cf. Rue, Martino & Chopin, J. R. Stat. Soc. B 71, 2009, 319-392).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NODES = 81
REACH = 6.0
"""Conditional standard deviations of what was known before, on either side of the mode."""


def leaning_moments(quadratic: Array, gradient: Array) -> tuple[Array, Array] | None:
    """Mean (P,) and covariance (P, P) of deviations from the mode: of a logarithm d, then of P - 1 others o.

    -2 log density is z' quadratic z + 2 gradient' z with z = (exp(d) - 1, d, o), up to a
    constant; quadratic is (P + 1, P + 1), gradient (P + 1,).  None where it has no bounds.
    """
    try:
        inverse = np.linalg.inv(quadratic[2:, 2:])
    except np.linalg.LinAlgError:
        return None
    along = -inverse @ quadratic[2:, :2]
    own = quadratic[:2, :2] + quadratic[:2, 2:] @ along
    slope = gradient[:2] + along.T @ gradient[2:]
    curvature = own.sum() + slope[0]
    if not (np.isfinite(curvature) and own[1, 1] > 0.0):
        return None
    mean, covariance = _of_both(own, slope, 1.0 / np.sqrt(max(curvature, own[1, 1])), REACH / np.sqrt(own[1, 1]))
    spread = np.concatenate([[[0.0, 1.0]], along])
    rest = np.zeros((len(spread), len(spread)))
    rest[1:, 1:] = inverse
    return spread @ mean - rest[:, 1:] @ gradient[2:], spread @ covariance @ spread.T + rest


def _of_both(own: Array, slope: Array, scale: float, reach: float) -> tuple[Array, Array]:
    """Mean (2,) and covariance (2, 2) of exp(d) - 1 and d, of scale near the mode and not beyond the reach."""
    widest = np.arcsinh(reach / scale)
    at = np.linspace(-widest, widest, NODES)
    d = scale * np.sinh(at)
    both = np.stack([np.expm1(d), d])
    cost = np.einsum("in,ij,jn->n", both, own, both) + 2.0 * slope @ both
    weight = np.cosh(at) * np.exp(-0.5 * (cost - cost.min()))
    weight /= weight.sum()
    mean = both @ weight
    off = both - mean[:, None]
    return mean, (off * weight) @ off.T
