"""Draws of standard normals, and what quantities that are found draw by draw amount to."""

from __future__ import annotations

import math
from functools import cache
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.posterior import Estimate

Array = NDArray[np.float64]

DRAWS = 256
SEED = 12
"""Of sixty the one with the least error in the std of random quadratics of six normals that a limit cuts: 2.5 % rms."""
MOMENTS = (1.0, 0.0, 1.0, 0.0, 3.0, 0.0, 15.0)
"""Of a standard normal, by degree."""
ROUNDS = 30
EXACT = 1e-10


@cache
def normals(n: int, leading: int) -> Array:
    """Standard normals (DRAWS, n), each beside its mirror image, whose covariance is the identity.

    They are random ones, moved as little as gives the leading columns all moments of standard
    normals to degree five, and the first one to degree seven: so polynomials have nearly the
    variance that they should have.
    """
    if n == 0:
        return np.zeros((DRAWS, 0))
    z = np.random.default_rng(SEED).standard_normal((DRAWS // 2, n))
    degrees = _degrees(n, leading)
    wanted = np.prod(np.array(MOMENTS)[degrees], axis=1)
    for _ in range(ROUNDS):
        value, slopes = _monomials(z, degrees)
        off = value.mean(axis=1) - wanted
        if np.abs(off).max() < EXACT:
            break
        by_all = slopes.reshape(len(slopes), -1) / len(z)
        z = z - (by_all.T @ np.linalg.solve(by_all @ by_all.T, off)).reshape(z.shape)
    return np.stack([z, -z], axis=1).reshape(DRAWS, n)


def _degrees(n: int, leading: int) -> NDArray[np.intp]:
    """Of each of n columns in the monomials whose mean is exact (Q, n); those of odd degree are so by symmetry."""
    factors = [*combinations_with_replacement(range(n), 2), *combinations_with_replacement(range(leading), 4)]
    return np.array([np.bincount(each, minlength=n) for each in [*factors, *[(0,) * 6][:leading]]])


def _monomials(z: Array, degrees: NDArray[np.intp]) -> tuple[Array, Array]:
    """Monomials (Q, P) of these degrees at points (P, n), and their derivatives (Q, P, n)."""
    powers = z ** np.arange(len(MOMENTS))[:, None, None]
    column = np.arange(z.shape[1])
    value = powers[degrees, :, column].prod(axis=1)
    lower = np.maximum(degrees[:, None] - np.eye(len(column), dtype=int), 0)
    slopes = degrees[..., None] * powers[lower, :, column].prod(axis=2)
    return value, slopes.transpose(0, 2, 1)


def mean_and_std(samples: Array) -> tuple[Array, Array]:
    """Of samples (1 + N, ...), the mode's and then the draws', over those draws that have a value (not nan).

    The mean is nan where the mode or most draws have none.
    """
    change = samples[1:] - samples[0]
    known = np.isfinite(change)
    if known.all():
        mean = change.mean(axis=0)
        return samples[0] + mean, np.sqrt(((change - mean) ** 2).mean(axis=0))
    count = known.sum(axis=0)
    of_count = 1.0 / np.maximum(count, 1)
    mean = np.where(known, change, 0.0).sum(axis=0) * of_count
    square = (np.where(known, change - mean, 0.0) ** 2).sum(axis=0) * of_count
    return np.where(2 * count > len(change), samples[0] + mean, np.nan), np.sqrt(square)


def estimates(*samples: Array | None) -> list[Estimate | None]:
    """Scalars from their samples (1 + N,) each, as `mean_and_std`; None where there are none or the mean is nan.

    What befalls fewer than one soil in a hundred is hardly in a std.
    """
    known = [each for each in samples if each is not None]
    if not known:
        return [None] * len(samples)
    found = zip(*(a.tolist() for a in mean_and_std(np.stack(known, axis=1))), strict=True)
    return [None if each is None else _known(*next(found)) for each in samples]


def likely(samples: Array | None) -> Estimate | None:
    """A scalar's value at the mode and the std of what changes sign with the soil, from its samples (1 + N,).

    Mean-value first-order reliability (Cornell 1969).  It knows no curvature, and so gives the
    median of what bends only.  The mean does not: what is hardly known lies along a curved valley
    of the likelihood, which straight directions leave, and what bends there looks certain to grow.
    A draw without a value has its mirror image's, mirrored about the mode's.
    """
    if samples is None:
        return None
    change = (samples[1:] - samples[0]).reshape(-1, 2)
    change = np.where(np.isnan(change), -change[:, ::-1], change)
    odd = 0.5 * (change[:, 0] - change[:, 1])
    known = odd[np.isfinite(odd)]
    return _known(float(samples[0]), math.sqrt(float((known**2).sum()) / max(len(known), 1)))


def _known(value: float, std: float) -> Estimate | None:
    return Estimate(value, std) if math.isfinite(value) else None
