"""Importance sampling of a window's posterior: no assumption about its shape.

    share_i = p(soil_i | window) / q(soil_i), normalised;     q: mixture of Student's t along n

The proposal q takes the nodes in n of the nested Laplace approximation (estimation/laplace.py), with a wider covariance
and heavier tails; each draw is weighed by the whole nonlinear model (Robert & Casella 2004, Monte Carlo Statistical
Methods, sect. 3.3). The mean of such a posterior has the least mean square error of any estimate, averaged over the
soils that prior and window allow. It takes hundreds of evaluations, so it serves to judge the estimator only.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.laplace import Node, density, profile_over_n
from soilbus.estimation.multistart import Fit
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.parametrization import MAX_PHI, Coordinates
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.solver import Iterate, Objective, QuadraticModel
from soilbus.terra.wheel import Soil

PROPOSAL_DOF = 5.0
"""Degrees of freedom of the Student's t that the draws follow at a given n."""
COVARIANCE_RATIO = 1.2
"""Covariance of the draws over that of the fit at the same n."""
PROPOSAL_DENSITY_POWER = 0.5
"""Power of the density of n that n is drawn from."""
_K_C, _K_PHI, _N, _PHI = (PARAMETERS.index(name) for name in ("k_c", "k_phi", "n", "phi"))


class PosteriorSamples(NamedTuple):
    """Weighted samples of the posterior.

    Attributes
    ----------
    logs
        Logarithms of the soils (M, 6).
    share
        Posterior probabilities (M,).
    bound
        Cramer-Rao bounds of the logarithms at each soil (M, 6, 6).
    """

    logs: Array
    share: Array
    bound: Array

    @property
    def effective(self) -> float:
        """Number of equally likely samples with the same information (Kong)."""
        return float(1.0 / (self.share @ self.share))


def sample_posterior(
    problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian, fit: Fit, count: int, rng: np.random.Generator
) -> PosteriorSamples | None:
    """Samples of the posterior of a window.

    Parameters
    ----------
    problem, prior, joint_prior, fit
        The window, its priors and its fit.
    count
        Number of draws.
    rng
        Random numbers.

    Returns
    -------
    None where k_c, k_phi and n are not all free, or the tyres do not separate k_c from k_phi.
    """
    with np.errstate(all="ignore"):
        along = profile_over_n(problem, prior, joint_prior, fit)
        if along is None or len(along.nodes) < 3:
            return None
        coordinates = Coordinates(prior, float(problem.rig.width.mean()))
        draws = _draws(along.nodes, coordinates, count, rng)
        position = draws.position
        u, nodes = np.array([node.u for node in along.nodes]), along.nodes
        objective = Objective(along.problem, prior, joint_prior)
        log_share = np.full(count, -np.inf)
        logs = np.empty((count, len(PARAMETERS)))
        bound = np.zeros((count, len(PARAMETERS), len(PARAMETERS)))
        for i in range(count):
            soil = _soil_at(position[i], coordinates)
            logs[i] = np.log(soil)
            if soil[_K_PHI] > 0.0 and soil[_PHI] < MAX_PHI:
                near = nodes[int(np.argmin(np.abs(u - logs[i, _N])))]
                iterate, quadratic = _quadratic_at(objective, soil, near)
                if quadratic is None:
                    continue
                jacobian = np.linalg.slogdet(coordinates.log_directions(soil)[coordinates.free])[1]
                log_share[i] = jacobian - 0.5 * _neg2_log_density(objective, quadratic) - draws.log_density[i]
                covariance = np.asarray(np.linalg.inv(quadratic.information))
                bound[i] = objective.gaussian(iterate.soil, iterate.gains, covariance).posterior.log_covariance
    share = softmax(np.where(np.isfinite(log_share), log_share, -np.inf))
    kept = share > 0.0
    return PosteriorSamples(logs[kept], share[kept], bound[kept])


class _Draws(NamedTuple):
    """Positions (M, F) and the logarithms (M,) of the densities that they were drawn from."""

    position: Array
    log_density: Array


