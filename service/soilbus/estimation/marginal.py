"""The posterior of a window where it is far from Gaussian: along the sinkage exponent n.

At constant loads, tyres of two widths measure two points of the pressure-sinkage curve,
and k_c, k_phi and n are three: the soils that explain a window lie on a bent ridge, along
which k_c rises and falls again while n only falls.  The covariance at its top says nothing
of where it leads.  So n is held at several values in turn, everything else is fitted, and
what these fits say is averaged with their probabilities (nested Laplace approximations:
Rue, Martino & Chopin 2009, J. R. Statist. Soc. B 71:319, sect. 3).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.belief import Belief
from soilbus.estimation.coordinates import BOUND, TYPICAL_DEPTH
from soilbus.estimation.gauss_newton import Fit, settled
from soilbus.estimation.normal_equations import Fitting, Place
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.residuals import WindowProblem

Array = NDArray[np.float64]

WELL_KNOWN = 0.05
"""Sd of the logarithm of n below which a posterior with one top counts as Gaussian."""
LONGEST = 0.1
"""Longest first step of the logarithm of n; each next one is longer."""
GROWTH = 1.4
MAX_STEPS = 12
UNLIKELY = 9.0
"""-2 log of a probability, relative to the greatest, where the ridge has ended."""
FINE = 400
"""Values of n that are averaged."""
_K_C, _K_PHI, _N = (PARAMETERS.index(name) for name in ("k_c", "k_phi", "n"))


class _Node(NamedTuple):
    """A fit with n held, at the logarithm u; unlikelihood is -2 log of its posterior density."""

    u: float
    fit: Fit
    unlikelihood: float


def with_whole(problem: WindowProblem, prior: SoilPrior, before: Belief, found: Fit) -> Fit:
    """The fit with mean and covariance of the whole posterior, where its top may not tell them.

    That is where k_c, k_phi and n are free and the tyres unlike, and n is badly known or
    there is a rival.  What is averaged is each held fit's belief, so its moments along k_c's
    share count; the present soil (`present`) comes after.
    """
    spread = math.sqrt(found.mode.covariance[_N, _N])
    ridge = prior.log_std[[_K_C, _K_PHI, _N]].all() and np.ptp(problem.rig.width) > 0.0
    if not ridge or (spread < WELL_KNOWN and found.rival is None):
        return found
    with np.errstate(all="ignore"):
        top = _held(problem, prior, before, found, math.log(found.mode.soil[_N]))
        if top is None:
            return found
        step = min(spread, LONGEST)
        ways = [_along(problem, prior, before, top, way, step) for way in (-1.0, 1.0)]
        nodes = sorted([top, *ways[0], *ways[1]], key=lambda node: node.u)
        whole = _averaged(nodes, before) if len(nodes) > 2 else found.belief
    finite = np.isfinite(whole.soil).all() and np.isfinite(whole.covariance).all()
    return replace(found, averaged=whole) if finite else found


def _along(
    problem: WindowProblem, prior: SoilPrior, before: Belief, top: _Node, way: float, step: float
) -> list[_Node]:
    nodes: list[_Node] = []
    last, least = top, top.unlikelihood
    for _ in range(MAX_STEPS):
        node = _held(problem, prior, before, last.fit, last.u + way * step)
        if node is None:
            break
        nodes.append(node)
        last, least, step = node, min(least, node.unlikelihood), step * GROWTH
        if node.unlikelihood > least + UNLIKELY:
            break
    return nodes


def _held(problem: WindowProblem, prior: SoilPrior, before: Belief, near: Fit, u: float) -> _Node | None:
    """A fit with n held, from the optimum of one nearby."""
    soil, n = near.optimum.soil.copy(), math.exp(u)
    if abs(u - math.log(prior.median[_N])) > BOUND * prior.log_std[_N]:
        return None
    stiffer = TYPICAL_DEPTH ** (soil[_N] - n)
    soil[_N] = n
    soil[_K_C] *= stiffer if prior.log_std[_K_C] > 0.0 else 1.0
    soil[_K_PHI] *= stiffer
    deviation = (u - math.log(before.soil[_N])) / math.sqrt(before.covariance[_N, _N])
    median, log_std = prior.median.copy(), prior.log_std.copy()
    median[_N], log_std[_N] = n, 0.0
    fitting = Fitting(problem, SoilPrior(median, log_std), before.given(_N, u))
    fit = settled(fitting, Place(soil, near.optimum.gains, near.optimum.latents, np.inf, 1))
    return None if fit is None else _Node(u, fit, fit.evidence + deviation**2)


def _averaged(nodes: list[_Node], before: Belief) -> Belief:
    """Mean and covariance of the mixture of all nodes and of what lies between them, by straight lines."""
    beliefs = [node.fit.belief for node in nodes]
    u = np.array([node.u for node in nodes])
    fine = np.linspace(u[0], u[-1], FINE)
    with np.errstate(divide="ignore"):
        place = np.array([np.concatenate([np.log(b.soil), b.gains]) for b in beliefs])
    free = np.flatnonzero(np.diag(before.covariance) > 0.0)
    weight = np.exp(-0.5 * (_curve(u, np.array([node.unlikelihood for node in nodes]), fine)))
    weight /= weight.sum()
    along = np.array([np.interp(fine, u, column) for column in place.T[free]])
    of_node = np.array([np.interp(fine, u, one) @ weight for one in np.eye(len(u))])
    mean = along @ weight
    off = along - mean[:, None]
    covariance = np.tensordot(of_node, np.array([b.covariance for b in beliefs]), axes=1)
    covariance[np.ix_(free, free)] += (off * weight) @ off.T
    whole = place[0].copy()
    whole[free] = mean
    n = len(PARAMETERS)
    return replace(beliefs[0], soil=np.exp(whole[:n]), gains=whole[n:], covariance=covariance)


def _curve(u: Array, value: Array, fine: Array) -> Array:
    """The values between the nodes, above the least: squares of straight lines between their roots."""
    root = np.sqrt(np.maximum(value - value.min(), 0.0))
    sign = np.where(np.arange(len(u)) < int(np.argmin(value)), -1.0, 1.0)
    return np.asarray(np.interp(fine, u, sign * root) ** 2)
