"""Gauss-Newton on a window: soil posterior from whitened residuals and priors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Belief
from soilbus.estimation.model_form import FormLeft
from soilbus.estimation.observation_model import Bend, DenoisedProblem, Latents, Linearised, Optimum, WindowProblem
from soilbus.estimation.posterior import PARAMETERS, Posterior, SoilPrior
from soilbus.estimation.soil_classes import foretelling
from soilbus.estimation.solver import (
    CONVERGED_RESUMED,
    FAR,
    LEFT_OVER_RESUMED,
    LITTLE,
    Fitting,
    Place,
    Settled,
    approach,
    settle,
)
from soilbus.terra.soils import KINDS, SOILS
from soilbus.terra.wheel import Soil

__all__ = ["THOROUGH", "Effort", "Fit", "Rival", "Start", "continued", "descend", "fit_window"]

_K_C = PARAMETERS.index("k_c")

MAX_ITERATIONS = 30
MAX_RESUMED = 10
COMPARED = 2e-2
"""Foreseen fall of the cost that ends fits which are compared by cost."""
SLOWLY = 15.0
"""Fall of the cost that decides nothing, a few tenths, over that: near the end steps are cheap, in a valley they
are not."""
THINNED = 24
"""Instants of a window that the search for good starts looks at."""
MAX_KINDS = 2
"""Known soils that the search starts from where the first starts did not agree."""
MAX_APPROACH = 10
AS_MEASURED = 2.5
"""How many times the cost of an optimum that with the latents as measured may be, at the most."""
MAX_SETTLED = 2
MAX_HOPELESS = 5
HOPELESS = 60.0
"""Cost for each thinned instant beyond which the window cannot be one soil."""
APART = 2.0
"""Standard deviations between two optima from which they are told apart."""
ALIKE, WIDER = 0.5, 1.2
"""How far, and how many times wider, a posterior may be than its top says and count as Gaussian [sd]."""
RARE = 0.05
"""Share of the probability below which a rival does not count."""
PLAUSIBLE = 3.0
"""Cost per residual, gains held, up to which an optimum of the search may be the soil's."""
ILL_TOLD = 0.6
"""Std of log k_c below which a fit tells k_c, and no other optimum across it is looked for."""
FAR_ABOVE = 1.5
"""Ratio of costs on a few instants beyond which an end is no rival."""
SAME_END = 0.02
"""Relative difference in cost of two descents that are taken to have met at one optimum."""


class Start(NamedTuple):
    """Where a fit may begin: soil (6,), sensors' gains and effects' parameters (G,).

    near: a fit of the same model, be it to fewer instants, ended there.  latents: what is
    foreseen of the latents there, of use to fits to the same instants; checked: of those of
    instants that are held out.
    """

    soil: Array
    gains: Array
    near: bool = False
    latents: Latents | None = None
    checked: Latents | None = None


class Effort(NamedTuple):
    """What a fit is worth that is compared with others by cost.

    most: steps, half as many as long as the latents are as measured; hopeless: a cost such
    that a fit that will stay above it is given up; enough: foreseen fall of the cost that is
    not worth a further step; little: relative fall that is not while latents are as measured.
    """

    most: int = MAX_ITERATIONS
    hopeless: float = math.inf
    enough: float = COMPARED
    little: float = LITTLE

    @property
    def nothing(self) -> float:
        """Fall of the cost that decides nothing."""
        return SLOWLY * self.enough


THOROUGH = Effort()
"""As much as a fit can be worth."""


class Rival(NamedTuple):
    """Another optimum than a fit's, by mode and curvature, and its share of the probability of both (Laplace)."""

    belief: Belief
    share: float


