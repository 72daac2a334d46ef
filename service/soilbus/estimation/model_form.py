"""What the form of the wheel-soil model leaves open of a window's estimate.

The greatest stress may sit elsewhere than the model has it, the rut may come up again behind the axle, the shear
strength may be mobilised by another law.  Along form parameters f, 0 in the configured form, a window is linear,

    residuals       r + J theta + B f,      prior of theta: theta - S_0 f
    sensitivity     theta(f) = S f,         S = -H^-1 (J' W B - H_0 S_0)
    information     I_f = B' W B - (J' W B)' H^-1 (J' W B), over a discount: of scores by seconds, and of what all share

with H = J' W J + H_0 (considered parameters: Schmidt 1966; Tapley, Schutz & Born, Statistical Orbit Determination,
2004, ch. 6).  The configured form holds with probability 1 - OPEN, else f is as open as prior and window leave it
(spike and slab: Mitchell & Beauchamp 1988, J. Am. Stat. Assoc. 83:1023).  All windows have the same errors of form, so
nothing of f is carried from window to window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.gaussian import solve_with_inverse
from soilbus.estimation.posterior import PARAMETERS
from soilbus.estimation.solver import Objective
from soilbus.estimation.variance_components import block_sums
from soilbus.terra.wheel import WheelModel

if TYPE_CHECKING:
    from soilbus.estimation.multistart import Fit


FORM = ("peak", "peak_by_slip", "exit", "shear")
"""Form parameters: of the angle of greatest stress over the entry angle, of its change with slip, of the exit angle
behind the axle over the entry angle, and the share of the shear strength that the other law mobilises."""
SIDE = np.array([-1.0, 1.0, 1.0, 1.0])
"""Which way the literature's forms lie from the configured one: the peak nearer to the axle, the exit behind it."""
OF_SQUARE = np.array([1.0 / 12.0, 1.0 / 12.0, 1.0 / 12.0, 1.0 / 4.0])
"""Variance over the square of the range: even between its ends (1/12), or either end as likely (1/4: a shear law)."""
OPEN = 0.8
"""Probability of another form than the configured one.  With 0.5 intervals of pressure are too narrow for another
published wheel."""
_SOIL = len(PARAMETERS)


@dataclass(frozen=True, slots=True)
class FormPosterior:
    """The form parameters after a window, 0 being the configured form, and how soil and gains depend on them."""

    by_form: Array  # (6 + G, 4), derivatives of the soil's logarithms and of the gains by FORM
    mean: Array  # (4,) of the form parameters
    covariance: Array  # (4, 4)

    @property
    def centre(self) -> Array:
        """Mean (4,) of the form parameters, the configured form included."""
        return np.asarray(OPEN * self.mean)

    @property
    def spread(self) -> Array:
        """Covariance (4, 4) of the form parameters, the configured form included."""
        return OPEN * self.covariance + OPEN * (1.0 - OPEN) * np.outer(self.mean, self.mean)

    @property
    def log_covariance(self) -> Array:
        """Covariance (6, 6) that the open form adds to the soil's logarithms."""
        of_soil = self.by_form[:_SOIL]
        return np.asarray(of_soil @ self.spread @ of_soil.T)

    @property
    def log_shift(self) -> Array:
        """Shift (6,) of the soil's logarithms from the configured form to the mean over all forms."""
        return np.asarray(self.by_form[:_SOIL] @ self.centre)


def with_form_step(model: WheelModel, step: Array) -> WheelModel:
    """Return the model with form parameters that differ from its own by a step (4,)."""
    peak, by_slip, leave, other = step.tolist()
    share = model.exponential_share
    if model.shear_law == "exponential":  # the same, with a share that can be taken away
        share, other = 1.0, -other
    return replace(
        model,
        shear_law="rational",
        peak_c1=model.peak_c1 + peak,
        peak_c2=model.peak_c2 + by_slip,
        exit_ratio=model.exit_ratio - leave,
        exponential_share=share + other,
        one_off=True,
    )


def form_posterior(objective: Objective, fit: Fit, farthest: Sequence[float]) -> FormPosterior:
    """Return the posterior of the form parameters after a window's fit on the configured form.

    farthest: how far each of FORM may be from the configured form; none is negative, one is not 0.  The prior where the
    normal equations are singular.
    """
    problem, optimum, carried = objective.problem, fit.optimum, objective.joint_prior.form
    prior_mean, prior_variance = SIDE * np.asarray(farthest) / 2.0, OF_SQUARE * np.square(farthest)
    by_prior = np.zeros((_SOIL + len(fit.gains), len(FORM))) if carried is None else carried.by_form
    free = np.flatnonzero(prior_variance)
    with np.errstate(all="ignore"):
        by_form, weighed = (part[:, free] for part in problem.by_form(optimum))
        prior_by_form, of_prior = -by_prior[np.ix_(objective.unknowns, free)], objective.prior_precision
        off, directions = objective.prior_residuals(optimum.soil, optimum.gains), objective.directions(optimum.soil)
        columns = weighed.T @ optimum.at.rows
        cross = columns @ directions + prior_by_form.T @ of_prior @ objective.prior_jacobian(optimum.soil)
        gradient = columns[:, 0] + prior_by_form.T @ (of_prior @ off) - cross @ fit.last_step
        following = fit.covariance @ cross.T  # minus the derivatives of coordinates and gains by the form
        information = by_form.T @ weighed + prior_by_form.T @ of_prior @ prior_by_form - cross @ following
        # soil and gains are eliminated from the scores (covariance by blocks: Newey & West 1987)
        scores = (by_form - optimum.at.rows @ (directions @ following)) * optimum.at.weighed[:, :1]
        blocks = scores.reshape(problem.n, -1, len(free)).sum(axis=1)
        blocks = block_sums(blocks, problem.t, problem.options.variance.block)
        excess = float(np.trace(np.linalg.lstsq(information, blocks.T @ blocks, rcond=None)[0])) / len(free)
        discount = max(excess, 1.0) * problem.options.posterior.form_discount
        precision = 1.0 / prior_variance[free]  # of independent parameters
        found = solve_with_inverse(
            information / discount + np.diag(precision), precision * prior_mean[free] - gradient / discount
        )
        if found is None:
            return FormPosterior(by_prior, prior_mean, np.diag(prior_variance))
        sensitivity, mean, covariance = np.zeros_like(by_prior), np.zeros(len(FORM)), np.zeros((len(FORM),) * 2)
        sensitivity[:, free] = -objective.parameter_jacobian(optimum.soil) @ following
        mean[free], covariance[np.ix_(free, free)] = found
        return FormPosterior(sensitivity, mean, covariance)
