"""Gauss-Newton on a window: soil posterior from whitened residuals and priors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.model_form import FormLeft
from soilbus.estimation.observation_model import (
    CurvedPathFit,
    DenoisedObservationModel,
    Latents,
    Linearisation,
    ObservationModel,
    Optimum,
)
from soilbus.estimation.posterior import PARAMETERS, Posterior, SoilPrior
from soilbus.estimation.soil_classes import ranked_by_likelihood
from soilbus.estimation.solver import (
    CONVERGED_RESUMED,
    FAR,
    LEFT_OVER_RESUMED,
    LITTLE,
    Descent,
    Iterate,
    Objective,
    descend_jointly,
    descend_soil,
)
from soilbus.terra.soils import KINDS, SOILS
from soilbus.terra.wheel import Soil

__all__ = ["DEFAULT_OPTIONS", "DescentOptions", "Fit", "SecondMode", "Start", "fit_from", "fit_from_soil", "fit_window"]

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


class DescentOptions(NamedTuple):
    """What a fit is worth that is compared with others by cost.

    most: steps, half as many as long as the latents are as measured; hopeless: a cost such
    that a fit that will stay above it is given up; enough: foreseen fall of the cost that is
    not worth a further step; little: relative fall that is not while latents are as measured.
    """

    most: int = MAX_ITERATIONS
    give_up_above: float = math.inf
    enough: float = COMPARED
    little: float = LITTLE

    @property
    def nothing(self) -> float:
        """Fall of the cost that decides nothing."""
        return SLOWLY * self.enough


DEFAULT_OPTIONS = DescentOptions()
"""The full budget of a fit."""


class SecondMode(NamedTuple):
    """Another optimum than a fit's, by mode and curvature, and its share of the probability of both (Laplace)."""

    gaussian: Gaussian
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

    gaussian: Gaussian
    mode: Gaussian
    sinkage: Array
    optimum: Optimum
    neg2_log_posterior: float
    neg2_log_evidence: float
    rows: int
    iterations: int
    converged: bool
    second_mode: SecondMode | None = None
    marginalised: Gaussian | None = None
    curved_path: CurvedPathFit | None = None
    off_scale: bool = False
    form: FormLeft | None = None

    @property
    def posterior(self) -> Posterior:
        """What is known of the soil."""
        return self.gaussian.posterior

    @property
    def reported(self) -> Gaussian:
        """Soil and gains to be reported and passed on: the average where there is one, else both optima, or belief."""
        if self.marginalised is not None:
            return self.marginalised
        return (
            self.gaussian
            if self.second_mode is None
            else self.gaussian.mixture(self.second_mode.gaussian, self.second_mode.share)
        )

    @property
    def is_gaussian(self) -> bool:
        """Whether the whole posterior is much as its top says; else it cannot be the prior of later windows."""
        if self.marginalised is None or self.second_mode is not None:
            return self.second_mode is None
        known = np.flatnonzero(np.diag(self.gaussian.covariance) > 0.0)
        own, whole = (b.covariance[np.ix_(known, known)] for b in (self.gaussian, self.marginalised))
        wider = np.linalg.eigvals(np.linalg.solve(own, whole)).real
        return bool(self.posterior.distance(self.marginalised.posterior.soil) < ALIKE and wider.max() < WIDER**2)

    @property
    def gains(self) -> Array:
        """Relative errors of the sensors (G,), by problem.gain_names."""
        return self.gaussian.gains

    @property
    def chi2(self) -> float:
        """Reduced chi-square."""
        return self.neg2_log_posterior / max(self.rows, 1)


def fit_window(problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian | None = None) -> Fit | None:
    """Posterior of a window of which nothing is known: descents from several soils, of which the best counts.

    `joint_prior` is what earlier windows told, in place of the prior.  None if no descent ends
    at a finite optimum.
    """
    joint_prior = Gaussian.of(prior, problem.gain_std) if joint_prior is None else joint_prior
    fitting = Objective(problem, prior, joint_prior)
    thin = Objective(problem.thinned(THINNED), prior, joint_prior, with_gains=False)
    with np.errstate(all="ignore"):
        ends = _ends(thin)
        best, led = _best(fitting, ends)
        if best is None or best.chi2 > PLAUSIBLE:
            return best
        if not best.converged:
            near = descend_soil(
                Objective(problem, prior, joint_prior, with_gains=False), best.mode.soil, MAX_ITERATIONS, 0.0
            )
            best = best if near is None else _fit_at(fitting, descend_jointly(fitting, near, MAX_ITERATIONS)) or best
        if not best.converged:
            return refit_denoised(fitting, best)
        return _with_rival(fitting, thin, best, ends, led)


