"""A posterior of the soil as a few sigma points, and mean and standard deviation of what follows from them.

    log soil_ij = log mode + x_j L_i             L_i: principal axis i with one sd, x_j: nodes of Gauss and Hermite
    g(soil)     = g_0 + sum_i (g_i(x_i) - g_0)   g_i: along one axis alone (univariate dimension reduction)
    mean        = g_0 + sum_i m_i                m_i = sum_j w_j (g_ij - g_0)
    variance    = sum_i (sum_j w_j (g_ij - g_0)^2 - m_i^2)

Rahman & Xu 2004, Probabilistic Engineering Mechanics 19:393.  K_L = k_c / b + k_phi has a logarithm that is linear
along an axis, too; k_c is at most all of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial.hermite_e import hermegauss
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.parametrization import MAX_PHI
from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.terra.wheel import Soil

NODES = 3
"""Number of nodes along an axis.  With 5 and 7 along the first one the largest draft's sd is the same to 1 N where that
axis has an sd of 0.14 to 0.57; where it has 0.9 it is 1 167, 1 010 and 1 157 N, and 1 170 N by Monte Carlo."""
_HELD_VARIANCE_RATIO = 1e-14
"""Variance of an axis over the largest one, below which the axis counts as known exactly."""
LEAST_K_PHI = 1e-3
"""Least share of K_L that k_phi has at a point [1]: no force shows less."""
NO_SHIFTS = np.zeros((0, len(Soil._fields)))
_K_C, _K_PHI, _PHI = (Soil._fields.index(name) for name in ("k_c", "k_phi", "phi"))


@dataclass(frozen=True, slots=True)
class SigmaPoints:
    """Sigma points of a posterior, with the weights of values at them in a mean and a variance.

    soils (D, 6): the mode first; the last points are one standard deviation away along directions that are independent
    of all others, in which everything is linear.  weight (D,): of squares.  of_axis (Q, D): weights of an axis'
    mean.  mirror (D,): index of the point on the other side of the mode; its own index where there is none.
    """

    soils: Array
    weight: Array
    of_axis: Array
    mirror: NDArray[np.intp]

    @classmethod
    def of(cls, posterior: Posterior, shifts: Array = NO_SHIFTS, width: float | None = None) -> SigmaPoints:
        """Return the points of a posterior; similar posteriors have similar points in the same order.

        shifts (Q, 6): changes of the logarithms with one sd of Q other uncertain quantities, whose outer products are
        part of the posterior's covariance; they are the last points.  width: mean tyre width b [m], which makes K_L
        known where k_phi is a small part of it and its logarithm open; without it k_c and k_phi follow their logarithms
        alone.
        """
        variance, directions = np.linalg.eigh(posterior.log_covariance - shifts.T @ shifts)
        free = np.flatnonzero(variance > _HELD_VARIANCE_RATIO * max(variance[-1], 0.0))[::-1]
        axes = directions[:, free] * np.sqrt(variance[free])
        axes = axes * np.sign(axes[np.abs(axes).argmax(axis=0), np.arange(len(free))])
        nodes, weight, of_axis, mirror = _design(len(free), len(shifts))
        steps = np.concatenate([nodes @ axes.T, shifts])
        soils = np.asarray(posterior.soil) * np.exp(steps)
        if width is not None:
            soils[:, [_K_C, _K_PHI]] = _moduli(posterior.soil, steps, width)
        soils[1:, _PHI] = np.minimum(soils[1:, _PHI], max(MAX_PHI, posterior.soil.phi))
        return cls(soils, weight, of_axis, mirror)

    def filled(self, samples: Array, known: NDArray[np.bool_]) -> Array:
        """Return values (D, ...), each unknown one (a mask that broadcasts) mirrored about the mode's.

        Where the value on the other side is not known either, it is the mode's.
        """
        if known.all():
            return samples
        known = np.broadcast_to(known, samples.shape)
        mirrored = np.where(known[self.mirror], 2.0 * samples[0] - samples[self.mirror], samples[0])
        return np.where(known, samples, mirrored)

    def mean_and_std(self, samples: Array) -> tuple[Array, Array]:
        """Return the mean and standard deviation (...,) of values (D, ...); nan where the mode has no value."""
        change = self._changes(samples)
        flat = change.reshape(len(change), -1)
        of_axis = self.of_axis @ flat
        variance = self.weight @ flat**2 - (of_axis**2).sum(axis=0)
        mean, std = of_axis.sum(axis=0), np.sqrt(np.maximum(variance, 0.0))
        return samples[0] + mean.reshape(change.shape[1:]), np.where(
            np.isfinite(samples[0]), std.reshape(change.shape[1:]), np.nan
        )

    def estimates(self, *samples: Array | None) -> list[Estimate | None]:
        """Return the mean and std of scalars from their samples (D,) each; None without samples or with nan."""
        known = [each for each in samples if each is not None]
        if not known:
            return [None] * len(samples)
        found = iter(np.stack(self.mean_and_std(np.stack(known, axis=1)), axis=1).tolist())
        pairs = [(math.nan, math.nan) if each is None else next(found) for each in samples]
        return [Estimate(mean, std) if math.isfinite(mean) else None for mean, std in pairs]

    def likely(self, samples: Array | None) -> Estimate | None:
        """Return a first-order estimate of a scalar (D,): its value at the mode and the std of its odd part.

        Mean-value first-order reliability (Cornell 1969, ACI Journal 66:974): the median of a monotonic function.  A
        mean would not do for probabilities: along the curved valley of poorly determined soils its second-order term
        looks like a certain increase.
        """
        if samples is None or not math.isfinite(samples[0]):
            return None
        change = self._changes(samples)
        alone = self.mirror == np.arange(len(change))
        odd = np.where(alone, change, 0.5 * (change - change[self.mirror]))
        return Estimate(float(samples[0]), math.sqrt(float(self.weight @ odd**2)))

    def _changes(self, samples: Array) -> Array:
        """Values (D, ...) less the mode's, with the other side's sign changed where there is none (nan), else 0."""
        change = samples - samples[0]
        return np.asarray(np.nan_to_num(np.where(np.isnan(change), -change[self.mirror], change)))


def _moduli(soil: Soil, steps: Array, width: float) -> Array:
    """k_c and k_phi (D, 2) after steps (D, 6) of the logarithms, along which log K_L changes linearly."""
    part, whole = soil.k_c / width, soil.k_c / width + soil.k_phi
    K_L = whole * np.exp((part * steps[:, _K_C] + soil.k_phi * steps[:, _K_PHI]) / whole)
    of_k_c = np.minimum(part * np.exp(steps[:, _K_C]), (1.0 - LEAST_K_PHI) * K_L)
    return np.stack([of_k_c * width, K_L - of_k_c], axis=1)


@cache
def _design(axes: int, shifts: int) -> tuple[Array, Array, Array, NDArray[np.intp]]:
    """Nodes (P, axes) in standard deviations; weight, of_axis and mirror of SigmaPoints, shifts included."""
    nodes, weights = hermegauss(NODES)
    apart = nodes != nodes[NODES // 2]  # the mode is the middle node of all axes
    x, w = (np.concatenate([[0.0], np.tile(v[apart], axes)]) for v in (nodes, weights / weights.sum()))
    axis = np.repeat(np.arange(axes), NODES - 1)
    on = np.concatenate([np.zeros((1, axes)), np.eye(axes)[axis]])
    points = len(x)
    other = [int(np.flatnonzero(on[:, of] * np.isclose(x, -x[1 + i]))[0]) for i, of in enumerate(axis)]
    mirror = np.array([0, *other, *range(points, points + shifts)], np.intp)
    of_axis = np.concatenate([(on * w[:, None]).T, np.zeros((axes, shifts))], axis=1)
    return on * x[:, None], np.concatenate([w, np.ones(shifts)]), of_axis, mirror