def _draws(nodes: list[Node], coordinates: Coordinates, count: int, rng: np.random.Generator) -> _Draws:
    """Positions drawn from the proposal: n from its flattened density, the other coordinates given n."""
    free = coordinates.free
    i = int(np.searchsorted(free, _N))
    others = np.delete(np.arange(len(free)), i)
    u = np.array([node.u for node in nodes])
    fine = np.linspace(u[0], u[-1], 400)
    weight = density(u, PROPOSAL_DENSITY_POWER * np.array([node.neg2_log_density for node in nodes]), fine)
    normals = [_normal(node, coordinates, others) for node in nodes]
    centre, roots = np.array([normal[0] for normal in normals]), np.array([normal[1] for normal in normals])
    cell = rng.choice(len(fine), count, p=weight)
    log_n = np.clip(fine[cell] + (fine[1] - fine[0]) * (rng.random(count) - 0.5), u[0], u[-1])
    below = np.clip(np.searchsorted(u, log_n) - 1, 0, len(u) - 2)
    share = (log_n - u[below]) / (u[below + 1] - u[below])
    roots = roots[below] * (1.0 - share)[:, None, None] + roots[below + 1] * share[:, None, None]
    normal = (
        rng.standard_normal((count, len(others))) * np.sqrt(PROPOSAL_DOF / rng.chisquare(PROPOSAL_DOF, count))[:, None]
    )
    position = np.empty((count, len(free)))
    position[:, i] = log_n
    position[:, others] = centre[below] * (1.0 - share)[:, None] + centre[below + 1] * share[:, None]
    position[:, others] += np.einsum("mij,mj->mi", roots, normal)
    tails = -0.5 * (PROPOSAL_DOF + len(others)) * np.log1p((normal**2).sum(1) / PROPOSAL_DOF)
    return _Draws(position, np.log(weight[cell]) + tails - np.log(np.einsum("mii->mi", roots)).sum(1))


def _normal(node: Node, coordinates: Coordinates, others: NDArray[np.intp]) -> tuple[Array, Array]:
    """Centre (O,) and lower root (O, O) of the covariance to draw the other coordinates from."""
    free, mode = coordinates.free, node.fit.mode
    back = np.linalg.inv(coordinates.log_directions(mode.soil)[free])
    covariance = (back @ mode.covariance[np.ix_(free, free)] @ back.T)[np.ix_(others, others)]
    return coordinates.position(mode.soil)[others], np.asarray(np.linalg.cholesky(COVARIANCE_RATIO * covariance))


def _soil_at(position: Array, coordinates: Coordinates) -> Array:
    """The soil (6,) with these coordinates (F,), wherever they are; without k_phi where K_L is less than k_c asks for.

    `Coordinates.soil_at` would bring it near the prior, and its density would not be that of the draw.
    """
    soil = coordinates.soil_at(position)
    inside = np.allclose(coordinates.position(soil), position, rtol=0.0, atol=1e-9)
    return soil if inside else np.where(np.arange(len(soil)) == _K_PHI, 0.0, soil)


def _quadratic_at(objective: Objective, soil: Array, near: Node) -> tuple[Iterate, QuadraticModel | None]:
    """The quadratic model at a soil (6,), with the likeliest latents there."""
    problem, optimum = objective.problem, near.fit.optimum
    latents = problem.with_entry_angles(optimum.latents, Soil(*soil.tolist()), optimum.gains)
    iterate = Iterate(soil, optimum.gains, latents)
    at = problem.linearise(iterate.as_soil(), iterate.gains, latents)
    latents = problem.updated(at, latents, np.zeros(len(PARAMETERS)), np.zeros(len(iterate.gains)))
    iterate = replace(iterate, latents=latents)
    return iterate, objective.quadratic_model(iterate)


def _neg2_log_density(objective: Objective, quadratic: QuadraticModel) -> float:
    """-2 log posterior density of a soil's logarithms up to a constant, gains integrated out (Laplace)."""
    gains = slice(len(objective.free), None)
    information, gradient = quadratic.information[gains, gains], quadratic.gradient[gains]
    fall = float(gradient @ np.linalg.solve(information, gradient))
    return quadratic.neg2_log_posterior - fall + float(np.linalg.slogdet(information)[1])
