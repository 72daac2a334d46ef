"""Gaussian posterior at an optimum: by its curvature, and by its moments along k_c's share and along c.

Equations.  With H the information at the optimum, b the mean tyre width and K_L = k_c / b + k_phi,

    mode            theta_hat, covariance H^-1
    k_c's share     s = (k_c / b) / K_L

Tyres of different width measure s, and the model is nearly linear in s.  The prior is Gaussian in log k_c and
log k_phi, and so in log s and log (1 - s) given K_L.  Where the data determine s, the posterior is one
Gaussian.  Where they do not, the posterior of log s falls off fast towards large s and as slowly as the prior
towards small s, and the curvature at the mode does not describe its spread.  Given s the other coordinates are
Gaussian, so that an integral over s alone gives mean and covariance (cf. Rue, Martino & Chopin 2009, J. R. Stat.
Soc. B 71:319).  The forces are linear in c as well, whose prior is log-normal.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian, solve_with_inverse
from soilbus.estimation.posterior import PARAMETERS
from soilbus.estimation.solver import Iterate, Objective, QuadraticModel

_K_C, _K_PHI, _N, _C = (PARAMETERS.index(name) for name in ("k_c", "k_phi", "n", "c"))
_SHARE, _LOG_SHARE, _LOG_REST, _OTHERS = 0, 1, 2, 3
"""Columns of changes for the moments along k_c's share s: of s, log s and log (1 - s); the others follow."""


class Moments(NamedTuple):
    """Mean (P,) of deviations from the mode and covariance (P, P) about the mean: log s, then the others."""

    mean: Array
    covariance: Array


def gaussians_at(
    objective: Objective, iterate: Iterate, model: QuadraticModel, base: Array
) -> tuple[Gaussian, Gaussian] | None:
    """Gaussians of the posterior at an optimum: by its moments along k_c's share and c, and by its curvature.

    Parameters
    ----------
    objective
        Of the window.
    iterate
        The optimum.
    model
        The quadratic model one step before it.
    base : (6,)
        The soil of that model.

    Returns
    -------
    moments, mode
        By the curvature where there are no finite moments; along k_c's share also where k_c and k_phi are not
        both free  None where the information is singular.
    """
    inverse = solve_with_inverse(model.information, model.gradient)
    if inverse is None:
        return None
    covariance = inverse[1]
    mode = objective.gaussian(iterate.soil, iterate.gains, covariance, base)
    free, has_share = len(objective.free), {_K_C, _K_PHI} <= set(objective.free.tolist())
    along_share = _moments_along_share(objective, iterate, model, base) if has_share else None
    along_c = _moments_along_c(objective, iterate, model, base)
    if along_share is None and along_c is None:
        return mode, mode
    soil, gains, own = iterate.soil, iterate.gains.copy(), covariance
    if along_share is not None:
        step = _by_share(objective, iterate.soil) @ along_share.mean
        soil = objective.coordinates.soil_at(objective.coordinates.position(iterate.soil) + step[:free])
        gains[objective.active] += step[free:]
        by_share = _by_share(objective, soil)
        own = by_share @ along_share.covariance @ by_share.T
    if along_c is not None:  # about the optimum, at which c and tan phi make the strength that was measured
        square = along_c.covariance + np.outer(along_c.mean, along_c.mean)
        to_square = _root_of(square) @ np.linalg.inv(_root_of(covariance))
        own = to_square @ own @ to_square.T
        place, prior_sd = int(np.searchsorted(objective.free, _C)), float(objective.coordinates.prior.log_std[_C])
        scale = np.ones(len(own))
        scale[place] = min(1.0, prior_sd / math.sqrt(own[place, place]))  # c is known no less than beforehand
        own = scale[:, None] * own * scale
    return objective.gaussian(soil, gains, own), mode