@dataclass(frozen=True, slots=True)
class Fit:
    """Outcome of one fit.

    cost is -2 log posterior up to a constant: chi-square of the residuals and of what was
    known before; evidence is -2 log of the data's likelihood, up to the same.  chi2 is
    cost per residual (reduced: each parameter has its prior as one more residual).
    mode is where soil and gains (relative errors, by problem.gain_names) are most probable,
    with the curvature there; belief holds them by their moments along k_c's share (see
    `moments`), or as the mode does where that does not apply: short of convergence, or with a rival.
    sinkage (W,) is the mean over the window [m], nan where unknown; optimum is for resume();
    rival is another optimum that the data leave about as likely, where one was looked for
    and found; averaged is the mean of the whole posterior, where that was worked out (see
    `marginal`); bend: cost and evidence are those on a way that bends (see `bends`);
    off_scale: sinkages and all else agree on no soil (see `scale`); form: what the model's form leaves open.
    All are of a constant soil until `present` moves them to the window's end.
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
    rival: Rival | None = None
    averaged: Belief | None = None
    bend: Bend | None = None
    off_scale: bool = False
    form: FormLeft | None = None

    @property
    def posterior(self) -> Posterior:
        """What is known of the soil."""
        return self.belief.posterior

    @property
    def whole(self) -> Belief:
        """Soil and gains to be reported and passed on: the average where there is one, else both optima, or belief."""
        if self.averaged is not None:
            return self.averaged
        return self.belief if self.rival is None else self.belief.mixed(self.rival.belief, self.rival.share)

    @property
    def is_gaussian(self) -> bool:
        """Whether the whole posterior is much as its top says; else it cannot be the prior of later windows."""
        if self.averaged is None or self.rival is not None:
            return self.rival is None
        known = np.flatnonzero(np.diag(self.belief.covariance) > 0.0)
        own, whole = (b.covariance[np.ix_(known, known)] for b in (self.belief, self.averaged))
        wider = np.linalg.eigvals(np.linalg.solve(own, whole)).real
        return bool(self.posterior.distance(self.averaged.posterior.soil) < ALIKE and wider.max() < WIDER**2)

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
    fitting = Fitting(problem, prior, before)
    thin = Fitting(problem.thinned(THINNED), prior, before, with_gains=False)
    with np.errstate(all="ignore"):
        ends = _ends(thin)
        best, led = _best(fitting, ends)
        if best is None or best.chi2 > PLAUSIBLE:
            return best
        if not best.converged:
            near = approach(Fitting(problem, prior, before, with_gains=False), best.mode.soil, MAX_ITERATIONS, 0.0)
            best = best if near is None else _fit_at(fitting, settle(fitting, near, MAX_ITERATIONS)) or best
        if not best.converged:
            return calmed(fitting, best)
        return _with_rival(fitting, thin, best, ends, led)


def _best(fitting: Fitting, ends: Sequence[Place]) -> tuple[Fit | None, Place | None]:
    """Where the first of the optima on a few instants, the best first, leads that leads to one of all, and that one."""
    unlike = [end for i, end in enumerate(ends) if i == 0 or end.cost > ends[i - 1].cost * (1.0 + SAME_END)]
    best, led = None, None
    for end in unlike[:MAX_SETTLED]:
        most = MAX_ITERATIONS if end.cost < HOPELESS * THINNED else MAX_HOPELESS
        start = replace(fitting.start(end.soil), trials=end.trials)
        fit = _fit_at(fitting, settle(fitting, start, most))
        if fit is not None and (best is None or (fit.converged, -fit.cost) > (best.converged, -best.cost)):
            best, led = fit, end
        if best is not None and best.converged:
            break
    return best, led


def _with_rival(fitting: Fitting, thin: Fitting, found: Fit, ends: Sequence[Place], led: Place | None) -> Fit:
    """The more likely of an optimum and another one, with the other as its rival.

    The other is one of the ends on a few instants, but what `led` here, or the one across from what was found.
    That stays alone where there is no other, or none that is nearly as likely and that its
    standard deviations exclude.  Optima are compared, and mixed, as each is about its mode:
    moments along k_c's share would count the other one already.
    """
    end = _other_end(fitting, thin, found, ends, led) if np.ptp(fitting.problem.rig.width) > 0.0 else None
    if end is None:
        return found
    other = _fit_at(fitting, settle(fitting, fitting.start(end.soil), MAX_ITERATIONS))
    if other is None or not other.converged:
        return found
    better, worse = (found, other) if found.evidence <= other.evidence else (other, found)
    share = 1.0 / (1.0 + math.exp(min(0.5 * (worse.evidence - better.evidence), 50.0)))
    if share < RARE or better.mode.posterior.distance(worse.mode.posterior.soil) < APART:
        return better
    return replace(better, belief=better.mode, rival=Rival(worse.mode, share))


def _other_end(fitting: Fitting, thin: Fitting, found: Fit, ends: Sequence[Place], led: Place | None) -> Place | None:
    """Where a descent on a few instants ended about as low as at what was found, and far from it."""
    ill_told = math.sqrt(found.mode.covariance[_K_C, _K_C]) > ILL_TOLD
    apart = len({end.soil.tobytes() for end in ends}) > 1
    here = thin.point(thin.start(found.mode.soil)) if apart or ill_told else None
    if here is None:
        return None
    position = thin.coordinates.position(found.mode.soil)

    def off(end: Place) -> float:
        return here.length(thin.coordinates.position(end.soil) - position)

    def is_elsewhere(end: Place) -> bool:
        return end.cost < FAR_ABOVE * here.cost and off(end) > FAR**2

    def led_here(end: Place) -> bool:
        return led is not None and np.array_equal(end.soil, led.soil)

    nearest = min(map(off, ends))
    known = next((end for end in ends if is_elsewhere(end) and off(end) > nearest and not led_here(end)), None)
    start = fitting.coordinates.across(found.mode.soil) if ill_told and known is None else None
    if start is None:
        return known
    end = approach(thin, start, MAX_APPROACH)
    return end if end is not None and is_elsewhere(end) else None


def _ends(thin: Fitting) -> list[Place]:
    """Optima on a few instants of the window, the best first.

    Descents from unlike soils that meet at a plausible cost are proof enough; otherwise
    every start is tried.
    """
    ends: list[Place] = []
    for start in starting_soils(thin.problem, thin.coordinates.prior, thin.before):
        end = approach(thin, np.asarray(start), MAX_APPROACH, known=ends)
        if end is None:
            continue
        met = any(abs(end.cost - other.cost) < SAME_END * other.cost for other in ends)
        ends.append(end)
        if met and end.cost < PLAUSIBLE * thin.problem.n_rows:
            break
    return sorted(ends, key=lambda end: end.cost)


def starting_soils(problem: WindowProblem, prior: SoilPrior, before: Belief | None = None) -> Iterator[Soil]:
    """What is believed (else the prior median), loam, and the known soils that foretell the window best."""
    yield Soil(*(prior.median if before is None else before.soil).tolist())
    likeliest, *others = foretelling(problem, [near(prior, SOILS[kind]) for kind in KINDS])
    yield likeliest
    yield near(prior, SOILS["loam"])
    yield from others[: MAX_KINDS - 1]


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
        near = approach(Fitting(problem, prior, before, with_gains=False), soil, MAX_ITERATIONS)
        fitting = Fitting(problem, prior, before)
        return None if near is None else _fit_at(fitting, settle(fitting, near, MAX_ITERATIONS))


def continued(
    problem: WindowProblem,
    prior: SoilPrior,
    before: Belief,
    start: Start,
    first: int,
    effort: Effort = THOROUGH,
) -> Fit | None:
    """Descent from a start, of whose gains those from the `first` on move with the soil from the beginning.

    Where a fit of the same model ended is near the optimum: everything moves from there,
    unless the numbers stop being finite.  The first step that makes things worse ends it: a slower descent is better.
    """
    fitting, (most, hopeless, enough, little) = Fitting(problem, prior, before), effort
    compared = partial(
        settle, fitting, left_over=enough, refusals=0, hopeless=hopeless, enough=enough, nothing=effort.nothing
    )
    gains = problem.allowed(np.where(problem.gain_std > 0.0, start.gains, 0.0))
    with np.errstate(all="ignore"):
        if start.near:
            place = fitting.near(start.soil, gains, start.latents)
            fit = _fit_at(fitting, compared(place, MAX_RESUMED))
            if fit is not None:
                return fit
        moving = Fitting(problem, prior, before, first=first)
        near = approach(moving, start.soil, most // 2, little, gains, hopeless=AS_MEASURED * hopeless)
        if near is None:
            return None
        return _fit_at(fitting, compared(near, most))


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
        end = settle(fitting, near, MAX_RESUMED, LEFT_OVER_RESUMED, first, enough=CONVERGED_RESUMED)
        return _fit_at(fitting, end)


def calmed(fitting: Fitting, fit: Fit) -> Fit:
    """A fit that has not converged, with the optimum of the denoised problem near it; as it is where there is none.

    Where loads and slips hardly vary, the fitted latents vary by noise alone, which Gauss-Newton takes for information:
    the steps it foresees are short, and the valley that they creep along has no end that means anything.  Without
    that noise (see `denoised`) the window is a plain regression, which prior and data make convex.
    """
    if not fit.chi2 < PLAUSIBLE:
        return fit
    optimum = fit.optimum
    with np.errstate(all="ignore"):
        calm = DenoisedProblem(fitting.problem, optimum)
        again = Fitting(calm, fitting.coordinates.prior, fitting.before)
        calm_place = Place(optimum.soil, optimum.gains, calm.latents, np.inf, 1)
        found = _fit_at(again, settle(again, calm_place, MAX_ITERATIONS, enough=CONVERGED_RESUMED))
        if found is None or not found.converged:
            return fit
        near = fitting.start(found.optimum.soil, optimum.latents.entry_angle, found.optimum.gains)
        first = fitting.point(near)
        place = near if first is None else fitting.moved(near, first, np.zeros(len(first.gradient)))
        point = fitting.point(place)
    if first is None or point is None:
        return fit
    return replace(
        fit,
        belief=found.belief,
        mode=found.mode,
        sinkage=found.sinkage,
        optimum=Optimum(fitting.problem.t, place.soil, place.gains, place.latents, point.at),
        cost=point.cost,
        evidence=point.evidence,
        iterations=fit.iterations + found.iterations,
        converged=True,
    )


def settled(fitting: Fitting, near: Place) -> Fit | None:
    """Descent from a place near the optimum; None where the numbers stop being finite."""
    return _fit_at(fitting, settle(fitting, near, MAX_RESUMED, LEFT_OVER_RESUMED))


def _fit_at(fitting: Fitting, end: Settled | None) -> Fit | None:
    """The end of a descent, with what is known there; None where the numbers stopped being finite."""
    beliefs = None if end is None else fitting.beliefs(end.place, end.point, end.last.soil)
    if end is None or beliefs is None:
        return None
    fallen = end.length if end.converged else 0.0
    return Fit(
        belief=beliefs[0] if end.converged else beliefs[1],
        mode=beliefs[1],
        sinkage=fitting.problem.mean_sinkage(end.place.as_soil(), end.place.gains, end.place.latents),
        optimum=Optimum(fitting.problem.t, end.last.soil, end.last.gains, end.last.latents, end.point.at),
        cost=end.point.cost - fallen,
        evidence=end.point.evidence - fallen,
        rows=fitting.problem.n_rows,
        iterations=end.iterations,
        converged=end.converged,
    )
