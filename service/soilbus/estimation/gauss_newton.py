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
MAX_RESUMED = 10
CONVERGED = 1e-6
"""Squared length of a step in posterior standard deviations that ends the fit."""
LEFT_OVER = 1e-5
"""The same for what a full step leaves behind, foreseen from how fast the steps shrink: small
enough that live and replayed windows agree to the resolution of our frames."""
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
MAX_REFUSED = 5
"""Steps taken back after which a fit has failed: what is left is noise of the linear model."""
PLAUSIBLE = 3.0
"""Cost per residual, gains held, up to which an optimum of the search may be the soil's."""
SAME_END = 0.02
"""Relative difference in cost of two descents that are taken to have met at one optimum."""
LONG_TURN = 0.2
"""Relative change of an entry angle from which the angles are solved again, not extrapolated."""


@dataclass(frozen=True, slots=True)
class Fit:
    """Outcome of one fit.

    cost is -2 log posterior up to a constant: chi-square of the residuals, of the soil's
    prior and of the gains.  chi2 is cost per residual (reduced: each parameter has its
    prior as one more residual).  sinkage (W,) is the mean over the
    window [m], nan where unknown; gains are relative errors by problem.gain_names.
    angle_curve (W, 4), and the latents at the instants t (N,), are for resume().
    """

    posterior: Posterior
    gains: Array
    sinkage: Array
    angle_curve: Array
    t: Array
    latents: Latents
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
    """Optima on a few instants of the window, the best first.

    Descents from unlike soils that meet at a plausible cost are proof enough; otherwise
    every start is tried.
    """
    ends: list[_Place] = []
    for start in starting_soils(coordinates.prior):
        end = _approach(thin, coordinates, np.asarray(start), MAX_APPROACH)
        if end is None:
            continue
        met = any(abs(end.cost - other.cost) < SAME_END * other.cost for other in ends)
        ends.append(end)
        if met and end.cost < PLAUSIBLE * thin.n_rows:
            break
    ends.sort(key=lambda end: end.cost)
    return [end for i, end in enumerate(ends) if i == 0 or end.cost > ends[i - 1].cost * (1.0 + SAME_END)]


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
        near = _Place(soil, problem.start_on(last.angle_curve, last.t, last.latents), last.gains, np.inf, 0)
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

    A step that makes things worse is taken back and tried again shorter: damping would
    hold back just the weak directions, along which the steps overshoot.
    """
    free = coordinates.free
    active = np.flatnonzero(problem.gain_std > 0.0)
    soil, latents, gains = near.soil, near.latents, near.gains
    best: tuple[Array, Latents, Array, _Point] | None = None
    share, length, before, refused = 1.0, np.inf, 0.0, 0
    iterations, converged = near.trials, False
    for _ in range(most):
        iterations += 1
        point = _normal_equations(problem, coordinates, active, soil, gains, latents)
        if best is not None and (point is None or point.cost > best[3].cost * (1.0 + WORSE) + 1.0):
            soil, latents, gains, point = best
            share *= 0.4
            before = 0.0  # nothing can be foreseen after a refused step
            refused += 1
            if refused > MAX_REFUSED:
                break
        else:
            share = min(2.0 * share, 1.0)
        full = None if point is None else _solve(point.information, point.gradient, 0.0)
        if point is None or full is None:
            return None
        best = (soil, latents, gains, point)
        length = float(full @ point.information @ full)
        step = share * full
        new_soil = coordinates.moved(soil, step[: len(free)])
        gain_step = np.zeros(len(gains))
        gain_step[active] = step[len(free) :]
        angles = latents.entry_angle
        latents = problem.updated(point.at, latents, new_soil - soil, gain_step)
        if np.max(np.abs(latents.entry_angle / angles - 1.0), initial=0.0) > LONG_TURN:
            latents = problem.carried(latents, Soil(*new_soil.tolist()))
        soil, gains = new_soil, gains + gain_step
        converged = length < CONVERGED or (share == 1.0 and length * length < LEFT_OVER * before)
        before = length if share == 1.0 else 0.0
        if converged:
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
        t=problem.t,
        latents=latents,
        cost=point.cost - length,
        rows=point.at.known,
        iterations=iterations,
        converged=converged,
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
    soil_pull, by_pull = coordinates.prior_pull(soil)
    gain_pull = gains[active] / problem.gain_std[active]
    cost = at.chi2 + float(soil_pull @ soil_pull) + float(gain_pull @ gain_pull)
    if not np.isfinite(cost):
        return None
    free = len(coordinates.free)
    directions = np.zeros((len(at.normal), 1 + free + len(active)))  # of the residual, coordinates and gains
    directions[0, 0] = 1.0
    directions[1:7, 1 : 1 + free] = soil[:, None] * coordinates.log_directions(soil)
    directions[7 + active, 1 + free + np.arange(len(active))] = 1.0
    normal = directions.T @ at.normal @ directions
    information, gradient = normal[1:, 1:], normal[1:, 0]
    information[:free, :free] += by_pull.T @ by_pull
    gradient[:free] += by_pull.T @ soil_pull
    information[free:, free:] += np.diag(1.0 / problem.gain_std[active] ** 2)
    gradient[free:] += gain_pull / problem.gain_std[active]
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