def _moments_along_c(objective: Objective, iterate: Iterate, model: QuadraticModel, base: Array) -> Moments | None:
    """Moments (F + A) of coordinates and gains about the optimum, c being log-normal and the forces linear in it.

    As along a share of k_c that is small, whose complement does not change.  The prior is linearised at the model's
    soil `base`, too: at another c what compensates for c is another share of tan phi.
    """
    if _C not in objective.free:
        return None
    place, n = int(np.searchsorted(objective.free, _C)), len(model.gradient)
    others = np.delete(np.arange(n), place)
    by_changes = np.zeros((n, n - 1 + _OTHERS))
    by_changes[others, _OTHERS + np.arange(n - 1)] = 1.0
    by_value = by_changes[place].copy()
    by_changes[place, _LOG_SHARE], by_value[_SHARE] = 1.0, 1.0
    by_logs = by_changes.copy()
    by_logs[: len(objective.free)] = (
        objective.coordinates.log_directions(base)[objective.free] @ by_changes[: len(objective.free)]
    )
    slopes = objective.prior_factor.jacobian(base, by_logs, {_C: by_value})
    weighted = objective.prior_factor.precision @ slopes
    quadratic = slopes.T @ weighted
    of_data, order = np.concatenate([[_SHARE], _OTHERS + np.arange(n - 1)]), np.concatenate([[place], others])
    quadratic[of_data[:, None], of_data] += (model.information - model.prior_information)[order[:, None], order]
    gradient = np.zeros(len(quadratic))  # at the optimum the data's gradient is minus the prior's
    gradient[_LOG_SHARE] = weighted[:, _LOG_SHARE] @ objective.prior_factor.residuals(iterate.soil, iterate.gains)
    gradient[_SHARE] = -gradient[_LOG_SHARE]
    found = moments_along_share(quadratic, gradient, 1e-12)
    if found is None:
        return None
    back = np.argsort(order)
    return Moments(found.mean[back], found.covariance[back[:, None], back])


def _moments_along_share(objective: Objective, iterate: Iterate, model: QuadraticModel, base: Array) -> Moments | None:
    """Moments of log s, s = k_c's share in K_L, of the other coordinates and of the gains, about the optimum.

    Linearised at the model's soil `base`, as in `_moments_along_c`.
    """
    others = np.arange(1, len(model.gradient))
    by_share = _by_share(objective, base)
    by_changes = np.zeros((len(others) + 1, len(others) + _OTHERS))  # of log k_c = log s K_L b, log (1 - s) K_L, ..
    by_changes[others, others + _OTHERS - 1] = 1.0
    by_changes[[_K_C, _K_PHI], _OTHERS:] = by_share[_K_C, 1:]
    by_changes[[_K_C, _K_PHI], [_LOG_SHARE, _LOG_REST]] = 1.0
    by_k_c = by_changes[_K_C].copy()
    by_k_c[[_SHARE, _LOG_SHARE]] = 1.0, 0.0
    slopes = objective.prior_factor.jacobian(base, by_changes, {_K_C: by_k_c})
    quadratic = slopes.T @ objective.prior_factor.precision @ slopes
    of_data = np.concatenate([[_SHARE], others + _OTHERS - 1])
    quadratic[of_data[:, None], of_data] += by_share.T @ (model.information - model.prior_information) @ by_share
    k_c, k_phi = iterate.soil[[_K_C, _K_PHI]]
    share = k_c / (k_c + k_phi * objective.coordinates.width)
    of_prior = (
        slopes.T @ objective.prior_factor.precision @ objective.prior_factor.residuals(iterate.soil, iterate.gains)
    )
    gradient = np.zeros(len(quadratic))  # at the optimum the data's gradient is minus the prior's
    gradient[:_OTHERS] = of_prior[_LOG_REST] * share / (1.0 - share) - of_prior[_LOG_SHARE], *of_prior[1:_OTHERS]
    return moments_along_share(quadratic, gradient, share)