def _best(fitting: Objective, ends: Sequence[Iterate]) -> tuple[Fit | None, Iterate | None]:
    """Where the first of the optima on a few instants, the best first, leads that leads to one of all, and that one."""
    unlike = [
        end
        for i, end in enumerate(ends)
        if i == 0 or end.neg2_log_posterior > ends[i - 1].neg2_log_posterior * (1.0 + SAME_END)
    ]
    best, led = None, None
    for end in unlike[:MAX_SETTLED]:
        most = MAX_ITERATIONS if end.neg2_log_posterior < HOPELESS * THINNED else MAX_HOPELESS
        start = replace(fitting.start(end.soil), trials=end.trials)
        fit = _fit_at(fitting, descend_jointly(fitting, start, most))
        if fit is not None and (
            best is None or (fit.converged, -fit.neg2_log_posterior) > (best.converged, -best.neg2_log_posterior)
        ):
            best, led = fit, end
        if best is not None and best.converged:
            break
    return best, led


def _with_rival(fitting: Objective, thin: Objective, found: Fit, ends: Sequence[Iterate], led: Iterate | None) -> Fit:
    """The more likely of an optimum and another one, with the other as its rival.

    The other is one of the ends on a few instants, but what `led` here, or the one across from what was found.
    That stays alone where there is no other, or none that is nearly as likely and that its
    standard deviations exclude.  Optima are compared, and mixed, as each is about its mode:
    moments along k_c's share would count the other one already.
    """
    end = _other_end(fitting, thin, found, ends, led) if np.ptp(fitting.problem.rig.width) > 0.0 else None
    if end is None:
        return found
    other = _fit_at(fitting, descend_jointly(fitting, fitting.start(end.soil), MAX_ITERATIONS))
    if other is None or not other.converged:
        return found
    better, worse = (found, other) if found.neg2_log_evidence <= other.neg2_log_evidence else (other, found)
    share = 1.0 / (1.0 + math.exp(min(0.5 * (worse.neg2_log_evidence - better.neg2_log_evidence), 50.0)))
    if share < RARE or better.mode.posterior.distance(worse.mode.posterior.soil) < APART:
        return better
    return replace(better, gaussian=better.mode, second_mode=SecondMode(worse.mode, share))


def _other_end(
    fitting: Objective, thin: Objective, found: Fit, ends: Sequence[Iterate], led: Iterate | None
) -> Iterate | None:
    """Where a descent on a few instants ended about as low as at what was found, and far from it."""
    ill_told = math.sqrt(found.mode.covariance[_K_C, _K_C]) > ILL_TOLD
    apart = len({end.soil.tobytes() for end in ends}) > 1
    here = thin.point(thin.start(found.mode.soil)) if apart or ill_told else None
    if here is None:
        return None
    position = thin.coordinates.position(found.mode.soil)

    def off(end: Iterate) -> float:
        return here.length(thin.coordinates.position(end.soil) - position)

    def is_elsewhere(end: Iterate) -> bool:
        return end.neg2_log_posterior < FAR_ABOVE * here.neg2_log_posterior and off(end) > FAR**2

    def led_here(end: Iterate) -> bool:
        return led is not None and np.array_equal(end.soil, led.soil)

    nearest = min(map(off, ends))
    known = next((end for end in ends if is_elsewhere(end) and off(end) > nearest and not led_here(end)), None)
    start = fitting.coordinates.across(found.mode.soil) if ill_told and known is None else None
    if start is None:
        return known
    end = descend_soil(thin, start, MAX_APPROACH)
    return end if end is not None and is_elsewhere(end) else None


