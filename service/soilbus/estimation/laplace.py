"""The posterior of a window where it is far from Gaussian: along the sinkage exponent n.

At constant loads, tyres of two widths measure two points of the pressure-sinkage curve,
and k_c, k_phi and n are three: the soils that explain a window lie on a bent ridge, along
which k_c rises and falls again while n only falls.  The covariance at its top says nothing
of where it leads.  So n is held at several values in turn, everything else is fitted, and
what these fits say is averaged with their probabilities (nested Laplace approximations:
Rue, Martino & Chopin 2009, J. R. Statist. Soc. B 71:319, sect. 3).

Those probabilities count the volume of what the data leave open: where k_c may be next to
nothing there is much of it, on the logarithm's scale, and soils with much k_c seem less likely than they
fit.  That makes the best mean where such soils are among the likely ones.  Where k_c is told even a standard
deviation towards them, there is only the choice of the logarithm, and a bias by it: the more k_c is known there,
the more the centre is that of the confidence distribution along n, in which the signed
root of the profile likelihood's fall is standard normal (Barndorff-Nielsen & Cox, Inference
and Asymptotics, 1994, sect. 3.4), for one soil as often as for another.  The spread about the centre is
always that one's: intervals by the probabilities exclude soils with much k_c too often when one is there.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array, Indices
from soilbus.estimation.gaussian import Gaussian, solve_with_inverse
from soilbus.estimation.multistart import Fit, fit_window, refine
from soilbus.estimation.observation_model import DenoisedObservationModel, ObservationModel
from soilbus.estimation.parametrization import BOUND, Coordinates
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.solver import Iterate, Objective
from soilbus.terra.wheel import Soil

WELL_KNOWN = 0.05
"""Sd of the logarithm of n below which a posterior with one top counts as Gaussian."""
LONGEST = 0.1
"""Longest first step of the logarithm of n; each next one is longer."""
GROWTH = 1.4
MAX_STEPS = 12
MAX_TRIES = 3
"""Times that a descent is resumed."""
UNLIKELY = 9.0
"""-2 log of a probability, relative to the greatest, where the ridge has ended."""
FINE = 400
"""Values of n that are averaged."""
COUNTS, COUNTS_OF_K_C = 1.0, 2.0
"""Powers of the sd that a window on some soil would leave at best by which an error on that soil counts less.

