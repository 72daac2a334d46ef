"""Gauss-Newton on a window: soil posterior from whitened residuals and priors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.posterior import Posterior, SoilPrior
from soilbus.estimation.residuals import Latents, Linearised, WindowProblem
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil

Array = NDArray[np.float64]

MAX_ITERATIONS = 25
MAX_RESUMED = 8
CONVERGED = 1e-2
"""Squared length of a step in posterior standard deviations that ends the fit; the step is
still taken, and what it leaves is smaller by another such factor."""
SETTLING = 1.0
"""The same, below which the latents and gains join in."""
ENOUGH = 0.02
"""Relative fall of the cost below which the approach has done its part."""
MAX_LOG_STEP = 0.7
LOG_BOUND = 4.0
"""Prior standard deviations to which a free parameter is confined."""


@dataclass(frozen=True, slots=True)
class Fit:
    """Outcome of one fit.

    cost is -2 log posterior up to a constant: chi-square of the residuals, of the soil's
    prior and of the gains.  chi2 is cost per residual (reduced: each parameter has its
    prior as one more residual).  angle_curve (W, 4) is for
    resume().  gains are relative errors by problem.gain_names.
    """

    posterior: Posterior
    gains: Array
    latents: Latents
    angle_curve: Array
    cost: float
    rows: int
    iterations: int
    converged: bool

    @property
    def chi2(self) -> float:
        """Reduced chi-square."""
        return self.cost / max(self.rows, 1)


def fit_window(problem: WindowProblem, prior: SoilPrior, last: Fit | None = None) -> Fit | None:
    """Posterior of a window.

    With the fit of the window before, one descent from there; without, or where that
    fails, descents from several known soils, of which the best counts.  None if no
    descent ends at a finite optimum.
    """
    if last is not None:
        fit = resume(problem, prior, last)
        if fit is not None and fit.converged:
            return fit
    fits = [f for f in (descend(problem, prior, soil) for soil in starting_soils(prior)) if f is not None]
    done = [f for f in fits if f.converged] or fits
    return min(done, key=lambda f: f.cost) if done else None


def starting_soils(prior: SoilPrior) -> list[Soil]:
    """Prior median and a few unlike known soils, held parameters at their values."""
    held = prior.log_std == 0.0
    soils = [Soil(*prior.median.tolist())]
    for name in ("loam", "clayey_soil_38", "dry_sand", "heavy_clay_40", "wet_clay"):
        mixed = np.where(held, prior.median, np.asarray(SOILS[name]))
        low = prior.median * np.exp(-2.0 * prior.log_std)
        high = prior.median * np.exp(2.0 * prior.log_std)
        soils.append(Soil(*np.clip(mixed, low, high).tolist()))
    return soils


def descend(problem: WindowProblem, prior: SoilPrior, start: Soil) -> Fit | None:
    """Gauss-Newton from one start; None where the numbers stop being finite.

    Far from the optimum only the soil moves, with the latents at their measured values:
    latents and gains would take up whatever a wrong soil leaves.  Near it everything is
    relinearised together.
    """
    free = prior.free
    soil = np.where(prior.log_std > 0.0, np.asarray(start, float), prior.median)
    with np.errstate(all="ignore"):
        rough = _approach(problem, prior, free, soil)
        return None if rough is None else _settle(problem, prior, free, *rough)


def resume(problem: WindowProblem, prior: SoilPrior, last: Fit) -> Fit | None:
    """Descent from the optimum of a neighbouring window."""
    soil = np.where(prior.log_std > 0.0, np.asarray(last.posterior.soil), prior.median)
    with np.errstate(all="ignore"):
        return _settle(problem, prior, prior.free, soil, problem.start_on(last.angle_curve), 0, MAX_RESUMED)


def _approach(problem: WindowProblem, prior: SoilPrior, free: Array, soil: Array) -> tuple[Array, Latents, int] | None:
    """Levenberg-damped steps of the soil alone, until they are short."""
    no_gains = np.zeros(len(problem.gain_std))
    none = np.zeros(0, dtype=int)
    latents = problem.start(Soil(*soil.tolist()))
    point = _normal_equations(problem, prior, free, none, soil, no_gains, latents)
    damping, trials = 1e-3, 1
    while point is not None:
        step = _solve(point.information, point.gradient, damping)
        if step is None:
            return None
        if float(step @ point.information @ step) < SETTLING or trials >= MAX_ITERATIONS:
            return soil, latents, trials
        new_soil = _moved(prior, free, soil, step)
        new_latents = problem.start(Soil(*new_soil.tolist()), latents.entry_angle)
        new = _normal_equations(problem, prior, free, none, new_soil, no_gains, new_latents)
        trials += 1
        gain = -np.inf if new is None else point.cost - new.cost
        if new is not None and gain > 0.0:
            soil, latents, point, damping = new_soil, new_latents, new, damping * 0.1
        if gain <= 0.0:
            damping *= 10.0
        if (0.0 <= gain < ENOUGH * point.cost) or damping > 1e6:
            return soil, latents, trials
    return None


def _settle(
    problem: WindowProblem,
    prior: SoilPrior,
    free: Array,
    soil: Array,
    latents: Latents,
    trials: int,
    most: int = MAX_ITERATIONS,
) -> Fit | None:
    """Full steps of soil, gains and latents together from a point near the optimum."""
    gains = np.zeros(len(problem.gain_std))
    active = np.flatnonzero(problem.gain_std > 0.0)
    for iteration in range(1, most + 1):
        point = _normal_equations(problem, prior, free, active, soil, gains, latents)
        step = None if point is None else _solve(point.information, point.gradient, 0.0)
        if point is None or step is None:
            return None
        length = float(step @ point.information @ step)
        new_soil = _moved(prior, free, soil, step[: len(free)])
        gain_step = np.zeros(len(gains))
        gain_step[active] = step[len(free) :]
        latents = problem.updated(point.at, latents, new_soil - soil, gain_step)
        soil, gains = new_soil, gains + gain_step
        if length < CONVERGED:
            break
    covariance = _inverse(point.information)
    if covariance is None:
        return None
    log_covariance = np.zeros((6, 6))
    log_covariance[np.ix_(free, free)] = covariance[: len(free), : len(free)]
    return Fit(
        posterior=Posterior(Soil(*soil.tolist()), log_covariance),
        gains=gains,
        latents=latents,
        angle_curve=problem.angle_curve(latents),
        cost=point.cost - length,
        rows=point.at.known,
        iterations=trials + iteration,
        converged=length < CONVERGED,
    )


@dataclass(frozen=True, slots=True)
class _Point:
    """Gauss-Newton's normal equations at one point, prior included."""

    information: Array
    gradient: Array
    cost: float
    at: Linearised


