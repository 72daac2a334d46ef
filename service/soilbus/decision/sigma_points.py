"""A posterior of the soil as a few sigma points, and mean and standard deviation of what follows from them.

    log soil_d = log mode + L x_d                   x_d: points of a design along principal directions, d = 1..D
    K_L = k_c / b + k_phi                           its logarithm is linear in x_d, too; k_c is at most all of it
    f(draw) = sum_d share(draw, d) f(soil_d)        response surface (Box & Wilson 1951): polynomial through them
    mean, std of g(f)                               over 256 draws of standard normals with exact low moments

The first principal direction of the logarithms' covariance is the ridge on which k_c, k_phi and n replace each other
(sd 0.3 to 1.6): forces are strongly nonlinear along it, so it has points of its own and degree 6.  In directions behind
the leading ones everything is linear: one point each.  Forces over slip (f) are smooth in the soil.  What the vehicle
can do (g) is not: a torque limit ends the pull before the ground does.  So g is evaluated draw by draw.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial.hermite_e import hermevander
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.parametrization import MAX_PHI
from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.terra.wheel import Soil

DRAWS = 256
"""Number of draws: half of them and their mirror images."""
SEED = 12
"""Seed of the draws: of sixty, the one with the least error of the std of random quadratics of six normals that a
limit cuts (2.5 % rms)."""
NORMAL_MOMENTS = (1.0, 0.0, 1.0, 0.0, 3.0, 0.0, 15.0)
"""Moments of a standard normal, by degree."""
GAUSS_NEWTON_STEPS = 30
"""Steps that make the draws' moments exact."""
LEADING_DIRECTIONS = 3
"""Number of principal directions in which the response surface is a polynomial."""
FIRST_AXIS_POINTS = (1.2, 3.2)
"""Distances of the first direction's own points from the mode, on both sides, in standard deviations."""
FIRST_AXIS_DEGREE = 6
"""Degree of the polynomial along the first direction."""
_HELD_VARIANCE_RATIO = 1e-14
"""Variance of a direction over the largest one, below which the direction counts as known exactly."""
LEAST_K_PHI = 1e-3
"""Least share of K_L that k_phi has at a point [1]: no force shows less."""
NO_SHIFTS = np.zeros((0, len(Soil._fields)))
_K_C, _K_PHI, _PHI = (Soil._fields.index(name) for name in ("k_c", "k_phi", "phi"))


@dataclass(frozen=True, slots=True)
class SigmaPoints:
    """Sigma points of a posterior and the linear map from values at them to values at its mode and draws.

    soils (D, 6): the mode first; the last points are one standard deviation away along directions that are independent
    of all others.  share (1 + N, D): weight of each point in the value of the mode (first row) and of each of N draws.
    mirror (D,): index of the point on the other side of the mode; its own index where there is none.
    """

    soils: Array
    share: Array
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
        leading = min(len(free), LEADING_DIRECTIONS)
        points = _design(leading)
        steps = np.concatenate([points @ axes[:, :LEADING_DIRECTIONS].T, axes[:, LEADING_DIRECTIONS:].T, shifts])
        soils = np.asarray(posterior.soil) * np.exp(steps)
        if width is not None:
            soils[:, [_K_C, _K_PHI]] = _moduli(posterior.soil, steps, width)
        soils[1:, _PHI] = np.minimum(soils[1:, _PHI], max(MAX_PHI, posterior.soil.phi))
        return cls(soils, *_shares(leading, len(soils) - len(points)))

    def drawn(self, samples: Array, known: NDArray[np.bool_] | None = None) -> Array:
        """Return values at the mode and the draws (1 + N, ..., F), from values at the points (D, ..., F).

        A value that is not known (a mask that broadcasts; None if all are) is mirrored about the mode's from the point
        on the other side; where that is not known either, it is the mode's.
        """
        if known is not None and not known.all():
            known = np.broadcast_to(known, samples.shape)
            mirrored = np.where(known[self.mirror], 2.0 * samples[0] - samples[self.mirror], samples[0])
            samples = np.where(known, samples, mirrored)
        if samples.ndim == 3:
            return np.asarray((self.share @ samples.swapaxes(0, 1)).swapaxes(0, 1))
        return np.asarray(self.share @ samples.reshape(len(samples), -1)).reshape(-1, *samples.shape[1:])


