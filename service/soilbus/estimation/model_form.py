"""What the form of the wheel-soil model leaves open of a window's estimate.

No soil's contact has exactly the configured form: the greatest stress may sit elsewhere than the model has
it, the rut may come up again behind the axle, the shear strength may be mobilised by the other law.  The forms of
the literature all lie on one side of the configured one, f = 0, so the prior of the form parameters f
(`form_prior`) has a mean besides its covariance.  Along f the window is linear about its optimum,

    residuals = r + J theta + B f,    prior factor: theta - S_0 f,

with theta the soil's coordinates and the active gains.  The estimate stays that of the configured form, f = 0:
theta(f) = S f with S = -H^-1 (J' W B - H_0 S_0), H = J' W J + H_0, is what another form would have made of the same
data (a considered parameter: Schmidt 1966; Tapley, Schutz & Born, Statistical Orbit Determination, 2004,
ch. 6).  The posterior of f, from this prior and the residuals, has a mean and a covariance; their second moment M
about f = 0 is how far the estimate may be off by its form, and S M S' adds to its covariance: less than by the prior
alone where the data favour the configured form, as much where they cannot tell.

A reported std is therefore a root mean square about the reported value, and no std about the posterior's mean: where
the data cannot tell the form, most of the probability lies on one side of the value.  M has the product of the means
of any two form parameters: a peak before the middle and an exit behind the axle both raise the estimated pressure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.gaussian import solve_with_inverse
from soilbus.estimation.posterior import PARAMETERS
from soilbus.terra.wheel import WheelModel

if TYPE_CHECKING:
    from soilbus.estimation.multistart import Fit
    from soilbus.estimation.solver import Objective


FORM = ("peak", "peak_by_slip", "exit", "shear")
"""Form parameters: of the angle of greatest stress over the entry angle, of its change with slip, of the exit angle
behind the axle over the entry angle, and the share of the shear strength that the other law mobilises."""
SIDE = np.array([-1.0, 1.0, 1.0, 1.0])
"""Which way the literature's forms lie from the configured one: the peak nearer to the axle, the exit behind it."""
OF_SQUARE = np.array([1.0 / 12.0, 1.0 / 12.0, 1.0 / 12.0, 1.0 / 4.0])
"""Variance over the square of the range: even between its ends (1/12), or either end as likely (1/4: a shear law)."""
OPEN = 0.5
"""Probability that the contact is of another form than the configured one, which is itself a published form."""
_SOIL = len(PARAMETERS)


def form_prior(farthest: Sequence[float]) -> tuple[Array, Array]:
    """Mean (4,) and covariance (4, 4) of the form parameters before any data.

    Parameters
    ----------
    farthest
        How far each of FORM may be from the configured form, whose value is 0; none is negative.
    """
    reach = np.asarray(farthest)
    return SIDE * reach / 2.0, np.diag(OF_SQUARE * reach**2)


@dataclass(frozen=True, slots=True)
class FormPosterior:
    """The form parameters after a window and those before it, and how soil and gains depend on them.

    by_form (6 + G, 4): derivatives of the soil's logarithms and of the gains by FORM; mean (4,) and covariance (4, 4)
    of the form parameters, 0 being the configured form.
    """

    by_form: Array
    mean: Array
    covariance: Array

    @classmethod
    def of(cls, farthest: Sequence[float], n_gains: int) -> FormPosterior:
        """Before any data: the prior, see `form_prior`."""
        return cls(np.zeros((_SOIL + n_gains, len(FORM))), *form_prior(farthest))

    def drifted(self, farthest: Sequence[float], share: float) -> FormPosterior:
        """Later: the form may have changed by this share of the prior variance, up to all of it."""
        return replace(self, covariance=self.covariance + min(share, 1.0) * form_prior(farthest)[1])

    @property
    def moment(self) -> Array:
        """Second moment (4, 4) about the configured form."""
        return self.covariance + np.outer(self.mean, self.mean)

    @property
    def log_covariance(self) -> Array:
        """What the form adds to the covariance (6, 6) of the soil's logarithms about their mean."""
        of_soil = self.by_form[:_SOIL]
        spread = OPEN * self.covariance + OPEN * (1.0 - OPEN) * np.outer(self.mean, self.mean)
        return np.asarray(of_soil @ spread @ of_soil.T)

    @property
    def log_shift(self) -> Array:
        """From the soil's logarithms on the configured form to their mean over all forms (6,)."""
        return np.asarray(OPEN * self.by_form[:_SOIL] @ self.mean)


def with_form_step(model: WheelModel, step: Array) -> WheelModel:
    """The model with form parameters that differ from its own by a step (4,)."""
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


def form_posterior(objective: Objective, fit: Fit, prior: FormPosterior) -> FormPosterior:
    """Posterior of the form parameters after a window's fit.

    Parameters
    ----------
    objective, fit
        Of the window, on the configured form; converged.
    prior
        Posterior of the form after the windows before.

    Returns
    -------
    FormPosterior
        The prior itself where every form parameter is held or the normal equations are singular.
    """
    problem, optimum = objective.problem, fit.optimum
    approximation = objective.approximation_at(optimum)
    free = np.flatnonzero(np.diag(prior.covariance) > 0.0)
    if approximation is None or not len(free):
        return prior
    by_form, weighed = problem.by_form(optimum)
    by_form, weighed = by_form[:, free], weighed[:, free]
    prior_by_form, precision, off = objective.prior_factor.jacobian_by_mean(
        optimum.soil, optimum.gains, prior.by_form[:, free]
    )
    columns = weighed.T @ optimum.at.rows
    cross = (columns @ approximation.directions) + prior_by_form.T @ precision @ objective.prior_jacobian(optimum)
    gradient = columns[:, 0] + prior_by_form.T @ (precision @ off)
    information = by_form.T @ weighed + prior_by_form.T @ precision @ prior_by_form
    own = solve_with_inverse(prior.covariance[np.ix_(free, free)], prior.mean[free])
    if own is None:
        return prior
    of_gradient, of_information = approximation.explained(cross)
    m = optimum.at.by_latents.shape[1]
    theta = approximation.covariance @ cross.T
    J = optimum.at.rows @ approximation.directions
    marg = by_form - J @ theta
    r = (optimum.at.weighed[:, :1])
    block = np.repeat(np.floor(problem.t / 1.0).astype(int), m)
    starts = np.flatnonzero(np.diff(block, prepend=block[0] - 1))
    g = np.add.reduceat(marg * r, starts, axis=0)
    I = information - of_information
    kappa = float(np.trace(np.linalg.lstsq(I, g.T @ g, rcond=None)[0])) / len(free)
    k = 3 * max(kappa, 1.0)
    found = solve_with_inverse(I / k + own[1], own[0] + (of_gradient - gradient) / k)
    if found is None:
        return prior
    sensitivity, mean, covariance = np.zeros_like(prior.by_form), np.zeros(len(FORM)), np.zeros((len(FORM),) * 2)
    sensitivity[:, free] = -objective.parameter_jacobian(optimum.soil) @ approximation.covariance @ cross.T
    mean[free], covariance[np.ix_(free, free)] = found
    return FormPosterior(sensitivity, mean, covariance)