def _normal_equations(
    problem: WindowProblem, prior: SoilPrior, free: Array, active: Array, soil: Array, gains: Array, latents: Latents
) -> _Point | None:
    """By log soil (free) and gains (active); None where the model is not finite."""
    try:
        at = problem.linearise(Soil(*soil.tolist()), gains, latents)
    except np.linalg.LinAlgError:
        return None
    columns = np.concatenate([1 + free, 7 + active])
    scale = np.concatenate([soil[free], np.ones(len(active))])
    weighed = at.weighed[:, columns] * scale
    pull = np.concatenate(
        [np.log(soil[free] / prior.median[free]) / prior.log_std[free], gains[active] / problem.gain_std[active]]
    )
    precision = np.concatenate([1.0 / prior.log_std[free], 1.0 / problem.gain_std[active]])
    cost = at.chi2 + float(pull @ pull)
    if not np.isfinite(cost):
        return None
    information = (at.rows[:, columns] * scale).T @ weighed + np.diag(precision**2)
    return _Point(information, weighed.T @ at.rows[:, 0] + precision * pull, cost, at)


def _moved(prior: SoilPrior, free: Array, soil: Array, log_step: Array) -> Array:
    """The soil after a step of its free logarithms, shortened and kept near the prior."""
    log_step = log_step * min(1.0, MAX_LOG_STEP / max(float(np.max(np.abs(log_step), initial=0.0)), 1e-12))
    centre, bound = np.log(prior.median[free]), LOG_BOUND * prior.log_std[free]
    new = soil.copy()
    new[free] = np.exp(np.clip(np.log(soil[free]) + log_step, centre - bound, centre + bound))
    return new


def _solve(information: Array, gradient: Array, damping: float) -> Array | None:
    damped = information + damping * np.diag(np.diag(information))
    inverse = _inverse(damped)
    return None if inverse is None else -inverse @ gradient


def _inverse(information: Array) -> Array | None:
    scale = 1.0 / np.sqrt(np.diag(information))
    try:
        inverse = np.linalg.inv(information * np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return None
    return inverse * np.outer(scale, scale) if np.isfinite(inverse).all() else None