def _ends(thin: Objective) -> list[Iterate]:
    """Optima on a few instants of the window, the best first.

    Descents from unlike soils that meet at a plausible cost are proof enough; otherwise
    every start is tried.
    """
    ends: list[Iterate] = []
    for start in starting_soils(thin.problem, thin.coordinates.prior, thin.joint_prior):
        end = descend_soil(thin, np.asarray(start), MAX_APPROACH, known=ends)
        if end is None:
            continue
        met = any(
            abs(end.neg2_log_posterior - other.neg2_log_posterior) < SAME_END * other.neg2_log_posterior
            for other in ends
        )
        ends.append(end)
        if met and end.neg2_log_posterior < PLAUSIBLE * thin.problem.n_rows:
            break
    return sorted(ends, key=lambda end: end.neg2_log_posterior)


def starting_soils(problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian | None = None) -> Iterator[Soil]:
    """What is believed (else the prior median), loam, and the known soils that foretell the window best."""
    yield Soil(*(prior.median if joint_prior is None else joint_prior.soil).tolist())
    likeliest, *others = ranked_by_likelihood(problem, [near(prior, SOILS[kind]) for kind in KINDS])
    yield likeliest
    yield near(prior, SOILS["loam"])
    yield from others[: MAX_KINDS - 1]


def near(prior: SoilPrior, soil: Soil) -> Soil:
    """The soil with held parameters at their values and the others within two standard deviations of the prior."""
    reach = np.exp(2.0 * prior.log_std)
    return Soil(*np.clip(soil, prior.median / reach, prior.median * reach).tolist())


def fit_from_soil(
    problem: ObservationModel, prior: SoilPrior, start: Soil, joint_prior: Gaussian | None = None
) -> Fit | None:
    """Gauss-Newton from one start; None where the numbers stop being finite.

    Far from the optimum only the soil moves, with the latents at their measured values:
    latents and gains would take up whatever a wrong soil leaves.  Near it everything is
    relinearised together.
    """
    joint_prior = Gaussian.of(prior, problem.gain_std) if joint_prior is None else joint_prior
    soil = np.where(prior.log_std > 0.0, np.asarray(start, float), prior.median)
    with np.errstate(all="ignore"):
        near = descend_soil(Objective(problem, prior, joint_prior, with_gains=False), soil, MAX_ITERATIONS)
        fitting = Objective(problem, prior, joint_prior)
        return None if near is None else _fit_at(fitting, descend_jointly(fitting, near, MAX_ITERATIONS))