def _moduli(soil: Soil, steps: Array, width: float) -> Array:
    """k_c and k_phi (D, 2) after steps (D, 6) of the logarithms, along which log K_L changes linearly."""
    part, whole = soil.k_c / width, soil.k_c / width + soil.k_phi
    K_L = whole * np.exp((part * steps[:, _K_C] + soil.k_phi * steps[:, _K_PHI]) / whole)
    of_k_c = np.minimum(part * np.exp(steps[:, _K_C]), (1.0 - LEAST_K_PHI) * K_L)
    return np.stack([of_k_c * width, K_L - of_k_c], axis=1)


def mean_and_std(samples: Array) -> tuple[Array, Array]:
    """Return the mean and standard deviation (...,) over the draws that have a value.

    samples (1 + N, ...): the value at the mode, then at the draws, nan where there is none; both are nan where the mode
    or most draws have none.
    """
    change = samples[1:] - samples[0]
    known = np.isfinite(change)
    count = known.sum(axis=0)
    of_count = 1.0 / np.maximum(count, 1)
    mean = np.where(known, change, 0.0).sum(axis=0) * of_count
    square = (np.where(known, change - mean, 0.0) ** 2).sum(axis=0) * of_count
    is_known = np.isfinite(samples[0]) & (2 * count > len(change))
    return np.where(is_known, samples[0] + mean, np.nan), np.where(is_known, np.sqrt(square), np.nan)


def estimates(*samples: Array | None) -> list[Estimate | None]:
    """Return the mean and std of scalars from their samples (1 + N,) each; None without samples or with nan."""
    known = [each for each in samples if each is not None]
    if not known:
        return [None] * len(samples)
    found = iter(np.stack(mean_and_std(np.stack(known, axis=1)), axis=1).tolist())
    pairs = [(math.nan, math.nan) if each is None else next(found) for each in samples]
    return [Estimate(mean, std) if math.isfinite(mean) else None for mean, std in pairs]


def likely(samples: Array | None) -> Estimate | None:
    """Return a first-order estimate of a scalar: its value at the mode and the std of its odd part.

    samples (1 + N,): the value at the mode, then at pairs of a draw and its mirror image; where one has none (nan), the
    other's is mirrored about the mode's.  Mean-value first-order reliability (Cornell 1969, ACI Journal 66:974): the
    median of a monotonic function.  A mean would not do for probabilities: along the curved valley of poorly determined
    soils its second-order term looks like a certain increase.
    """
    if samples is None:
        return None
    change = (samples[1:] - samples[0]).reshape(-1, 2)
    change = np.where(np.isnan(change), -change[:, ::-1], change)
    odd = 0.5 * (change[:, 0] - change[:, 1])
    known = odd[np.isfinite(odd)]
    value, std = float(samples[0]), math.sqrt(float((known**2).sum()) / max(len(known), 1))
    return Estimate(value, std) if math.isfinite(value) else None


@cache
def _design(n: int) -> Array:
    """Points (P, n) for n standard normals: origin, simplex and edges on a sphere (Lu & Darmofal 2004), first axis."""
    if n == 0:
        return np.zeros((1, 0))
    vertices = np.zeros((n + 1, n))
    for k in range(n):
        vertices[k, k] = math.sqrt((n + 1) * (n - k) / (n * (n - k + 1)))
        vertices[k + 1 :, k] = -math.sqrt((n + 1) / (n * (n - k + 1) * (n - k)))
    i, j = np.triu_indices(n + 1, 1)
    middles = vertices[i] + vertices[j] if n > 1 else np.zeros((0, 1))  # of one edge, the origin
    middles = middles / np.linalg.norm(middles, axis=1, keepdims=True)
    on_axis = np.outer([*FIRST_AXIS_POINTS, *np.negative(FIRST_AXIS_POINTS)], np.eye(1, n))
    sphere = math.sqrt(n + 2.0) * np.concatenate([vertices, -vertices, middles])
    return np.concatenate([np.zeros((1, n)), sphere, on_axis])


