"""Gauss-Newton on a window: soil posterior from whitened residuals and priors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.belief import Belief
from soilbus.estimation.linearised import Linearised, Optimum
from soilbus.estimation.normal_equations import Fitting, Place, Point
from soilbus.estimation.posterior import Posterior, SoilPrior
from soilbus.estimation.residuals import WindowProblem
from soilbus.estimation.soil_class import foretelling
from soilbus.terra.soils import KINDS, SOILS
from soilbus.terra.wheel import Soil

Array = NDArray[np.float64]

MAX_ITERATIONS = 30
MAX_RESUMED = 10
CONVERGED = 1e-6
"""Squared length of a step in posterior standard deviations that ends the fit."""
LEFT_OVER, LEFT_OVER_RESUMED = 1e-7, 1e-3
"""The same for what a full step leaves behind, foreseen from how fast the steps shrink."""
SETTLING = 1.0
"""The same, below which the latents and gains join in."""
ENOUGH = 0.02
"""Relative fall of the cost below which the approach has done its part."""
WORSE = 20.0
"""Rise of the cost that a step may bring: where the cost bends, steps that overshoot come back by themselves."""
THINNED = 24
"""Instants of a window that the search for good starts looks at."""
MAX_KINDS = 2
"""Known soils that the search starts from where the first starts did not agree."""
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


@dataclass(frozen=True, slots=True)
class Fit:
    """Outcome of one fit.

    cost is -2 log posterior up to a constant: chi-square of the residuals and of what was
    known before; evidence is -2 log of the data's likelihood, up to the same.  chi2 is
    cost per residual (reduced: each parameter has its prior as one more residual).
    belief holds soil and gains (relative errors, by problem.gain_names) by their means, for
    the windows to come; mode is where they are most probable, with the curvature there.
    sinkage (W,) is the mean over the window [m], nan where unknown; optimum is for resume().
    """

    belief: Belief
    mode: Belief
    sinkage: Array
    optimum: Optimum
    cost: float
    evidence: float
    rows: int
    iterations: int
    converged: bool

    @property
    def posterior(self) -> Posterior:
        """What is known of the soil."""
        return self.belief.posterior

    @property
    def gains(self) -> Array:
        """Relative errors of the sensors (G,), by problem.gain_names."""
        return self.belief.gains

    @property
    def chi2(self) -> float:
        """Reduced chi-square."""
        return self.cost / max(self.rows, 1)


def fit_window(problem: WindowProblem, prior: SoilPrior, before: Belief | None = None) -> Fit | None:
    """Posterior of a window of which nothing is known: descents from several soils, of which the best counts.

    `before` is what earlier windows told, in place of the prior.  None if no descent ends
    at a finite optimum.
    """
    before = Belief.of(prior, problem.gain_std) if before is None else before
    best: Fit | None = None
    fitting = Fitting(problem, prior, before)
    with np.errstate(all="ignore"):
        for end in _promising(Fitting(problem.thinned(THINNED), prior, before, with_gains=False), prior)[:MAX_SETTLED]:
            most = MAX_ITERATIONS if end.cost < HOPELESS * THINNED else MAX_HOPELESS
            fit = _settle(fitting, replace(fitting.start(end.soil), trials=end.trials), most)
            if fit is not None and (best is None or (fit.converged, -fit.cost) > (best.converged, -best.cost)):
                best = fit
            if best is not None and best.converged:
                return best
    return best


def _promising(thin: Fitting, prior: SoilPrior) -> list[Place]:
    """Optima on a few instants of the window, the best first.

    Descents from unlike soils that meet at a plausible cost are proof enough; otherwise
    every start is tried.
    """
    ends: list[Place] = []
    for start in starting_soils(thin.problem, prior, thin.before):
        end = _approach(thin, np.asarray(start), MAX_APPROACH)
        if end is None:
            continue
        met = any(abs(end.cost - other.cost) < SAME_END * other.cost for other in ends)
        ends.append(end)
        if met and end.cost < PLAUSIBLE * thin.problem.n_rows:
            break
    ends.sort(key=lambda end: end.cost)
    return [end for i, end in enumerate(ends) if i == 0 or end.cost > ends[i - 1].cost * (1.0 + SAME_END)]


def starting_soils(problem: WindowProblem, prior: SoilPrior, before: Belief | None = None) -> Iterator[Soil]:
    """What is believed (else the prior median), loam, and the known soils that foretell the window best."""
    yield Soil(*(prior.median if before is None else before.soil).tolist())
    yield near(prior, SOILS["loam"])
    yield from foretelling(problem, [near(prior, SOILS[kind]) for kind in KINDS])[:MAX_KINDS]


def near(prior: SoilPrior, soil: Soil) -> Soil:
    """The soil with held parameters at their values and the others within two standard deviations of the prior."""
    reach = np.exp(2.0 * prior.log_std)
    return Soil(*np.clip(soil, prior.median / reach, prior.median * reach).tolist())


def descend(problem: WindowProblem, prior: SoilPrior, start: Soil, before: Belief | None = None) -> Fit | None:
    """Gauss-Newton from one start; None where the numbers stop being finite.

    Far from the optimum only the soil moves, with the latents at their measured values:
    latents and gains would take up whatever a wrong soil leaves.  Near it everything is
    relinearised together.
    """
    before = Belief.of(prior, problem.gain_std) if before is None else before
    soil = np.where(prior.log_std > 0.0, np.asarray(start, float), prior.median)
    with np.errstate(all="ignore"):
        near = _approach(Fitting(problem, prior, before, with_gains=False), soil, MAX_ITERATIONS)
        return None if near is None else _settle(Fitting(problem, prior, before), near, MAX_ITERATIONS)


@dataclass(frozen=True, slots=True)
class Foreseen:
    """A window as the one just before lets expect it: linearised at that one's optimum."""

    fitting: Fitting
    place: Place
    at: Linearised


