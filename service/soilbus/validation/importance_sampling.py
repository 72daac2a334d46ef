"""The posterior of a window by importance sampling: no assumption about its shape, only patience.

Soils are drawn from a mixture along n as `marginal` averages it, made wider and with heavier tails,
and each is weighed by the whole nonlinear model (e.g. Robert & Casella 2004, Monte Carlo
Statistical Methods, sect. 3.3).  The mean of such a posterior has the least mean square error that any
estimate can have, on average over the soils that what was known and the window allow.  It
takes hundreds of evaluations: for judging the estimator, not for the service.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.laplace import GRID_POINTS, Node, density, profile_over_n
from soilbus.estimation.multistart import Fit
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.parametrization import MAX_PHI, Coordinates
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.solver import Iterate, Objective, QuadraticModel
from soilbus.terra.wheel import Soil

TAILS = 5.0
"""Degrees of freedom of Student's t that the draws follow given n."""
WIDER = 1.2
"""Their covariance over that of the fit with this n."""
SINGULAR = 1e-9
"""Least eigenvalue of a matrix of correlations up to which it is singular."""
FLATTER = 0.5
"""Power of the density of n that n is drawn from."""
_K_C, _K_PHI, _N, _PHI = (PARAMETERS.index(name) for name in ("k_c", "k_phi", "n", "phi"))


class Samples(NamedTuple):
    """Logarithms (M, 6) of soils and their shares (M,) of the posterior probability.

    bound (M, 6, 6) is the Cramér-Rao bound of the logarithms where the window is of that soil.
    """

    logs: Array
    share: Array
    bound: Array

    @property
    def effective(self) -> float:
        """How many equally likely samples would tell as much (Kong)."""
        return float(1.0 / (self.share @ self.share))


def samples(
    problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian, found: Fit, count: int, rng: np.random.Generator
) -> Samples | None:
    """So many soils of the posterior; None where k_c, k_phi and n are not all free and told apart by the tyres."""
    with np.errstate(all="ignore"):
        along = profile_over_n(problem, prior, joint_prior, found)
        if along is None or len(along.nodes) < 3:
            return None
        coordinates = Coordinates(prior, float(problem.rig.width.mean()))
        drawn = _drawn(along.nodes, coordinates, count, rng)
        position = drawn.position
        u, nodes = np.array([node.u for node in along.nodes]), along.nodes
        fitting = Objective(along.problem, prior, joint_prior)
        log_share = np.full(count, -np.inf)
        logs = np.empty((count, len(PARAMETERS)))
        bound = np.zeros((count, len(PARAMETERS), len(PARAMETERS)))
        for i in range(count):
            soil = _soil_at(position[i], coordinates)
            logs[i] = np.log(soil)
            if soil[_K_PHI] > 0.0 and soil[_PHI] < MAX_PHI:
                near = nodes[int(np.argmin(np.abs(u - logs[i, _N])))]
                place, point = _point_at(fitting, soil, near)
                if point is None:
                    continue
                jacobian = np.linalg.slogdet(coordinates.log_directions(soil)[coordinates.free])[1]
                log_share[i] = jacobian - 0.5 * _unlikelihood(fitting, point) - drawn.log_density[i]
                covariance = np.asarray(np.linalg.inv(point.information))
                bound[i] = fitting.gaussian_with(place, covariance).posterior.log_covariance
    share = softmax(np.where(np.isfinite(log_share), log_share, -np.inf))
    kept = share > 0.0
    return Samples(logs[kept], share[kept], bound[kept])


class _Drawn(NamedTuple):
    """Positions (M, F) and the logarithms (M,) of the densities that they were drawn from."""

    position: Array
    log_density: Array


