"""A posterior as a few soils, and what its draws have, as foretold from what these soils have.

A polynomial through what the soils have tells each draw's (response surface, Box & Wilson
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

import numpy as np
from numpy.polynomial.hermite_e import hermeval
from numpy.typing import NDArray

from soilbus.capability.draws import normals
from soilbus.estimation.posterior import Posterior
from soilbus.terra.wheel import Soil

Array = NDArray[np.float64]

LEADING = 3
"""Directions under the polynomial."""
AXIS = (1.2, 3.2)
"""Of the first direction's own points, in standard deviations on both sides of the mode."""
AXIS_DEGREE = 6
MAX_PHI = 1.2
"""Friction angle [rad] at which points are held back: the model ends at a right angle."""
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
    """share and mirror of SigmaPoints with so many directions under the polynomial and beside it."""
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