def foreseen(problem: WindowProblem, prior: SoilPrior, last: Fit, before: Belief | None = None) -> Foreseen:
    """A window at the optimum of the one just before, where what both share is linearised already."""
    fitting = Fitting(problem, prior, Belief.of(prior, problem.gain_std) if before is None else before)
    with np.errstate(all="ignore"):
        latents, at = problem.after(last.optimum)
    soil = np.where(prior.log_std > 0.0, last.optimum.soil, prior.median)
    return Foreseen(fitting, Place(soil, last.optimum.gains, latents, np.inf, 1), at)


def resume(ahead: Foreseen) -> Fit | None:
    """Descent from the optimum of the window just before; the first step costs nothing more."""
    fitting, near = ahead.fitting, ahead.place
    with np.errstate(all="ignore"):
        point = fitting.with_before(near, ahead.at)
        step = None if point is None else point.step()
        if point is not None and step is not None:
            near = fitting.moved(near, point, step)
        first = 0.0 if point is None or step is None else point.length(step)
        return _settle(fitting, near, MAX_RESUMED, LEFT_OVER_RESUMED, first)


def _approach(fitting: Fitting, soil: Array, most: int) -> Place | None:
    """Levenberg-damped steps of the soil alone, until they are short."""
    place = fitting.start(soil)
    point = fitting.point(place)
    damping, trials = 1e-3, 1
    while point is not None:
        step = point.step(damping)
        if step is None:
            return None
        if point.length(step) < SETTLING or trials >= most or damping > 1e6:
            return replace(place, cost=point.cost, trials=trials)
        new_soil = fitting.coordinates.moved(place.soil, step)
        new_place = fitting.start(new_soil, place.latents.entry_angle)
        new = fitting.point(new_place)
        trials += 1
        if new is None or new.cost >= point.cost:
            damping *= 10.0
            continue
        enough = point.cost - new.cost < ENOUGH * point.cost
        place, point, damping = new_place, new, damping * 0.1
        if enough:
            return replace(place, cost=point.cost, trials=trials)
    return None


def _settle(fitting: Fitting, near: Place, most: int, left_over: float = LEFT_OVER, before: float = 0.0) -> Fit | None:
    """Steps of soil, gains and latents together from a place near the optimum.

    `before` is the squared length of the step that led there, if it was one of these.
    A step that makes things worse is taken back and tried again shorter: damping would
    hold back just the weak directions, along which the steps overshoot.
    """
    best: tuple[Place, Point] | None = None
    share, length, refused = 1.0, np.inf, 0
    iterations, converged = near.trials, False
    for _ in range(most):
        iterations += 1
        point = fitting.point(near)
        if best is not None and (point is None or point.cost > best[1].cost + WORSE):
            near, point = best
            share *= 0.4
            before = 0.0  # nothing can be foreseen after a refused step
            refused += 1
            if refused > MAX_REFUSED:
                break
        else:
            share = min(2.0 * share, 1.0)
        full = None if point is None else point.step()
        if point is None or full is None:
            return None
        best = (near, point)
        length = point.length(full)
        near = fitting.moved(near, point, share * full)
        converged = length < CONVERGED or (share == 1.0 and length * length < left_over * before)
        before = length if share == 1.0 else 0.0
        if converged:
            break
    if best is None:
        return None
    last, point = best
    beliefs = fitting.beliefs(near, point)
    if beliefs is None:
        return None
    return Fit(
        belief=beliefs[0],
        mode=beliefs[1],
        sinkage=fitting.problem.mean_sinkage(near.latents),
        optimum=Optimum(fitting.problem.t, last.soil, last.gains, last.latents, point.at),
        cost=point.cost - length,
        evidence=point.evidence - length,
        rows=fitting.problem.n_rows,
        iterations=iterations,
        converged=converged,
    )
