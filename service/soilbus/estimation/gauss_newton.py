"""Gauss-Newton on a window: soil posterior from whitened residuals and priors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.coordinates import Coordinates
from soilbus.estimation.posterior import Posterior, SoilPrior
from soilbus.estimation.residuals import Latents, Linearised, WindowProblem
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

MAX_ITERATIONS = 20
MAX_RESUMED = 8
CONVERGED = 1e-2
"""Squared length of a step in posterior standard deviations that ends the fit; the step is
still taken, and what it leaves is smaller by another such factor."""
SETTLING = 1.0
"""The same, below which the latents and gains join in."""
ENOUGH = 0.02
"""Relative fall of the cost below which the approach has done its part."""
WORSE = 1e-3
"""Relative rise of the cost that a step may bring: the weights move with the soil a little."""
THINNED = 24
"""Instants of a window that the search for good starts looks at."""
MAX_APPROACH = 10
MAX_SETTLED = 2
MAX_HOPELESS = 5
HOPELESS = 60.0
"""Cost for each thinned instant beyond which the window cannot be one soil."""
LONG_LOG_STEP = 0.1
"""Step of a log parameter from which the entry angles are solved again, not extrapolated."""


@dataclass(frozen=True, slots=True)
class Fit:
    """Outcome of one fit.

    cost is -2 log posterior up to a constant: chi-square of the residuals, of the soil's
    prior and of the gains.  chi2 is cost per residual (reduced: each parameter has its
    prior as one more residual).  sinkage (W,) is the mean over the
    window [m], nan where unknown; angle_curve (W, 4) is for resume().  gains are relative
    errors by problem.gain_names.
    """

    posterior: Posterior
    gains: Array
    sinkage: Array
    angle_curve: Array
    cost: float
    rows: int
    iterations: int
    converged: bool

    @property
    def chi2(self) -> float:
        """Reduced chi-square."""
        return self.cost / max(self.rows, 1)


def fit_window(problem: WindowProblem, prior: SoilPrior) -> Fit | None:
    """Posterior of a window of which nothing is known: descents from several soils, of which the best counts.

    None if no descent ends at a finite optimum.
    """
    best: Fit | None = None
    coordinates = _coordinates(problem, prior)
    with np.errstate(all="ignore"):
        for end in _promising(problem.thinned(THINNED), coordinates)[:MAX_SETTLED]:
            most = MAX_ITERATIONS if end.cost < HOPELESS * THINNED else MAX_HOPELESS
            fit = _settle(problem, coordinates, replace(end, latents=problem.start(end.as_soil())), most)
            if fit is not None and (best is None or (fit.converged, -fit.cost) > (best.converged, -best.cost)):
                best = fit
            if best is not None and best.converged:
                return best
    return best


def _promising(thin: WindowProblem, coordinates: Coordinates) -> list[_Place]:
    """Where descents on a few instants of the window end, the best first."""
    starts = [np.asarray(soil) for soil in starting_soils(coordinates.prior)]
    ends = [end for start in starts if (end := _approach(thin, coordinates, start, MAX_APPROACH)) is not None]
    return sorted(ends, key=lambda end: end.cost)


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
    coordinates = _coordinates(problem, prior)
    soil = np.where(prior.log_std > 0.0, np.asarray(start, float), prior.median)
    with np.errstate(all="ignore"):
        near = _approach(problem, coordinates, soil, MAX_ITERATIONS)
        return None if near is None else _settle(problem, coordinates, near, MAX_ITERATIONS)


def resume(problem: WindowProblem, prior: SoilPrior, last: Fit) -> Fit | None:
    """Descent from the optimum of a neighbouring window."""
    soil = np.where(prior.log_std > 0.0, np.asarray(last.posterior.soil), prior.median)
    with np.errstate(all="ignore"):
        near = _Place(soil, problem.start_on(last.angle_curve), last.gains, np.inf, 0)
        return _settle(problem, _coordinates(problem, prior), near, MAX_RESUMED)


def _coordinates(problem: WindowProblem, prior: SoilPrior) -> Coordinates:
    return Coordinates(prior, float(problem.rig.width.mean()))


@dataclass(frozen=True, slots=True)
class _Place:
    """A soil with its latents, what it costs, and how many evaluations led there."""

    soil: Array
    latents: Latents
    gains: Array
    cost: float
    trials: int

    def as_soil(self) -> Soil:
        return Soil(*self.soil.tolist())


def _approach(problem: WindowProblem, coordinates: Coordinates, soil: Array, most: int) -> _Place | None:
    """Levenberg-damped steps of the soil alone, until they are short."""
    no_gains = np.zeros(len(problem.gain_std))
    none = np.zeros(0, dtype=np.intp)
    latents = problem.start(Soil(*soil.tolist()))
    point = _normal_equations(problem, coordinates, none, soil, no_gains, latents)
    damping, trials = 1e-3, 1
    while point is not None:
        step = _solve(point.information, point.gradient, damping)
        if step is None:
            return None
        done = float(step @ point.information @ step) < SETTLING or trials >= most or damping > 1e6
        if done:
            return _Place(soil, latents, no_gains, point.cost, trials)
        new_soil = coordinates.moved(soil, step)
        new_latents = problem.start(Soil(*new_soil.tolist()), latents.entry_angle)
        new = _normal_equations(problem, coordinates, none, new_soil, no_gains, new_latents)
        trials += 1
        if new is None or new.cost >= point.cost:
            damping *= 10.0
            continue
        enough = point.cost - new.cost < ENOUGH * point.cost
        soil, latents, point, damping = new_soil, new_latents, new, damping * 0.1
        if enough:
            return _Place(soil, latents, no_gains, point.cost, trials)
    return None


def _settle(problem: WindowProblem, coordinates: Coordinates, near: _Place, most: int) -> Fit | None:
    """Steps of soil, gains and latents together from a place near the optimum.

    A step that makes things worse is taken back and tried again damped.
    """
    free = coordinates.free
    active = np.flatnonzero(problem.gain_std > 0.0)
    soil, latents, gains = near.soil, near.latents, near.gains
    best: tuple[Array, Latents, Array, _Point] | None = None
    damping, length = 0.0, np.inf
    iterations = near.trials
    for _ in range(most):
        iterations += 1
        point = _normal_equations(problem, coordinates, active, soil, gains, latents)
        if best is not None and (point is None or point.cost > best[3].cost * (1.0 + WORSE) + 1.0):
            soil, latents, gains, point = best
            damping = max(4.0 * damping, 0.03)
        else:
            damping = damping / 4.0 if damping > 1e-3 else 0.0
        full = None if point is None else _solve(point.information, point.gradient, 0.0)
        if point is None or full is None:
            return None
        best = (soil, latents, gains, point)
        length = float(full @ point.information @ full)
        step = full if length < CONVERGED or damping == 0.0 else _solve(point.information, point.gradient, damping)
        if step is None:
            return None
        new_soil = coordinates.moved(soil, step[: len(free)])
        gain_step = np.zeros(len(gains))
        gain_step[active] = step[len(free) :]
        latents = problem.updated(point.at, latents, new_soil - soil, gain_step)
        if np.max(np.abs(np.log(new_soil[free] / soil[free])), initial=0.0) > LONG_LOG_STEP:
            latents = problem.carried(latents, Soil(*new_soil.tolist()))
        soil, gains = new_soil, gains + gain_step
        if length < CONVERGED:
            break
    inverse = None if best is None else solved(best[3].information, best[3].gradient)
    if best is None or inverse is None:
        return None
    point, covariance = best[3], inverse[1]
    directions = coordinates.log_directions(soil)
    log_covariance = directions @ covariance[: len(free), : len(free)] @ directions.T
    return Fit(
        posterior=Posterior(Soil(*soil.tolist()), log_covariance),
        gains=gains,
        sinkage=problem.mean_sinkage(latents),
        angle_curve=problem.angle_curve(latents),
        cost=point.cost - length,
        rows=point.at.known,
        iterations=iterations,
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
    problem: WindowProblem, coordinates: Coordinates, active: Indices, soil: Array, gains: Array, latents: Latents
) -> _Point | None:
    """By soil coordinates and active gains; None where the model is not finite."""
    try:
        at = problem.linearise(Soil(*soil.tolist()), gains, latents)
    except np.linalg.LinAlgError:
        return None
    by_soil = soil[:, None] * coordinates.log_directions(soil)
    rows = np.concatenate([at.rows[:, 1:7] @ by_soil, at.rows[:, 7 + active]], axis=1)
    weighed = np.concatenate([at.weighed[:, 1:7] @ by_soil, at.weighed[:, 7 + active]], axis=1)
    soil_pull, by_pull = coordinates.prior_pull(soil)
    gain_pull = gains[active] / problem.gain_std[active]
    cost = at.chi2 + float(soil_pull @ soil_pull) + float(gain_pull @ gain_pull)
    if not np.isfinite(cost):
        return None
    information, gradient = rows.T @ weighed, weighed.T @ at.rows[:, 0]
    n = len(coordinates.free)
    information[:n, :n] += by_pull.T @ by_pull
    gradient[:n] += by_pull.T @ soil_pull
    information[n:, n:] += np.diag(1.0 / problem.gain_std[active] ** 2)
    gradient[n:] += gain_pull / problem.gain_std[active]
    return _Point(information, gradient, cost, at)


def _solve(information: Array, gradient: Array, damping: float) -> Array | None:
    step = solved(information + damping * np.diag(np.diag(information)), gradient)
    return None if step is None else -step[0]


def solved(information: Array, gradient: Array) -> tuple[Array, Array] | None:
    """information^-1 gradient and information^-1, (F,) and (F, F); None where it is singular."""
    scale = 1.0 / np.sqrt(np.diag(information))
    try:
        inverse = np.linalg.inv(information * np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return None
    inverse = inverse * np.outer(scale, scale)
    return (inverse @ gradient, inverse) if np.isfinite(inverse).all() else None