With 2 the mean square error is least in units of what is attainable on each soil, with 0 that of the logarithm.
"""
_SOIL = len(PARAMETERS)
_K_C, _K_PHI, _N = (PARAMETERS.index(name) for name in ("k_c", "k_phi", "n"))


class Node(NamedTuple):
    """A fit with n held, at the logarithm u, and -2 log of what was known of n there."""

    u: float
    fit: Fit
    known: float

    @property
    def unlikelihood(self) -> float:
        """-2 log of the posterior density of n."""
        return self.fit.neg2_log_evidence + self.known

    @property
    def misfit(self) -> float:
        """-2 log of the profile likelihood of n: of the likeliest soil with this n."""
        return self.fit.neg2_log_posterior + self.known


class ProfileOverN(NamedTuple):
    """Fits along n on both sides of the optimum `top`, down to where they are unlikely, in the order of n."""

    problem: DenoisedObservationModel
    top: Fit
    nodes: list[Node]


def with_nested_laplace(problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian, found: Fit) -> Fit:
    """The fit with mean and covariance of the whole posterior, where its top may not tell them.

    That is where n is badly known or there is a rival.  There the noise of loads and speeds
    may have told more of it than the soil has (`denoised`); and where k_c, k_phi and n are free
    and the tyres unlike, the posterior is a ridge that is averaged along n.  What is averaged is each
    held fit's belief, so its moments along k_c's share count; the present soil (`present`)
    comes after.
    """
    spread = math.sqrt(max(found.mode.covariance[_N, _N], found.gaussian.covariance[_N, _N]))
    if spread < WELL_KNOWN and found.second_mode is None:
        return found
    with np.errstate(all="ignore"):
        along = profile_over_n(problem, prior, joint_prior, found)
        if along is None:
            return found
        coordinates = Coordinates(prior, float(problem.rig.width.mean()))
        told = attainable_variance(along, prior, joint_prior) if len(along.nodes) > 2 else None
        whole = along.top.gaussian if told is None else _averaged(along.nodes, told, coordinates, joint_prior)
    finite = np.isfinite(whole.soil).all() and np.isfinite(whole.covariance).all()
    if not finite or found.second_mode is not None:  # beside its rival an optimum is told as it was found
        return replace(found, marginalised=whole) if finite else found
    return replace(found, gaussian=along.top.gaussian, mode=along.top.mode, marginalised=whole)


def cold_fit(problem: ObservationModel, prior: SoilPrior) -> Fit | None:
    """A window on its own, as the service tells its first one: fitted, and with its whole posterior."""
    fit = fit_window(problem, prior)
    if fit is None or not fit.converged:
        return fit
    return with_nested_laplace(problem, prior, Gaussian.of(prior, problem.gain_std), fit)


def profile_over_n(
    problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian, found: Fit
) -> ProfileOverN | None:
    """The ridge through an optimum; without nodes where k_c, k_phi and n are not all free and the tyres unlike.

    None where the descent finds no optimum of the denoised problem.
    """
    optimum = found.optimum
    calm = DenoisedObservationModel(problem, optimum)
    top = _converged(Objective(calm, prior, joint_prior), Iterate(optimum.soil, optimum.gains, calm.latents, np.inf, 1))
    if top is None:
        return None
    if not prior.log_std[[_K_C, _K_PHI, _N]].all() or np.ptp(problem.rig.width) == 0.0:
        return ProfileOverN(calm, top, [])
    first = _held(calm, prior, joint_prior, top, math.log(top.mode.soil[_N]), None)
    if first is None:
        return ProfileOverN(calm, top, [])
    step = min(math.sqrt(top.mode.covariance[_N, _N]), LONGEST)
    covariance = top.mode.covariance
    slope = covariance[:, _N] / covariance[_N, _N]
    down, up = (_along(calm, prior, joint_prior, first, slope, way, step) for way in (-1.0, 1.0))
    return ProfileOverN(calm, top, [*reversed(down), first, *up])


def _converged(fitting: Objective, near: Iterate) -> Fit | None:
    """The optimum near a place; None where there is none."""
    for _ in range(MAX_TRIES):
        fit = refine(fitting, near)
        if fit is None or fit.converged:
            return fit
        near = Iterate(fit.optimum.soil, fit.optimum.gains, fit.optimum.latents, np.inf, 1)
    return None


def _along(
    problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian, top: Node, slope: Array, way: float, step: float
) -> list[Node]:
    """Nodes to one side; slope (6 + G,) is how logarithms of the soil and gains change with that of n at the top."""
    nodes: list[Node] = []
    last, least = top, top.unlikelihood
    for _ in range(MAX_STEPS):
        node = _held(problem, prior, joint_prior, last.fit, last.u + way * step, slope)
        if node is None:
            break
        nodes.append(node)
        slope = (_place(node.fit) - _place(last.fit)) / (node.u - last.u)
        last, least, step = node, min(least, node.unlikelihood), step * GROWTH
        if node.unlikelihood > least + UNLIKELY:
            break
    return nodes


def _place(fit: Fit) -> Array:
    """Logarithms of the soil and gains (6 + G,) of an optimum."""
    return np.concatenate([np.log(fit.optimum.soil), fit.optimum.gains])


def _held(
    problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian, near: Fit, u: float, slope: Array | None
) -> Node | None:
    """A fit with n held, from the optimum of one nearby, moved along the slope (6 + G,) of the ridge there."""
    soil, gains, n = near.optimum.soil.copy(), near.optimum.gains, math.exp(u)
    if abs(u - math.log(prior.median[_N])) > BOUND * prior.log_std[_N]:
        return None
    if slope is not None:
        moved = _place(near) + slope * (u - math.log(soil[_N]))
        free = prior.log_std > 0.0
        soil[free] = Coordinates(prior, float(problem.rig.width.mean())).within(np.exp(moved[:_SOIL]))[free]
        gains = problem.allowed(moved[_SOIL:])
    soil[_N] = n
    deviation = (u - math.log(joint_prior.soil[_N])) / math.sqrt(joint_prior.covariance[_N, _N])
    median, log_std = prior.median.copy(), prior.log_std.copy()
    median[_N], log_std[_N] = n, 0.0
    fitting = Objective(problem, SoilPrior(median, log_std), joint_prior.conditioned_on(_N, u))
    latents = problem.with_entry_angles(near.optimum.latents, Soil(*soil.tolist()), gains)
    fit = _converged(fitting, Iterate(soil, gains, latents, np.inf, 1))
    return None if fit is None else Node(u, fit, deviation**2 + fitting.prior_factor.surplus)


def attainable_variance(along: ProfileOverN, prior: SoilPrior, joint_prior: Gaussian) -> Array | None:
    """Variance (nodes, 2) of log k_c and log n that a window on the soil of each node could leave at best.

    None where it is not to be told.
    """
    fitting = Objective(along.problem, prior, joint_prior)
    columns = np.searchsorted(fitting.free, [_K_C, _N])
    variance = []
    for node in along.nodes:
        place = Iterate(node.fit.optimum.soil, node.fit.optimum.gains, node.fit.optimum.latents, np.inf, 1)
        point = fitting.with_prior(place, node.fit.optimum.at)
        inverse = None if point is None else solve_with_inverse(point.information, point.gradient)
        if inverse is None:
            return None
        variance.append(inverse[1].diagonal()[columns])
    return np.array(variance)


def counted(centre: Array, told: Array) -> tuple[Array, Array]:
    """Shares (M,) of places as errors there count, for all coordinates and for k_c, by those (M,) of probability.

    told (M, 2) is the variance of log k_c and log n that is left there at best.  All but k_c go by that of n: what is
    well known of the others together with n so stays it.
    """
    of_all = centre * told[:, 1] ** (-0.5 * COUNTS)
    of_k_c = centre * told[:, 0] ** (-0.5 * COUNTS_OF_K_C)
    return of_all / of_all.sum(), of_k_c / of_k_c.sum()


def _averaged(nodes: list[Node], told: Array, coordinates: Coordinates, joint_prior: Gaussian) -> Gaussian:
    """Mean of all nodes and of what lies between them, by straight lines, and its spread about that.

    Soils of the ridge let a window tell its soil as unlike as by a factor of ten: the mean is where the mean
    square error is least if each counts by what is left there at best (`counted`), `told` (nodes, 2).
    """
    n, free = len(PARAMETERS), coordinates.free
    active = n + np.flatnonzero(np.diag(joint_prior.covariance)[n:] > 0.0)
    gaussians = [node.fit.gaussian for node in nodes]
    u = np.array([node.u for node in nodes])
    fine = np.linspace(u[0], u[-1], FINE)
    probable = density(u, np.array([node.unlikelihood for node in nodes]), fine)
    weight = confidence(u, np.array([node.misfit for node in nodes]), fine)
    share = np.array([np.interp(fine, u, one) for one in np.eye(len(u))])
    left = _next(fine, probable, told[:, 0] @ share)
    known = 1.0 - left / joint_prior.variance_of_k_c(coordinates.prior)
    place = np.array([[*coordinates.position(b.soil), *b.gains[active - n]] for b in gaussians])
    unbiased = np.array([_unbiased_k_c(node, joint_prior, coordinates.prior) for node in nodes])
    place[:, _K_C] += known * (unbiased - place[:, _K_C])
    along = place.T @ share
    own = np.array([_in_coordinates(b.covariance, coordinates.log_directions(b.soil), free, active) for b in gaussians])
    centre = known * weight + (1.0 - known) * probable
    of_all, of_k_c = counted(centre, share.T @ told)
    mean = along @ of_all
    mean[_K_C] = along[_K_C] @ of_k_c
    off = along - mean[:, None]
    doubt = longer_side(fine - fine @ probable, weight)  # how unlike both distributions are counts, too
    spread = doubt * (off * weight) @ off.T
    covariance = np.tensordot(share @ weight, own, axes=1) + spread
    soil, gains = coordinates.soil_at(mean[: len(free)]), gaussians[0].gains.copy()
    gains[active - n] = mean[len(free) :]
    by_coordinates = np.zeros((n + len(gains), len(mean)))
    by_coordinates[:n, : len(free)] = coordinates.log_directions(soil)
    by_coordinates[active, len(free) + np.arange(len(active))] = 1.0
    return Gaussian(soil, gains, by_coordinates @ covariance @ by_coordinates.T)


def _in_coordinates(covariance: Array, directions: Array, free: Indices, active: Indices) -> Array:
    """Covariance (F + A, F + A) of coordinates and active gains, from that of logarithms and all gains."""
    kept = np.concatenate([free, active])
    back = np.eye(len(kept))
    back[: len(free), : len(free)] = np.linalg.inv(directions[free])
    return np.asarray(back @ covariance[np.ix_(kept, kept)] @ back.T)


def _next(fine: Array, probable: Array, value: Array) -> float:
    """A value (M,) known at places (M,), one standard deviation above the mean of these shares (M,)."""
    mean = float(fine @ probable)
    return float(np.interp(mean + math.sqrt((fine - mean) ** 2 @ probable), fine, value))


def _unbiased_k_c(node: Node, joint_prior: Gaussian, prior: SoilPrior) -> float:
    """Logarithm of k_c given n of which the mean over windows on one soil is that soil's, to second order.

    The model is all but linear in k_c, and so the mean of the posterior of its logarithm is biased down, and
    its mode by less.  With the information as density of the prior the mean would not be (Hartigan 1965, Ann.
    Math. Stat. 36:1137): that is half a variance above the mode, as far as it is the window that tells k_c.
    """
    variance = node.fit.mode.covariance[_K_C, _K_C]
    of_window = 1.0 - variance / joint_prior.conditioned_on(_N, node.u).variance_of_k_c(prior)
    return float(np.log(node.fit.mode.soil[_K_C]) + 0.5 * variance * of_window)


def density(u: Array, value: Array, fine: Array) -> Array:
    """Share of each of the fine places in a density that is -2 log known at u: its roots lie on straight lines."""
    density = np.exp(-0.5 * _signed_root(u, value, fine) ** 2)
    return np.asarray(density / density.sum())


def confidence(u: Array, value: Array, fine: Array) -> Array:
    """Share of each of the fine places in the confidence distribution of a profile that is -2 log known at u."""
    root = _signed_root(u, value, fine)
    density = np.exp(-0.5 * root**2) * np.maximum(np.gradient(root), 0.0)
    return np.asarray(density / density.sum())


def longer_side(off: Array, weight: Array) -> float:
    """Mean square on the longer side of places (M,) so far off a centre, of these shares, over that of all; 1 at least.

    What is said is a mean and one standard deviation: it must hold on either side.
    """
    square = float(weight @ off**2)
    sides = [weight * side for side in (off > 0.0, off < 0.0) if (weight * side).any()]
    return max([1.0, *(float(side @ off**2 / side.sum()) / square for side in sides)])


def _signed_root(u: Array, value: Array, fine: Array) -> Array:
    """Root of the rise above the least value, negative before it, by straight lines between those at u."""
    root = np.sqrt(np.maximum(value - value.min(), 0.0))
    sign = np.where(np.arange(len(u)) < int(np.argmin(value)), -1.0, 1.0)
    return np.asarray(np.interp(fine, u, sign * root))
