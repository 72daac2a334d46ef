"""Fits of a window: from several starts, or warm from the window before.

Equations.  A fit is the minimum of the objective of `solver` (chi-square of the whitened residuals plus the
prior) and the Gaussian there,

    mode = argmin -2 log posterior,    covariance = H^-1,
    -2 log evidence = -2 log posterior(mode) + log det H - log det H_prior          (Laplace)

`fit_window` finds it where nothing is known: the soil alone descends on a few instants, with loads and speeds as
measured, from several soils until two descents meet; from the best end soil, gains and latents descend together on all
instants.  `fit_warm` starts at the optimum of the window before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian, solve_with_inverse
from soilbus.estimation.linearisation import Optimum
from soilbus.estimation.model_form import FormPosterior
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import NORMAL_95, Posterior, SoilPrior
from soilbus.estimation.soil_classes import ranked_by_likelihood
from soilbus.estimation.solver import Iterate, Objective, Solution, Termination, WindowModel, minimise
from soilbus.terra.soils import KINDS, SOILS
from soilbus.terra.wheel import Soil

__all__ = ["Fit", "fit_at", "fit_window"]


@dataclass(frozen=True, slots=True)
class Fit:
    """Outcome of one fit, of a constant soil."""

    mode: Gaussian  # soil and gains at the minimum, with the inverse of the information as covariance
    last_step: Array  # H^-1 g and H^-1 at `optimum`, by free coordinates and active gains
    covariance: Array
    sinkage: Array  # (W,), mean over the window by wheel [m], nan where unknown
    # the last iterate at which the model was evaluated, with its linearisation: start of the next window
    optimum: Optimum
    neg2_log_posterior: float  # objective at the minimum: chi-square of residuals and prior, up to a constant
    # -2 log of the data's likelihood with the parameters integrated out, up to the same constant
    neg2_log_evidence: float
    rows: int  # residuals of the data
    iterations: int  # evaluations of the model
    termination: Termination  # why the descent ended
    form: FormPosterior | None = None  # what the model's form leaves open (`model_form`)

    @property
    def posterior(self) -> Posterior:
        """The marginal of the soil."""
        return self.mode.posterior

    @property
    def converged(self) -> bool:
        """Whether the descent ended at an optimum."""
        return self.termination is Termination.STEP

    @property
    def gains(self) -> Array:
        """Relative errors of the sensors (G,), by problem.gain_names."""
        return self.mode.gains

    @property
    def chi2(self) -> float:
        """Objective per residual (reduced chi-square)."""
        return self.neg2_log_posterior / max(self.rows, 1)


def fit_window(problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian | None = None) -> Fit | None:
    """Return the posterior of a window of which only the prior is known, from several starts.

    joint_prior: posterior of earlier windows, in place of the soil's prior.  None where no descent ends at a finite
    optimum.
    """
    joint_prior = Gaussian.of(prior, problem.gain_std) if joint_prior is None else joint_prior
    options, objective = problem.options.search, Objective(problem, prior, joint_prior)
    thin = Objective(problem.thinned(options.thinned), prior, joint_prior, as_measured=True)
    with np.errstate(all="ignore"):
        end = _best_end(thin)
        if end is None:
            return None
        start = objective.start(end.previous.soil, end.previous.gains)
        descent = options.cold
        if not end.value < options.implausible * options.thinned:
            descent = replace(descent, max_evaluations=options.max_implausible_evaluations)
        return fit_at(objective, minimise(objective, start, descent), end.evaluations)


class WarmStart(NamedTuple):
    """Start at the optimum of the window before, with its quadratic model; None where that is not finite."""

    objective: Objective
    iterate: Iterate
    model: WindowModel | None


def warm_start(
    problem: ObservationModel, prior: SoilPrior, last: Fit, joint_prior: Gaussian | None = None
) -> WarmStart:
    """Return the start of a window at the optimum of the window before."""
    objective = Objective(problem, prior, Gaussian.of(prior, problem.gain_std) if joint_prior is None else joint_prior)
    soil = np.where(prior.log_std > 0.0, last.optimum.soil, prior.median)
    with np.errstate(all="ignore"):
        iterate = Iterate(soil, last.optimum.gains, problem.after(last.optimum))
        return WarmStart(objective, iterate, objective.quadratic_model(iterate))


def fit_warm(start: WarmStart) -> Fit | None:
    """Descend from a warm start; None where the numbers are not finite."""
    objective, model = start.objective, start.model
    with np.errstate(all="ignore"):
        step = None if model is None else model.step()
        if model is None or step is None:
            return None
        near = objective.stepped(start.iterate, model, step)
        end = minimise(objective, near, objective.options.warm, model.squared_length(step))
        return fit_at(objective, end, evaluations=1)


def starting_soils(problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian | None = None) -> Iterator[Soil]:
    """Yield the joint prior's soil (else the prior median), the likeliest soil of the table, loam, the next one.

    See `soil_classes.ranked_by_likelihood`.
    """
    yield Soil(*(prior.median if joint_prior is None else joint_prior.soil).tolist())
    likeliest, second, *_ = ranked_by_likelihood(problem, [clip_to_prior(prior, SOILS[kind]) for kind in KINDS])
    yield likeliest
    yield clip_to_prior(prior, SOILS["loam"])
    yield second


def clip_to_prior(prior: SoilPrior, soil: Soil) -> Soil:
    """Return the soil with held parameters at their values and the others in the prior's 95 % interval."""
    factor = np.exp(NORMAL_95 * prior.log_std)
    return Soil(*np.clip(soil, prior.median / factor, prior.median * factor).tolist())


def _best_end(thin: Objective) -> Solution[Iterate, WindowModel] | None:
    """Best end of the soil's descents on a few instants; two that meet at a plausible objective end the search."""
    options, ends = thin.options, list[Solution[Iterate, WindowModel]]()
    for start in starting_soils(thin.problem, thin.coordinates.prior, thin.joint_prior):
        end = minimise(thin, thin.start(np.asarray(start)), options.soil_alone)
        if end.model is None:
            continue
        met = any(abs(end.value - other.value) < options.same_end * other.value for other in ends)
        ends.append(end)
        if met and end.value < options.plausible_chi2 * thin.problem.n_rows:
            break
    return min(ends, key=lambda end: end.value, default=None)


def fit_at(objective: Objective, end: Solution[Iterate, WindowModel], evaluations: int = 0) -> Fit | None:
    """Return the fit at the end of a descent, after evaluations of the model before it; None where it is not finite."""
    if end.model is None:
        return None
    solution = solve_with_inverse(end.model.information, end.model.gradient)
    if solution is None:
        return None
    is_converged, previous = end.termination is Termination.STEP, end.previous
    last_decrease = end.predicted_decrease if is_converged else 0.0
    return Fit(
        mode=objective.gaussian(end.iterate.soil, end.iterate.gains, solution[1]),
        last_step=solution[0],
        covariance=solution[1],
        sinkage=objective.problem.mean_sinkage(end.iterate.as_soil(), end.iterate.gains, end.iterate.latents),
        optimum=Optimum(objective.problem.t, previous.soil, previous.gains, previous.latents, end.model.linearisation),
        neg2_log_posterior=end.model.neg2_log_posterior - last_decrease,
        neg2_log_evidence=end.model.neg2_log_evidence - last_decrease,
        rows=objective.problem.n_rows,
        iterations=evaluations + end.evaluations,
        termination=end.termination,
    )
