"""Nested Laplace approximation of a window's posterior along the sinkage exponent n.

Equations.  At each node u = log n everything else is fitted with n held.  With E(u) = -2 log evidence and
L(u) = -2 log posterior of that fit and q(u) = -2 log prior of u,

    density       p(u) ~ exp(-(E(u) + q(u)) / 2)
    confidence    r(u) = sign(u - u_min) sqrt(L(u) + q(u) - min) ~ N(0, 1)
    mean          sum over u of weight(u) mean(u)
    covariance    sum over u of c(u) (covariance(u) + a (mean(u) - mean)(mean(u) - mean)')

with c the confidence distribution and a >= 1 for its skewness (`longer_side`).

At constant loads tyres of two widths measure two points of the pressure-sinkage curve, and k_c, k_phi and n
are three unknowns.  The soils that fit lie along a curved ridge on which k_c rises and falls again while n only
falls, and the covariance at the mode does not describe it.  So n is held at several values in turn and the
fits are averaged (Rue, Martino & Chopin 2009, J. R. Stat. Soc. B 71:319, sect. 3).  Each fit starts where the line
through the last two leads in the coordinates of `parametrization`, in which the ridge is hardly curved.

The density counts the volume of what the data leave open.  Where k_c may be close to zero that volume is large
on the logarithm's scale, and soils with much k_c get less probability than their fit deserves.  That gives the
best mean where small k_c is among the likely soils.  Where the data determine k_c one sd above the mean,
it is only a bias by the choice of the logarithm: the better k_c is determined there, the more the mean goes by
the confidence distribution, in which the signed root of the profile likelihood is standard normal
(Barndorff-Nielsen & Cox 1994, Inference and Asymptotics, sect. 3.4).  The covariance always goes by the confidence
distribution: intervals by the density exclude soils with much k_c too often when they are true.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array, Indices
from soilbus.estimation.gaussian import Gaussian, solve_with_inverse
from soilbus.estimation.multistart import Fit, fit_at, fit_window, refine
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.options import PosteriorOptions
from soilbus.estimation.parametrization import Coordinates
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.solver import Iterate, Objective, coordinates_of, minimise

_SOIL = len(PARAMETERS)
_K_C, _K_PHI, _N = (PARAMETERS.index(name) for name in ("k_c", "k_phi", "n"))
_OF_K_C, _OF_N = 0, 1
"""Columns of attainable variances."""


class Node(NamedTuple):
    """A fit with n held at exp(u), and -2 log prior of u there."""

    u: float
    fit: Fit
    neg2_log_prior: float

    @property
    def neg2_log_density(self) -> float:
        """-2 log of the posterior density of u, up to a constant."""
        return self.fit.neg2_log_evidence + self.neg2_log_prior

    @property
    def neg2_log_profile(self) -> float:
        """-2 log of the profile posterior of u: of the likeliest soil with this n."""
        return self.fit.neg2_log_posterior + self.neg2_log_prior


class ProfileOverN(NamedTuple):
    """Fits along n.

    Attributes
    ----------
    problem
        The denoised window that is fitted.
    top
        Its fit with n free.
    nodes
        In the order of n, on both sides down to where their density is negligible.  Empty where k_c, k_phi and
        n are not all free or all tyres have one width.
    """

    problem: ObservationModel
    top: Fit
    nodes: list[Node]


def with_nested_laplace(problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian, found: Fit) -> Fit:
    """The fit with mean and covariance of the whole posterior where its mode does not describe it.

    That is where the sd of log n (`_sd_of_n`) exceeds `determined_n_sd` or there is a second mode.  There, and where
    loads hardly vary, the noise of loads and speeds may have added false information on n or c, so the denoised window
    is fitted (`ObservationModel.denoised`).  Where k_c, k_phi and n are free and tyres differ in width, its posterior
    is averaged along n, unless n is determined.

    Parameters
    ----------
    problem, prior, joint_prior
        The window and its priors.
    found
        Its fit, of a constant soil.

    Returns
    -------
    Fit
        With `marginalised`, and with the denoised window's Gaussians unless there is a second mode; `found` itself
        where there is nothing to average.
    """
    options = problem.options.posterior
    sd_of_n = _sd_of_n(problem, prior, joint_prior, found.mode)
    is_determined = sd_of_n < options.determined_n_sd and found.second_mode is None
    if is_determined and load_signal(problem, found) > options.min_load_signal:
        return found
    with np.errstate(all="ignore"):
        along = profile_over_n(problem, prior, joint_prior, found, not is_determined)
        if along is None:
            return found
        coordinates = coordinates_of(problem, prior)
        attainable = attainable_variance(along, prior, joint_prior) if len(along.nodes) > 2 else None
        averaged = along.top.mode
        if attainable is not None:
            averaged = _averaged(along.nodes, attainable, coordinates, joint_prior)
    is_finite = np.isfinite(averaged.soil).all() and np.isfinite(averaged.covariance).all()
    if not is_finite or found.second_mode is not None:  # beside a second mode the first stays as it was found
        return replace(found, marginalised=averaged) if is_finite else found
    is_gaussian = _is_hardly_wider(along.top.mode, averaged, options)
    return replace(found, mode=along.top.mode, marginalised=averaged, is_gaussian=is_gaussian)


def _is_hardly_wider(mode: Gaussian, averaged: Gaussian, options: PosteriorOptions) -> bool:
    """Whether the average along n is hardly wider than the Gaussian at the mode, in any direction."""
    free = np.flatnonzero(np.diag(mode.covariance) > 0.0)
    own, wide = (b.covariance[np.ix_(free, free)] for b in (mode, averaged))
    widening = np.linalg.eigvals(np.linalg.solve(own, wide)).real
    return bool(widening.max() < options.gaussian_widening**2)


def _sd_of_n(problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian, mode: Gaussian) -> float:
    """Sd of log n where k_c's share s in K_L has the sd that the data and its prior leave it, at most 1.

    The model is linear in s, not in log k_c: where a small s may as well be large, n is as open as it is there.
    Relative variance: of the data 1 / (1 / var(log k_c) - 1 / var_0), of the prior exp(var_0) - 1, at most 1 / s^2.
    """
    of_k_c, of_n, both = mode.covariance[_K_C, _K_C], mode.covariance[_N, _N], mode.covariance[_K_C, _N]
    if of_k_c <= 0.0:
        return math.sqrt(of_n)
    of_prior = joint_prior.variance_of_k_c(prior)
    share = mode.soil[_K_C] / (mode.soil[_K_C] + mode.soil[_K_PHI] * problem.rig.width.mean())
    of_share = 1.0 / (max(1.0 / of_k_c - 1.0 / of_prior, 0.0) + max(share**2, 1.0 / math.expm1(of_prior)))
    return math.sqrt(of_n + (both / of_k_c) ** 2 * max(of_share - of_k_c, 0.0))


def cold_fit(problem: ObservationModel, prior: SoilPrior) -> Fit | None:
    """The first window of a drive as the service fits it: `fit_window`, then `with_nested_laplace`."""
    fit = fit_window(problem, prior)
    if fit is None or not fit.converged:
        return fit
    return with_nested_laplace(problem, prior, Gaussian.of(prior, problem.gain_std), fit)


def load_signal(problem: ObservationModel, fit: Fit) -> float:
    """Variance of the fitted loads over the window by that of their noise; the largest of all observations of loads."""
    loads = problem.layout.loads
    fitted, noise = problem.observed(fit.optimum.latents.joined())[:, loads], fit.optimum.at.variance[:, loads].mean(0)
    return float(np.max(np.divide(fitted.var(0), noise, out=np.full(len(noise), np.inf), where=noise > 0.0)))


def profile_over_n(
    problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian, found: Fit, has_nodes: bool = True
) -> ProfileOverN | None:
    """Fits of the denoised window through its optimum near `found`, with nodes along n; None without an optimum."""
    optimum = found.optimum
    denoised, latents = problem.denoised(optimum)
    start = Iterate(optimum.soil, optimum.gains, latents)
    top = refine(Objective(denoised, prior, joint_prior), start)
    if top is None or not top.converged:
        return None
    if not has_nodes or not prior.log_std[[_K_C, _K_PHI, _N]].all() or np.ptp(problem.rig.width) == 0.0:
        return ProfileOverN(denoised, top, [])
    objective = Objective(denoised, prior, joint_prior)
    approximation = objective.approximation_at(top.optimum)
    first = _node(objective, Iterate.of(top.optimum), math.log(top.optimum.soil[_N]))
    if approximation is None or first is None:
        return ProfileOverN(denoised, top, [])
    of_n = int(np.searchsorted(objective.free, _N))
    along = approximation.covariance[:, of_n]
    step = min(math.sqrt(along[of_n]), problem.options.posterior.first_node_step)
    down, up = (_one_side(objective, first, along / along[of_n], sign * step) for sign in (-1.0, 1.0))
    return ProfileOverN(denoised, top, [*reversed(down), first, *up])


def attainable_variance(along: ProfileOverN, prior: SoilPrior, joint_prior: Gaussian) -> Array | None:
    """Variance that a window on each node's soil could attain.

    Returns
    -------
    (nodes, 2) or None
        Of log k_c and log n.  None where the information of a node is singular.
    """
    objective = Objective(along.problem, prior, joint_prior)
    columns = np.searchsorted(objective.free, [_K_C, _N])
    variance = []
    for node in along.nodes:
        model = objective.with_prior(Iterate.of(node.fit.optimum), node.fit.optimum.at)
        inverse = None if model is None else solve_with_inverse(model.information, model.gradient)
        if inverse is None:
            return None
        variance.append(inverse[1].diagonal()[columns])
    return np.array(variance)


def error_weights(probability: Array, attainable: Array) -> tuple[Array, Array]:
    """Weights of M soils such that the weighted mean has the least square error in units of the attainable sd.

    Parameters
    ----------
    probability : (M,)
        Of the soils.
    attainable : (M, 2)
        Variance of log k_c and log n that is attainable there.

    Returns
    -------
    (M,), (M,)
        For all coordinates, by the variance of log n: combinations with n that the data determine stay so.
        For log k_c, by its own variance.
    """
    sd = np.sqrt(attainable)
    of_all, of_k_c = probability / sd[:, _OF_N], probability / sd[:, _OF_K_C]
    return of_all / of_all.sum(), of_k_c / of_k_c.sum()


def density(u: Array, neg2_log: Array, fine: Array) -> Array:
    """Probability of each grid value under a density.

    Parameters
    ----------
    u, neg2_log : (K,)
        Nodes, and -2 log density there; its signed root is interpolated linearly.
    fine : (M,)
        Grid values.

    Returns
    -------
    (M,)
        Sums to 1.
    """
    density = np.exp(-0.5 * _signed_root(u, neg2_log, fine) ** 2)
    return np.asarray(density / density.sum())


def confidence(u: Array, neg2_log: Array, fine: Array) -> Array:
    """Probability of each grid value under the confidence distribution of a profile; arguments as of `density`."""
    root = _signed_root(u, neg2_log, fine)
    density = np.exp(-0.5 * root**2) * np.maximum(np.gradient(root), 0.0)
    return np.asarray(density / density.sum())


def longer_side(off: Array, weight: Array) -> float:
    """Mean square deviation on the longer side of a distribution over that of all of it; 1 at least.

    A mean and one sd are reported, and the interval must hold on either side.

    Parameters
    ----------
    off, weight : (M,)
        Deviations from the centre and their probabilities.
    """
    square = float(weight @ off**2)
    sides = [weight * side for side in (off > 0.0, off < 0.0) if (weight * side).any()]
    return max([1.0, *(float(side @ off**2 / side.sum()) / square for side in sides)])


def _signed_root(u: Array, neg2_log: Array, fine: Array) -> Array:
    """Root (M,) of the rise above the least value, negative before it, interpolated linearly between the nodes."""
    root = np.sqrt(np.maximum(neg2_log - neg2_log.min(), 0.0))
    sign = np.where(np.arange(len(u)) < int(np.argmin(neg2_log)), -1.0, 1.0)
    return np.asarray(np.interp(fine, u, sign * root))


def _one_side(objective: Objective, top: Node, slope: Array, step: float) -> list[Node]:
    """Nodes on one side of the mode.

    slope (F + A,) is the change of the coordinates and active gains per change of log n along the ridge;
    step is the first change of log n, with its sign.
    """
    nodes: list[Node] = []
    last, least, options = top, top.neg2_log_density, objective.problem.options.posterior
    while (node := _node(objective, *_predicted(objective, last, slope, step))) is not None:
        nodes.append(node)
        slope = (_position(objective, node) - _position(objective, last)) / (node.u - last.u)
        last, least, step = node, min(least, node.neg2_log_density), step * options.node_step_growth
        if node.neg2_log_density > least + options.negligible:
            break
    return nodes


def _predicted(objective: Objective, last: Node, slope: Array, step: float) -> tuple[Iterate, float]:
    """Where the ridge leads from a node by linear extrapolation: an iterate, and its log n.

    slope, step: as of `_one_side`.
    """
    free, optimum, gains = len(objective.free), last.fit.optimum, last.fit.optimum.gains.copy()
    position = _position(objective, last) + slope * step
    soil = objective.coordinates.soil_at(position[:free])
    gains[objective.active] = position[free:]
    near = objective.moved(Iterate.of(optimum), optimum.at, soil, objective.problem.allowed(gains))
    return near, last.u + step


def _position(objective: Objective, node: Node) -> Array:
    """Coordinates and active gains (F + A,) of a node."""
    optimum = node.fit.optimum
    return np.concatenate([objective.coordinates.position(optimum.soil), optimum.gains[objective.active]])


def _node(objective: Objective, near: Iterate, u: float) -> Node | None:
    """The fit with log n held at u, from an iterate near it; None beyond the bounds of n, or unconverged."""
    prior, joint_prior, options = objective.coordinates.prior, objective.joint_prior, objective.options
    if abs(u - math.log(prior.median[_N])) > options.bound_sd * prior.log_std[_N]:
        return None
    median, log_std = prior.median.copy(), prior.log_std.copy()
    median[_N], log_std[_N] = math.exp(u), 0.0
    held = Objective(objective.problem, SoilPrior(median, log_std), joint_prior.conditioned_on(_N, u))
    fit = fit_at(held, minimise(held, near, options.along_n, 0.0))
    if fit is None or not fit.converged:
        return None
    return Node(u, fit, joint_prior.neg2_log_marginal(_N, u, prior) + held.prior_factor.least_value)


def _averaged(nodes: list[Node], attainable: Array, coordinates: Coordinates, joint_prior: Gaussian) -> Gaussian:
    """Mean and covariance along n, from the nodes and linear interpolation between them.

    On the soils of one ridge a window's attainable sd, attainable (nodes, 2) as variance, differs by up to a
    factor of ten: each soil counts by `error_weights`, so that the mean square error is least.
    """
    free = coordinates.free
    active = _SOIL + np.flatnonzero(np.diag(joint_prior.covariance)[_SOIL:] > 0.0)
    gaussians = [node.fit.mode for node in nodes]
    u = np.array([node.u for node in nodes])
    fine = np.linspace(u[0], u[-1], 400)
    by_density = density(u, np.array([node.neg2_log_density for node in nodes]), fine)
    by_confidence = confidence(u, np.array([node.neg2_log_profile for node in nodes]), fine)
    interpolation = np.array([np.interp(fine, u, one) for one in np.eye(len(u))])
    variance_above = _one_sd_above(fine, by_density, attainable[:, _OF_K_C] @ interpolation)
    determined = 1.0 - variance_above / joint_prior.variance_of_k_c(coordinates.prior)
    position = np.array([[*coordinates.position(b.soil), *b.gains[active - _SOIL]] for b in gaussians])
    along = position.T @ interpolation
    own = np.array([_in_coordinates(b.covariance, coordinates.log_directions(b.soil), free, active) for b in gaussians])
    probability = determined * by_confidence + (1.0 - determined) * by_density
    of_all, of_k_c = error_weights(probability, interpolation.T @ attainable)
    mean = along @ of_all
    mean[_K_C] = along[_K_C] @ of_k_c
    off = along - mean[:, None]
    inflation = longer_side(fine - fine @ by_density, by_confidence)  # grows as the two distributions differ, too
    spread = inflation * (off * by_confidence) @ off.T
    covariance = np.tensordot(interpolation @ by_confidence, own, axes=1) + spread
    mean[_K_C] = min(mean[_K_C], _greatest_k_c(mean, covariance, coordinates))
    soil, gains = coordinates.soil_at(mean[: len(free)]), gaussians[0].gains.copy()
    gains[active - _SOIL] = mean[len(free) :]
    by_coordinates = np.zeros((_SOIL + len(gains), len(mean)))
    by_coordinates[:_SOIL, : len(free)] = coordinates.log_directions(soil)
    by_coordinates[active, len(free) + np.arange(len(active))] = 1.0
    return Gaussian(soil, gains, by_coordinates @ covariance @ by_coordinates.T)


def _greatest_k_c(mean: Array, covariance: Array, coordinates: Coordinates) -> float:
    """Greatest log k_c at which log k_phi has no larger sd than its prior's; inf where there is none.

    With the share s = k_c / (b K_L) and K_L = k_c / b + k_phi, d log k_phi = (d log K_L - s d log k_c) / (1 - s).
    A fit contains the prior of k_phi; separate means of log k_c and log K_L do not, and may leave no k_phi at all.
    """
    n, width = math.exp(mean[_N]), coordinates.width
    by_coordinates = np.zeros((2, len(mean)))
    by_coordinates[0, _K_C] = 1.0
    by_coordinates[1, [_K_PHI, _N]] = 1.0, -n * coordinates.log_depth
    (of_k_c, both), (_, of_K_L) = (by_coordinates @ covariance @ by_coordinates.T).tolist()
    most = float(coordinates.prior.log_std[_K_PHI]) ** 2
    if of_K_L >= most:
        return math.inf
    root = math.sqrt(max((both - most) ** 2 - (of_k_c - most) * (of_K_L - most), 0.0))
    share = (of_K_L - most) / (both - most - root)
    return math.log(share * width) + float(mean[_K_PHI]) - n * coordinates.log_depth


def _in_coordinates(covariance: Array, directions: Array, free: Indices, active: Indices) -> Array:
    """Covariance (F + A, F + A) of coordinates and active gains, from that of logarithms and all gains."""
    unknowns = np.concatenate([free, active])
    back = np.eye(len(unknowns))
    back[: len(free), : len(free)] = np.linalg.inv(directions[free])
    return np.asarray(back @ covariance[np.ix_(unknowns, unknowns)] @ back.T)


def _one_sd_above(fine: Array, probability: Array, value: Array) -> float:
    """A value (M,) on a grid (M,), interpolated one sd above the mean of these probabilities (M,)."""
    mean = float(fine @ probability)
    return float(np.interp(mean + math.sqrt((fine - mean) ** 2 @ probability), fine, value))