@cache
def normals(n: int, leading: int) -> Array:
    """Return draws (DRAWS, n) of n standard normals, each next to its mirror image; their covariance is the identity.

    Of the leading columns all moments up to degree five are those of standard normals, of the first one up to seven.
    """
    if n == 0:
        return np.zeros((DRAWS, 0))
    z = np.random.default_rng(SEED).standard_normal((DRAWS // 2, n))
    degrees = _degrees(n, leading)
    wanted = np.prod(np.array(NORMAL_MOMENTS)[degrees], axis=1)
    for _ in range(GAUSS_NEWTON_STEPS):
        value, slopes = _monomials(z, degrees)
        off = value.mean(axis=1) - wanted
        by_all = slopes.reshape(len(slopes), -1) / len(z)
        z = z - (by_all.T @ np.linalg.solve(by_all @ by_all.T, off)).reshape(z.shape)
    return np.stack([z, -z], axis=1).reshape(DRAWS, n)


@cache
def _shares(leading: int, linear: int) -> tuple[Array, NDArray[np.intp]]:
    """share and mirror of SigmaPoints for these numbers of polynomial (leading) and linear directions."""
    points = _design(leading)
    z = normals(leading + linear, leading)
    fit = np.linalg.pinv(_polynomials(points))
    of_draws = np.concatenate([_polynomials(z[:, :leading]) @ fit, z[:, leading:]], axis=1)
    of_draws[:, 0] -= z[:, leading:].sum(axis=1)
    of_mode = np.eye(1, of_draws.shape[1])
    mirror = np.arange(of_draws.shape[1])
    for i, point in enumerate(points):
        mirror[i] = next((j for j, other in enumerate(points) if np.allclose(other, -point)), i)
    return np.concatenate([of_mode, of_draws]), mirror


def _polynomials(x: Array) -> Array:
    """Orthonormal polynomials (P, terms) of standard normals (P, n): of degree two, and some with the first one."""
    n = x.shape[1]
    degrees = [d for d in itertools.product(range(3), repeat=n) if sum(d) <= 2]
    if n:
        degrees += [(d, *(0,) * (n - 1)) for d in range(3, FIRST_AXIS_DEGREE + 1)]
        degrees += [(2, *(int(i == k) for i in range(1, n))) for k in range(1, n) if n > 2]
    size = np.sqrt([math.factorial(d) for d in range(FIRST_AXIS_DEGREE + 1)])
    hermite = hermevander(x, FIRST_AXIS_DEGREE) / size  # of variance one
    return np.stack([hermite[:, range(n), np.array(of, int)].prod(axis=1) for of in degrees], axis=1)


def _degrees(n: int, leading: int) -> NDArray[np.intp]:
    """Degrees (Q, n) of the monomials whose mean is made exact; odd degrees are exact by symmetry."""
    of_all, of_leading = itertools.combinations_with_replacement(range(n), 2), range(leading)
    factors = [*of_all, *itertools.combinations_with_replacement(of_leading, 4)]
    return np.array([np.bincount(each, minlength=n) for each in [*factors, *[(0,) * 6][:leading]]])


def _monomials(z: Array, degrees: NDArray[np.intp]) -> tuple[Array, Array]:
    """Monomials (Q, P) of these degrees at points (P, n), and their derivatives (Q, P, n)."""
    powers = z ** np.arange(len(NORMAL_MOMENTS))[:, None, None]
    column = np.arange(z.shape[1])
    value = powers[degrees, :, column].prod(axis=1)
    lower = np.maximum(degrees[:, None] - np.eye(len(column), dtype=int), 0)
    slopes = degrees[..., None] * powers[lower, :, column].prod(axis=2)
    return value, slopes.transpose(0, 2, 1)
