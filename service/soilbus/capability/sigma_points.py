"""A posterior as a few soils, and the mean and standard deviation of what follows from them.

The leading principal directions of the logarithms' covariance carry a cubature that is
exact for polynomials of degree five (Lu & Darmofal 2004, SIAM J. Sci. Comput. 26:613, n^2 + 3n + 3
points): logarithms uncertain by half do not act one by one.  What is left is so well
known that everything is linear in it: one point for each direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.terra.wheel import Soil

Array = NDArray[np.float64]

LEADING = 4
"""Directions under the cubature."""
MAX_PHI = 1.2
"""Friction angle [rad] at which points are held back: the model ends at a right angle."""
_LEAST = 1e-14
"""Variance of a direction, over the largest, below which it counts as held."""
_PHI = Soil._fields.index("phi")


@dataclass(frozen=True, slots=True)
class SigmaPoints:
    """Soils (D, 6), the mode first; weight (P,) of the first P: the mode, then pairs that mirror each other.

    The rest are single points, one standard deviation away along a direction that is independent of all others.
    """

    soils: Array
    weight: Array

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
        points, weight = cubature(min(len(free), LEADING))
        steps = np.concatenate([points @ axes[:, :LEADING].T, axes[:, LEADING:].T, along])
        soils = np.asarray(posterior.soil) * np.exp(steps)
        soils[1:, _PHI] = np.minimum(soils[1:, _PHI], max(MAX_PHI, posterior.soil.phi))
        return cls(soils, weight)

    def mean_and_std(self, samples: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (...) of quantities given at the points (D, ...).

        A point without a value (nan) gets its mirror image's, mirrored about the mode's;
        where both have none, and wherever the mode has none, the mean is nan.
        """
        mode, near, linear = self._changes(samples)
        shift = self.weight[1:] @ near
        variance = self.weight[1:] @ near**2 - shift**2 + (linear**2).sum(axis=0)
        shape = samples.shape[1:]
        return (mode + shift).reshape(shape), np.sqrt(np.maximum(variance, 0.0)).reshape(shape)

    def first_order(self, samples: Array) -> tuple[float, float]:
        """Value at the mode and standard deviation of what changes sign with the soil, of samples (D,).

        Mean-value first-order reliability (Cornell 1969).  It knows no curvature, and so gives the
        median of what bends only.  The mean does not: what is hardly known lies along a curved valley
        of the likelihood, which straight directions leave, and what bends there looks certain to grow.
        """
        mode, near, linear = self._changes(samples)
        odd = 0.5 * (near - near[np.arange(len(near)) ^ 1])
        return float(mode[0]), math.sqrt(float((self.weight[1:] @ odd**2 + (linear**2).sum(axis=0))[0]))

    def _changes(self, samples: Array) -> tuple[Array, Array, Array]:
        """Samples (D, ...) at the mode (Q,), and how those under the cubature and in the other directions differ."""
        flat = samples.reshape(len(samples), -1)
        mode, n = flat[0], len(self.weight)
        change = flat[1:] - mode
        near, linear = change[: n - 1], change[n - 1 :]
        if np.isnan(change).any():
            near = np.where(np.isnan(near), -near[np.arange(n - 1) ^ 1], near)
            linear = np.where(np.isnan(linear), 0.0, linear)
        return mode, near, linear

    def likely(self, samples: Array | None) -> Estimate | None:
        """A scalar's median and spread of first order from its samples (D,); None as `estimates`."""
        return None if samples is None else _known(*self.first_order(samples))

    def estimates(self, *samples: Array | None) -> list[Estimate | None]:
        """Scalars from their samples (D,) each; None where there are none or the mean is not known."""
        known = [each for each in samples if each is not None]
        if not known:
            return [None] * len(samples)
        found = zip(*(a.tolist() for a in self.mean_and_std(np.stack(known, axis=1))), strict=True)
        return [None if each is None else _known(*next(found)) for each in samples]


def _known(value: float, std: float) -> Estimate | None:
    return Estimate(value, std) if math.isfinite(value) else None


@cache
def cubature(n: int) -> tuple[Array, Array]:
    """Points (P, n) and weights (P,) of degree five for n independent standard normals, the origin first.

    The vertices of a regular simplex and the middles of its edges, pushed out to two
    spheres, each beside its mirror image.
    """
    if n == 0:
        return np.zeros((1, 0)), np.ones(1)
    vertices = np.zeros((n + 1, n))
    for k in range(n):
        vertices[k, k] = math.sqrt((n + 1) * (n - k) / (n * (n - k + 1)))
        vertices[k + 1 :, k] = -math.sqrt((n + 1) / (n * (n - k + 1) * (n - k)))
    i, j = np.triu_indices(n + 1, 1)
    if n == 1:
        i, j = i[:0], j[:0]  # the middle is the origin
    middles = math.sqrt(n / (2.0 * max(n - 1, 1))) * (vertices[i] + vertices[j])
    outer = math.sqrt(n + 2.0) * np.concatenate([vertices, middles])
    weight = np.concatenate([
        np.full(2 * (n + 1), n**2 * (7.0 - n) / (2.0 * (n + 1) ** 2 * (n + 2) ** 2)),
        np.full(2 * len(middles), 2.0 * (n - 1) ** 2 / ((n + 1) ** 2 * (n + 2) ** 2)),
    ])  # fmt: skip
    points = np.stack([outer, -outer], axis=1).reshape(-1, n)
    return np.concatenate([np.zeros((1, n)), points]), np.concatenate([[2.0 / (n + 2.0)], weight])