def fit_from(
    problem: ObservationModel,
    prior: SoilPrior,
    joint_prior: Gaussian,
    start: Start,
    first: int,
    effort: DescentOptions = DEFAULT_OPTIONS,
) -> Fit | None:
    """Descent from a start, of whose gains those from the `first` on move with the soil from the beginning.

    Where a fit of the same model ended is near the optimum: everything moves from there,
    unless the numbers stop being finite.  The first step that makes things worse ends it: a slower descent is better.
    """
    fitting, (most, give_up_above, enough, little) = Objective(problem, prior, joint_prior), effort
    compared = partial(
        descend_jointly,
        fitting,
        left_over=enough,
        refusals=0,
        give_up_above=give_up_above,
        enough=enough,
        nothing=effort.nothing,
    )
    gains = problem.allowed(np.where(problem.gain_std > 0.0, start.gains, 0.0))
    with np.errstate(all="ignore"):
        if start.near:
            place = fitting.near(start.soil, gains, start.latents)
            fit = _fit_at(fitting, compared(place, MAX_RESUMED))
            if fit is not None:
                return fit
        moving = Objective(problem, prior, joint_prior, first=first)
        near = descend_soil(moving, start.soil, most // 2, little, gains, give_up_above=AS_MEASURED * give_up_above)
        if near is None:
            return None
        return _fit_at(fitting, compared(near, most))


@dataclass(frozen=True, slots=True)
class WarmStart:
    """A window as the one just before lets expect it: linearised at that one's optimum."""

    fitting: Objective
    place: Iterate
    at: Linearisation


def warm_start(
    problem: ObservationModel, prior: SoilPrior, last: Fit, joint_prior: Gaussian | None = None
) -> WarmStart:
    """A window at the optimum of the one just before, where what both share is linearised already."""
    fitting = Objective(problem, prior, Gaussian.of(prior, problem.gain_std) if joint_prior is None else joint_prior)
    with np.errstate(all="ignore"):
        latents, at = problem.after(last.optimum)
    soil = np.where(prior.log_std > 0.0, last.optimum.soil, prior.median)
    return WarmStart(fitting, Iterate(soil, last.optimum.gains, latents, np.inf, 1), at)


def fit_warm(ahead: WarmStart) -> Fit | None:
    """Descent from the optimum of the window just before; the first step costs nothing more."""
    fitting, near = ahead.fitting, ahead.place
    with np.errstate(all="ignore"):
        point = fitting.with_prior(near, ahead.at)
        step = None if point is None else point.step()
        if point is not None and step is not None:
            near = fitting.stepped(near, point, step)
        first = 0.0 if point is None or step is None else point.length(step)
        end = descend_jointly(fitting, near, MAX_RESUMED, LEFT_OVER_RESUMED, first, enough=CONVERGED_RESUMED)
        return _fit_at(fitting, end)


def refit_denoised(fitting: Objective, fit: Fit) -> Fit:
    """A fit that has not converged, with the optimum of the denoised problem near it; as it is where there is none.

    Where loads and slips hardly vary, the fitted latents vary by noise alone, which Gauss-Newton takes for information:
    the steps it foresees are short, and the valley that they creep along has no end that means anything.  Without
    that noise (see `denoised`) the window is a plain regression, which prior and data make convex.
    """
    if not fit.chi2 < PLAUSIBLE:
        return fit
    optimum = fit.optimum
    with np.errstate(all="ignore"):
        calm = DenoisedObservationModel(fitting.problem, optimum)
        again = Objective(calm, fitting.coordinates.prior, fitting.joint_prior)
        calm_place = Iterate(optimum.soil, optimum.gains, calm.latents, np.inf, 1)
        found = _fit_at(again, descend_jointly(again, calm_place, MAX_ITERATIONS, enough=CONVERGED_RESUMED))
        if found is None or not found.converged:
            return fit
        near = fitting.start(found.optimum.soil, optimum.latents.entry_angle, found.optimum.gains)
        first = fitting.point(near)
        place = near if first is None else fitting.stepped(near, first, np.zeros(len(first.gradient)))
        point = fitting.point(place)
    if first is None or point is None:
        return fit
    return replace(
        fit,
        gaussian=found.gaussian,
        mode=found.mode,
        sinkage=found.sinkage,
        optimum=Optimum(fitting.problem.t, place.soil, place.gains, place.latents, point.at),
        neg2_log_posterior=point.neg2_log_posterior,
        neg2_log_evidence=point.neg2_log_evidence,
        iterations=fit.iterations + found.iterations,
        converged=True,
    )


def refine(fitting: Objective, near: Iterate) -> Fit | None:
    """Descent from a place near the optimum; None where the numbers stop being finite."""
    return _fit_at(fitting, descend_jointly(fitting, near, MAX_RESUMED, LEFT_OVER_RESUMED))


def _fit_at(fitting: Objective, end: Descent | None) -> Fit | None:
    """The end of a descent, with what is known there; None where the numbers stopped being finite."""
    gaussians = None if end is None else fitting.gaussians_at(end.place, end.point, end.last.soil)
    if end is None or gaussians is None:
        return None
    fallen = end.length if end.converged else 0.0
    return Fit(
        gaussian=gaussians[0] if end.converged else gaussians[1],
        mode=gaussians[1],
        sinkage=fitting.problem.mean_sinkage(end.place.as_soil(), end.place.gains, end.place.latents),
        optimum=Optimum(fitting.problem.t, end.last.soil, end.last.gains, end.last.latents, end.point.at),
        neg2_log_posterior=end.point.neg2_log_posterior - fallen,
        neg2_log_evidence=end.point.neg2_log_evidence - fallen,
        rows=fitting.problem.n_rows,
        iterations=end.iterations,
        converged=end.converged,
    )