def _by_share(objective: Objective, soil: Array) -> Array:
    """Derivatives (F + A, F + A) of coordinates and gains by the same with log k_c's share in place of log k_c."""
    by_share = np.eye(len(objective.free) + len(objective.active))
    by_share[_K_C, _K_PHI] = 1.0
    by_share[_K_C, : len(objective.free)] += np.where(
        objective.free == _N, -soil[_N] * objective.coordinates.log_depth, 0.0
    )
    return by_share


def _root_of(covariance: Array) -> Array:
    """R (M, M) with R R' = a covariance (M, M), whose variances may differ by many decades."""
    scale = np.sqrt(covariance.diagonal())
    variance, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * (axes * np.sqrt(np.maximum(variance, 1e-300))) @ axes.T)


def moments_along_share(quadratic: Array, gradient: Array, share: float) -> Moments | None:
    """Moments of a posterior along k_c's share.

    Parameters
    ----------
    quadratic : (P + 2, P + 2)
        Of z: (change of s) / s, changes of log s and of log (1 - s), and those o (P - 1,) of the other unknowns.
    gradient : (P + 2,)
        Half the gradient at the mode: -2 log posterior is z' quadratic z + 2 gradient' z, up to a constant.
    share
        s at the mode.

    Returns
    -------
    Moments or None
        None where the other unknowns are not determined.
    """
    own = np.diag(quadratic)[3:]
    if not np.all(own > 0.0):
        return None
    scale = 1.0 / np.sqrt(own)
    scaled = quadratic[3:, 3:] * np.outer(scale, scale)
    try:
        np.linalg.cholesky(scaled)  # by rounding it may not be positive definite
        inverse = np.linalg.inv(scaled) * np.outer(scale, scale)
    except np.linalg.LinAlgError:
        return None
    along = -inverse @ quadratic[3:, :3]
    of_share = quadratic[:3, :3] + quadratic[:3, 3:] @ along
    first, second = _over_share(of_share, gradient[:3] + along.T @ gradient[3:], share)
    spread = np.vstack([[0.0, 1.0, 0.0], along])
    mean, covariance = spread @ first, spread @ second @ spread.T
    mean[1:] -= inverse @ gradient[3:]
    covariance[1:, 1:] += inverse
    return Moments(mean, covariance) if np.isfinite(covariance).all() else None


def _over_share(quadratic: Array, gradient: Array, share: float) -> tuple[Array, Array]:
    """Mean (3,) of the changes of s, log s and log (1 - s), and covariance (3, 3) about it.

    The mean is over log k_c and log k_phi, as in the prior.  The covariance has Jeffreys' measure, the root of
    the information at each s: intervals then have their nominal coverage also where the data determine s and the
    prior does not (Welch & Peers 1963, J. R. Stat. Soc. B 25:318).
    """
    at_mode = np.array([1.0, 1.0, -share / (1.0 - share)])
    scale = 1.0 / np.sqrt(at_mode @ quadratic @ at_mode)
    half_width = np.arcsinh(6.0 / np.sqrt(quadratic[1, 1]) / scale)
    nodes = np.linspace(-half_width, half_width, 81)
    d = np.minimum(scale * np.sinh(nodes), np.log(0.99 / share))
    rest = 1.0 - share * np.exp(d)
    changes = np.stack([np.expm1(d), d, np.log(rest / (1.0 - share))])
    slopes = np.stack([np.exp(d), np.ones(len(nodes)), 1.0 - 1.0 / rest])
    neg2_log = (changes * (quadratic @ changes)).sum(0) + 2.0 * gradient @ changes
    density = np.cosh(nodes) * (scale * np.sinh(nodes) <= d) * np.exp(-0.5 * (neg2_log - neg2_log.min()))
    by_prior = density / rest
    mean = changes @ by_prior / by_prior.sum()
    density *= np.sqrt((slopes * (quadratic @ slopes)).sum(0))
    off = changes - mean[:, None]
    return mean, (off * density / density.sum()) @ off.T
