"""Damped descent for fits that the fast descent does not bring to their optimum: far away, or along a curved valley.

    (H + damping diag H) step = -g    (H, g: information and half the gradient of -2 log posterior, latents eliminated)

Far from the optimum one linear step does not bring the latents to their own optimum, and -2 log posterior with latents
as measured misleads.  So the latents follow at each iterate before it is compared with another (variable projection:
Golub & Pereyra 1973, SIAM J. Numer. Anal. 10:413), and a step is taken only where it lowers -2 log posterior
(Levenberg-Marquardt).  Nearer the optimum steps follow the second derivative of the residuals (geodesic acceleration:
Transtrum & Sethna 2012, arXiv:1201.5885).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.multistart import DescentOptions, Fit
from soilbus.estimation.observation_model import Linearisation, Optimum
from soilbus.estimation.solver import Iterate, Objective, QuadraticModel

# A value whose docstring states no source has no evidence recorded.
MAX_STEPS = 15
"""Steps after which a descent ends unconverged."""
FAR_STOP_SHARE = 2e-3
"""Fall that is not worth a step, as a share of -2 log posterior above NEAR_PER_RESIDUAL times the residuals."""
INITIAL_DAMPING, DAMPING_DECREASE, DAMPING_INCREASE = 1e-2, 0.3, 10.0
"""Damping of the first step (share of the diagonal), and its factor after a step that is taken and one that is not."""
MAX_DAMPING = 1e4
"""Damping at which the descent ends."""
NEAR_PER_RESIDUAL = 2.0
"""-2 log posterior for each residual below which one linear step brings the latents to their optimum."""
LATENTS_CONVERGED_SHARE = 1e-2
"""The same above it: the share of -2 log posterior that a further linear step of the latents may still change."""
MAX_CURVED_TRIALS = 3
"""Shares of a full step that are tried before a damped step."""
MIN_GAIN_RATIO, GOOD_GAIN_RATIO = 0.3, 0.85
"""Fall over predicted fall (gain ratio) of a step that is taken, and of one after which the next is lengthened."""
SHORT_SHARE, LENGTHENING = 0.15, 2.0
"""Share of a full step below which the next one is lengthened after a good step, and the factor."""
MIN_SHARE = 1e-4
"""Share of a full step that counts as no step."""
MAX_CURVED_RATIO, SHORTENING = 4.0, 0.5
"""Longest curved step over the longest straight one that would be taken, and the factor after a step that is not."""


class Expansion(NamedTuple):
    """An iterate and the quadratic model there."""

    iterate: Iterate
    quadratic: QuadraticModel


def descend_damped(objective: Objective, fast: Fit, options: DescentOptions) -> Fit | None:
    """The optimum below the point at which the fast descent ended.

    Parameters
    ----------
    objective
        Of the window.
    fast
        The fit that did not converge.
    options
        The descent ends where the predicted fall is negligible, or the predicted -2 log posterior is above
        give_up_above.

    Returns
    -------
    Fit or None
        None where the model is not finite, or the descent is given up at once.
    """
    levenberg, end = _LevenbergSteps(objective), fast.optimum
    with np.errstate(all="ignore"):
        ended = Iterate(end.soil, objective.problem.allowed(end.gains), end.latents, fast.neg2_log_posterior, 0)
        quadratic = objective.with_prior(ended, end.at)
        if quadratic is None or _predicted(quadratic, quadratic.step()) > options.give_up_above:
            return None
        here = levenberg.expanded(ended, end.at)
        if here is None:
            return None
        geodesic, damping, fall, steps = GeodesicSteps(objective), INITIAL_DAMPING, np.inf, 0
        while damping < MAX_DAMPING and steps < MAX_STEPS:
            negligible, full = (
                _negligible_fall(objective, here.quadratic, options.stall_tolerance),
                here.quadratic.step(),
            )
            target = min(here.quadratic.neg2_log_posterior - options.stall_tolerance, options.give_up_above)
            if full is None or fall < negligible or _predicted(here.quadratic, full) > target:
                break
            there, tried = geodesic.along(here, full) if levenberg.one_step_suffices(here.quadratic) else (None, 0)
            steps += tried
            if there is None and (corrected := levenberg.with_latents_at_optimum(here, negligible)) is not None:
                here, steps = corrected, steps + 1
                continue
            if there is None:
                there, steps = levenberg.damped(here, damping), steps + 1
                damping *= DAMPING_INCREASE if there is None else DAMPING_DECREASE
            if there is not None:
                fall, here = here.quadratic.neg2_log_posterior - there.quadratic.neg2_log_posterior, there
        return _fit(objective, *here, steps, converged=steps < MAX_STEPS)


@dataclass(slots=True)
class _LevenbergSteps:
    """Levenberg-Marquardt steps between iterates whose latents are at their optimum.

    latents_converged: whether the last linear step of the latents changed -2 log posterior by a negligible share.
    """

    objective: Objective
    latents_converged: bool = False

    def one_step_suffices(self, quadratic: QuadraticModel) -> bool:
        """Whether one linear step brings the latents to their optimum: where the last one did, and near the optimum."""
        near = NEAR_PER_RESIDUAL * self.objective.problem.n_rows
        return self.latents_converged or quadratic.neg2_log_posterior < near

    def expanded(self, iterate: Iterate, at: Linearisation | None = None) -> Expansion | None:
        """The iterate with its latents at their optimum; `at` is its linearisation where that is at hand."""
        quadratic = self.objective.quadratic_model(iterate) if at is None else self.objective.with_prior(iterate, at)
        if quadratic is None:
            return None
        here = Expansion(iterate, quadratic)
        if self.one_step_suffices(quadratic):
            return here
        there = _with_latents_stepped(self.objective, here)
        self.latents_converged = (
            there is not None
            and abs(there.quadratic.neg2_log_posterior - quadratic.neg2_log_posterior)
            < LATENTS_CONVERGED_SHARE * quadratic.neg2_log_posterior
        )
        return there

    def damped(self, here: Expansion, damping: float) -> Expansion | None:
        """The iterate after a damped step; None where that does not lower -2 log posterior."""
        step = here.quadratic.step(damping)
        there = None if step is None else self.expanded(self.objective.stepped(*here, step))
        falls = there is not None and there.quadratic.neg2_log_posterior < here.quadratic.neg2_log_posterior
        return there if falls else None

    def with_latents_at_optimum(self, here: Expansion, negligible: float) -> Expansion | None:
        """The same iterate with its latents stepped, where -2 log posterior is then higher: it was underestimated.

        None where it is not higher, or where the latents of each iterate are stepped anyway.
        """
        if not self.one_step_suffices(here.quadratic):
            return None
        there, self.latents_converged = _with_latents_stepped(self.objective, here), False
        underestimated = (
            there is not None and there.quadratic.neg2_log_posterior > here.quadratic.neg2_log_posterior + negligible
        )
        return there if underestimated else None


@dataclass(slots=True)
class GeodesicSteps:
    """Steps along a curved valley.

    share: of a full step that the next one takes.  second_derivative (R,): of the residuals along a full step, as
    predicted from the last steps; None where unknown.
    """

    objective: Objective
    share: float = 1.0
    second_derivative: Array | None = None

    def along(self, here: Expansion, full: Array) -> tuple[Expansion | None, int]:
        """The iterate after a share of a full step (F + A,), and how many were tried.

        None where none lowers -2 log posterior.
        """
        iterate, quadratic = here
        length, least = quadratic.squared_length(full), None
        for tried in range(1, MAX_CURVED_TRIALS + 1):
            share = self.share
            step = (
                share * full
                if self.second_derivative is None
                else self.objective.geodesic_step(iterate, quadratic, share, self.second_derivative)
            )
            if step is not None:
                within = self.objective.step_fraction(iterate, step)
                share, step = within * share, within * step
            there = None
            if step is not None and share > MIN_SHARE:
                there = _expand(self.objective, self.objective.stepped(iterate, quadratic, step))
            if step is None or there is None:
                self.share, self.second_derivative = SHORTENING * self.share, None
                continue
            predicted = share * (2.0 - share) * length
            fall = quadratic.neg2_log_posterior - there.quadratic.neg2_log_posterior
            second_derivative = self.objective.second_derivative(iterate, quadratic, step, there.quadratic) / share**2
            if fall > MIN_GAIN_RATIO * predicted:
                rest = 1.0 - share
                factor = LENGTHENING if share < SHORT_SHARE and fall > GOOD_GAIN_RATIO * predicted else 1.0
                self.share = min(factor * share / rest, 1.0) if rest > 0.0 else 1.0
                self.second_derivative = second_derivative * rest**2 if rest > 0.0 else None
                return there, tried
            if fall > 0.0 and (
                least is None or there.quadratic.neg2_log_posterior < least.quadratic.neg2_log_posterior
            ):
                least = there
            straight = share * (length * share / (predicted - fall)) ** (1.0 / 3.0)  # the error grows as share^4
            curved = MAX_CURVED_RATIO * straight
            self.share = min(share, curved) if self.second_derivative is None else SHORTENING * share
            self.second_derivative = second_derivative
        return least, MAX_CURVED_TRIALS


def _predicted(quadratic: QuadraticModel, full: Array | None) -> float:
    """-2 log posterior after a full step (F + A,) by the quadratic model; infinite where there is no step."""
    return np.inf if full is None else quadratic.neg2_log_posterior - quadratic.squared_length(full)


def _negligible_fall(objective: Objective, quadratic: QuadraticModel, nothing: float) -> float:
    """Fall of -2 log posterior below which a step was the last."""
    above = quadratic.neg2_log_posterior - NEAR_PER_RESIDUAL * objective.problem.n_rows
    return max(nothing, FAR_STOP_SHARE * above)


def _expand(objective: Objective, iterate: Iterate) -> Expansion | None:
    quadratic = objective.quadratic_model(iterate)
    return None if quadratic is None else Expansion(iterate, quadratic)


def _with_latents_stepped(objective: Objective, here: Expansion) -> Expansion | None:
    """The iterate with its latents at the optimum of the linear model there."""
    return _expand(objective, objective.stepped(*here, np.zeros(len(here.quadratic.gradient))))


def _fit(objective: Objective, iterate: Iterate, quadratic: QuadraticModel, steps: int, converged: bool) -> Fit | None:
    gaussians = objective.gaussians_at(iterate, quadratic, iterate.soil)
    if gaussians is None:
        return None
    return Fit(
        gaussian=gaussians[1],
        mode=gaussians[1],
        sinkage=objective.problem.mean_sinkage(iterate.as_soil(), iterate.gains, iterate.latents),
        optimum=Optimum(objective.problem.t, iterate.soil, iterate.gains, iterate.latents, quadratic.linearisation),
        neg2_log_posterior=quadratic.neg2_log_posterior,
        neg2_log_evidence=quadratic.neg2_log_evidence,
        rows=objective.problem.n_rows,
        iterations=steps,
        converged=converged,
    )
