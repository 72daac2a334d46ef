"""Draws of standard normals, and what quantities that are found draw by draw amount to.

A posterior as a few soils, and what its draws have, as predicted from what these soils have.

A polynomial through what the soils have predicts each draw's (response surface, Box & Wilson
1951), along the leading principal directions of the logarithms' covariance.  The first of these
is the ridge on which k_c, k_phi and n replace each other, sd 0.3 to 1.6: along it forces bend
to and fro, so it has points of its own and a higher degree.  What the leading directions
leave is so well known that everything is linear in it: one point for each direction.

Forces over slip are smooth in the soil.  What the vehicle can do is not: a torque limit ends
the pull before the ground does, and the best slip jumps from one top to another.  So it is
found draw by draw.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement

import numpy as np
from numpy.polynomial.hermite_e import hermeval
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.parametrization import MAX_PHI
from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.terra.wheel import Soil

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


LEADING = 3
"""Directions under the polynomial."""
AXIS = (1.2, 3.2)
"""Of the first direction's own points, in standard deviations on both sides of the mode."""
AXIS_DEGREE = 6
_LEAST = 1e-14
"""Variance of a direction, over the largest, below which it counts as held."""
_PHI = Soil._fields.index("phi")


@dataclass(frozen=True, slots=True)
class SigmaPoints:
    """Soils (D, 6), the mode first, and the share (1 + N, D) of each in what the mode and each of N draws have.

    mirror (D,) is the point on the other side of the mode, the point itself where there is none.  The last
    points are one standard deviation away along directions that are independent of all others.
    """

    soils: Array
    share: Array
    mirror: NDArray[np.intp]

    @classmethod
    def of(cls, posterior: Posterior, shifts: Array | None = None) -> SigmaPoints:
        """The points of a posterior; similar posteriors have similar ones, in the same order.

        Each of the shifts (Q, 6), of the logarithms, is part of the posterior's covariance and goes with
        something else that is uncertain, one standard deviation of it: they are the last points.
        """
        along = np.zeros((0, len(posterior.soil))) if shifts is None else shifts
        variance, directions = np.linalg.eigh(posterior.log_covariance - along.T @ along)
        free = np.flatnonzero(variance > _LEAST * max(variance[-1], 0.0))[::-1]
        axes = directions[:, free] * np.sqrt(variance[free])
        axes = axes * np.sign(axes[np.abs(axes).argmax(axis=0), np.arange(len(free))])
        leading = min(len(free), LEADING)
        points = design(leading)
        steps = np.concatenate([points @ axes[:, :LEADING].T, axes[:, LEADING:].T, along])
        soils = np.asarray(posterior.soil) * np.exp(steps)
        soils[1:, _PHI] = np.minimum(soils[1:, _PHI], max(MAX_PHI, posterior.soil.phi))
        return cls(soils, *_shares(leading, len(soils) - len(points)))

    def drawn(self, samples: Array, known: NDArray[np.bool_] | None = None) -> Array:
        """Samples (D, ..., F) at the points, known or not, to the mode and the draws (1 + N, ..., F).

        What is not known at a point is as at its mirror, mirrored about the mode's; where neither is
        known, it is the mode's.  What has one index between the first and the last lies in memory index by index.
        """
        if known is not None and not known.all():
            known = np.broadcast_to(known, samples.shape)
            mirrored = np.where(known[self.mirror], 2.0 * samples[0] - samples[self.mirror], samples[0])
            samples = np.where(known, samples, mirrored)
        if samples.ndim == 3:
            return np.asarray((self.share @ samples.swapaxes(0, 1)).swapaxes(0, 1))
        return np.asarray(self.share @ samples.reshape(len(samples), -1)).reshape(-1, *samples.shape[1:])


@cache
def _shares(leading: int, linear: int) -> tuple[Array, NDArray[np.intp]]:
    """share and mirror of SigmaPoints with this number of directions under the polynomial and beside it."""
    points = design(leading)
    z = normals(leading + linear, leading)
    fit = np.linalg.pinv(_polynomials(points))
    of_draws = np.concatenate([_polynomials(z[:, :leading]) @ fit, z[:, leading:]], axis=1)
    of_draws[:, 0] -= z[:, leading:].sum(axis=1)
    of_mode = np.eye(1, of_draws.shape[1])
    mirror = np.arange(of_draws.shape[1])
    for i, point in enumerate(points):
        mirror[i] = next((j for j, other in enumerate(points) if np.allclose(other, -point)), i)
    return np.concatenate([of_mode, of_draws]), mirror


@cache
def design(n: int) -> Array:
    """Points (P, n) for n independent standard normals, the origin first.

    The vertices of a regular simplex, their mirror images and the middles of its edges, pushed out to
    one sphere, as in the cubature of Lu & Darmofal (2004, SIAM J. Sci. Comput. 26:613); then
    those on the first axis, where a vertex is besides.
    """
    if n == 0:
        return np.zeros((1, 0))
    vertices = np.zeros((n + 1, n))
    for k in range(n):
        vertices[k, k] = math.sqrt((n + 1) * (n - k) / (n * (n - k + 1)))
        vertices[k + 1 :, k] = -math.sqrt((n + 1) / (n * (n - k + 1) * (n - k)))
    i, j = np.triu_indices(n + 1, 1)
    middles = vertices[i] + vertices[j] if n > 1 else np.zeros((0, 1))  # of one edge, the origin
    middles = middles / np.linalg.norm(middles, axis=1, keepdims=True)
    on_axis = np.outer([*AXIS, *np.negative(AXIS)], np.eye(1, n))
    sphere = math.sqrt(n + 2.0) * np.concatenate([vertices, -vertices, middles])
    return np.concatenate([np.zeros((1, n)), sphere, on_axis])


def _polynomials(x: Array) -> Array:
    """Orthonormal polynomials of standard normals (P, n): (P, terms).

    All to degree two, those of the first to AXIS_DEGREE, and its square times each other one, which the
    points of two directions do not tell from that one itself.
    """
    n = x.shape[1]
    degrees = [d for d in itertools.product(range(3), repeat=n) if sum(d) <= 2]
    if n:
        degrees += [(d, *(0,) * (n - 1)) for d in range(3, AXIS_DEGREE + 1)]
        degrees += [(2, *(int(i == k) for i in range(1, n))) for k in range(1, n) if n > 2]
    terms = [math.prod((_hermite(column, d) for column, d in zip(x.T, of, strict=True)), start=1.0) for of in degrees]
    return np.stack([np.broadcast_to(term, len(x)) for term in terms], axis=1)


def _hermite(x: Array, degree: int) -> Array:
    """Hermite polynomial with variance one under a standard normal."""
    return np.asarray(hermeval(x, np.eye(degree + 1)[degree]) / math.sqrt(math.factorial(degree)))