def _drawn(nodes: list[Node], coordinates: Coordinates, count: int, rng: np.random.Generator) -> _Drawn:
    """Positions about the nodes and what lies between them."""
    free = coordinates.free
    i = int(np.searchsorted(free, _N))
    others = np.delete(np.arange(len(free)), i)
    u = np.array([node.u for node in nodes])
    fine = np.linspace(u[0], u[-1], GRID_POINTS)
    weight = density(u, FLATTER * np.array([node.neg2_log_density for node in nodes]), fine)
    normals = [_normal(node, coordinates, others) for node in nodes]
    centre, roots = np.array([normal[0] for normal in normals]), np.array([normal[1] for normal in normals])
    cell = rng.choice(GRID_POINTS, count, p=weight)
    log_n = np.clip(fine[cell] + (fine[1] - fine[0]) * (rng.random(count) - 0.5), u[0], u[-1])
    below = np.clip(np.searchsorted(u, log_n) - 1, 0, len(u) - 2)
    share = (log_n - u[below]) / (u[below + 1] - u[below])
    roots = roots[below] * (1.0 - share)[:, None, None] + roots[below + 1] * share[:, None, None]
    normal = rng.standard_normal((count, len(others))) * np.sqrt(TAILS / rng.chisquare(TAILS, count))[:, None]
    position = np.empty((count, len(free)))
    position[:, i] = log_n
    position[:, others] = centre[below] * (1.0 - share)[:, None] + centre[below + 1] * share[:, None]
    position[:, others] += np.einsum("mij,mj->mi", roots, normal)
    tails = -0.5 * (TAILS + len(others)) * np.log1p((normal**2).sum(1) / TAILS)
    return _Drawn(position, np.log(weight[cell]) + tails - np.log(np.einsum("mii->mi", roots)).sum(1))


def _normal(node: Node, coordinates: Coordinates, others: NDArray[np.intp]) -> tuple[Array, Array]:
    """Centre (O,) and lower root (O, O) of the covariance to draw the other coordinates from.

    By the fit's moments, or by its curvature where they leave k_c's share no deviation.
    """
    free = coordinates.free
    for gaussian in (node.fit.gaussian, node.fit.mode):
        back = np.linalg.inv(coordinates.log_directions(gaussian.soil)[free])
        covariance = (back @ gaussian.covariance[np.ix_(free, free)] @ back.T)[np.ix_(others, others)]
        std = np.sqrt(covariance.diagonal())
        if np.linalg.eigvalsh(covariance / std / std[:, None])[0] > SINGULAR:
            break
    return coordinates.position(gaussian.soil)[others], np.asarray(np.linalg.cholesky(WIDER * covariance))


def _soil_at(position: Array, coordinates: Coordinates) -> Array:
    """The soil (6,) with these coordinates (F,), wherever they are; without k_phi where K_L is less than k_c asks for.

    `Coordinates.soil_at` would bring it near the prior, and its density would not be that of the draw.
    """
    soil = coordinates.soil_at(position)
    inside = np.allclose(coordinates.position(soil), position, rtol=0.0, atol=1e-9)
    return soil if inside else np.where(np.arange(len(soil)) == _K_PHI, 0.0, soil)


def _point_at(fitting: Objective, soil: Array, near: Node) -> tuple[Iterate, QuadraticModel | None]:
    """The window at a soil (6,), with the latents that are likeliest there."""
    problem, optimum = fitting.problem, near.fit.optimum
    latents = problem.with_entry_angles(optimum.latents, Soil(*soil.tolist()), optimum.gains)
    place = Iterate(soil, optimum.gains, latents, np.inf, 1)
    at = problem.linearise(place.as_soil(), place.gains, latents)
    latents = problem.updated(at, latents, np.zeros(len(PARAMETERS)), np.zeros(len(place.gains)))
    place = replace(place, latents=latents)
    return place, fitting.quadratic_model(place)


def _unlikelihood(fitting: Objective, point: QuadraticModel) -> float:
    """-2 log posterior density of a soil's logarithms up to a constant, whatever the gains (Laplace, all but exact)."""
    gains = slice(len(fitting.free), None)
    information, gradient = point.information[gains, gains], point.gradient[gains]
    fall = float(gradient @ np.linalg.solve(information, gradient))
    return point.neg2_log_posterior - fall + float(np.linalg.slogdet(information)[1])
