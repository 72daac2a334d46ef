"""Drift filter: the soil at the end of a window, by a random walk through pieces of the window.

    theta_1 = theta_start,    theta_{j+1} = theta_j + w_j,    w_j ~ N(0, drift^2 / 5)      coordinates of piece j of 5
    r_i = r_i(optimum) + J_i [theta_j; gains; path curvature]                              linear at the optimum
    or besides the walk a steady change,  theta(t) = theta_end + (t - t_end) / window d,   d ~ N(0, (7 drift)^2)

A fit takes the soil as constant in its window; its estimate is late by half a window and too certain.  Here the
window is linear at that fit's optimum, and an information filter runs from piece to piece (Anderson & Moore,
Optimal Filtering, 1979, sect. 6.3); sensor gains and path curvatures (path_curvature) stay constant.  A walk wide
enough to follow a field that changes steadily would make every estimate uncertain.  So two models, with and without a
steady change, are averaged by their evidence (multiple models: Bar-Shalom, Li & Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, sect. 11.6).  The step and the added covariance of the mode are applied
to all Gaussians of a fit; mixtures and second modes keep their shape, and no covariance shrinks.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian, solve_with_inverse
from soilbus.estimation.multistart import Fit
from soilbus.estimation.path_curvature import by_curvature
from soilbus.estimation.solver import GaussianApproximation, Objective


class DriftStep(NamedTuple):
    """From the optimum of a constant soil to the soil at the window's end, of F coordinates and A active gains.

    step (F + A,) is to be subtracted; covariance (F + A, F + A) is the marginal one there.
    neg2_log_evidence compares models of the same window only.
    """

    step: Array
    covariance: Array
    neg2_log_evidence: float


def at_window_end(objective: Objective, fit: Fit, window: float, drift: float) -> Fit:
    """The fit with its Gaussians moved to the soil at the window's end.

    Parameters
    ----------
    objective : Objective
        Of the fitted window.
    fit : Fit
        Its fit with a constant soil.
    window : float
        Length of a window [s].
    drift : float
        Sd of the change of each soil coordinate in one window.

    Returns
    -------
    Fit
        The same fit without drift and path curvature, or where the numbers are not finite.
        neg2_log_posterior and neg2_log_evidence stay those of a constant soil: a drifting soil
        would explain too much that is no soil.
    """
    if not (drift or fit.curved_path):
        return fit
    optimum, constant = fit.optimum, objective.approximation_at(fit.optimum)
    if constant is None:
        return fit
    free = len(objective.free)
    options = objective.problem.options.posterior
    steady = options.steady_drift_sd * drift
    models = _drift_models(_joint(objective, fit, constant, window, drift), len(constant.step), free, steady)
    if not models:
        return fit
    step, covariance = _model_average(models)
    within_piece = drift**2 / (3.0 * options.drift_pieces)  # the end of the last piece is not its mean
    covariance[:free, :free] += np.eye(free) * within_piece
    at_optimum = objective.gaussian(optimum.soil, optimum.gains, constant.covariance)
    drift_covariance = covariance - constant.covariance

    def shifted(gaussian: Gaussian) -> Gaussian:
        if gaussian is fit.mode and fit.marginalised is None:
            return objective.shifted(at_optimum, -step, drift_covariance)
        return objective.shifted(gaussian, constant.step - step, drift_covariance)

    return replace(
        fit,
        mode=shifted(fit.mode),
        second_mode=None
        if fit.second_mode is None
        else fit.second_mode._replace(gaussian=shifted(fit.second_mode.gaussian)),
        marginalised=None if fit.marginalised is None else shifted(fit.marginalised),
    )


def _drift_models(joint: Array, n_reported: int, free: int, steady: float) -> list[DriftStep]:
    """Steps under the two models, walk alone and walk with a steady change; those that are finite."""
    walk = len(joint) - free
    models = [_marginal_step(joint[:walk, :walk], n_reported)]
    if steady:
        of_steady = np.arange(walk, len(joint))
        joint[of_steady, of_steady] += 1.0 / steady**2
        models.append(_marginal_step(joint, n_reported, 2.0 * free * math.log(steady)))
    return [model for model in models if model is not None]


def _joint(objective: Objective, fit: Fit, constant: GaussianApproximation, window: float, drift: float) -> Array:
    """Joint quadratic at the window's end: columns 1 | F coordinates, A gains | K path curvatures | F steady changes.

    Element (0, 0) is -2 log posterior, row 0 half the gradient, the rest the information.  The
    steady change is that of the coordinates in one window, here without a prior.
    """
    at, t, directions, prior = fit.optimum.at, fit.optimum.t, constant.directions, constant.prior
    free, n_reported, m = len(objective.free), directions.shape[1], at.by_latents.shape[1]
    ago = (t - t[-1]) / window
    soil, steady = slice(1, 1 + free), slice(-free, None)
    stacked = []
    for residuals, by_path_curvature in zip((at.rows, at.weighed), _by_path_curvature(objective, fit), strict=True):
        by_unknowns = residuals @ directions
        by_steady_change = by_unknowns[:, :free] * np.repeat(ago, m)[:, None]
        stacked.append(np.hstack([residuals[:, :1], by_unknowns, by_path_curvature, by_steady_change]))
    rows, weighed = stacked
    to_window_start = np.eye(n_reported, rows.shape[1] - 1)  # the prior is of the soil at the window's begin
    to_window_start[:free, steady] = ago[0] * np.eye(free)
    joint = np.zeros((rows.shape[1],) * 2)
    joint[0, 0] = prior.neg2_log_prior
    joint[1:, 1:] = to_window_start.T @ prior.information @ to_window_start
    joint[0, 1:] = joint[1:, 0] = to_window_start.T @ prior.gradient
    curvature_columns = np.arange(1 + n_reported, len(joint) - free)
    joint[curvature_columns, curvature_columns] += 1.0
    pieces = objective.problem.options.posterior.drift_pieces
    steps = np.arange(1.0, pieces + 1.0) / pieces if drift else np.ones(1)
    walk_information = np.eye(free) * pieces / drift**2 if drift else np.zeros((free, free))
    ends = np.searchsorted(ago, steps - 1.0, side="right").tolist()
    for begin, end in zip([0, *ends[:-1]], ends, strict=True):
        if begin:
            link = joint[:, soil].copy()
            step = link[soil] + walk_information
            link[soil] = -walk_information
            joint[soil] = joint[:, soil] = 0.0
            joint[soil, soil] = walk_information
            joint -= link @ np.linalg.solve(step, link.T)
        if end > begin:
            part = slice(begin * m, end * m)
            joint += rows[part].T @ weighed[part]
    return joint


def _by_path_curvature(objective: Objective, fit: Fit) -> tuple[Array, Array]:
    """Derivatives (N m, K) of the residuals by the K path curvatures over their prior sd, and these weighed."""
    m = fit.optimum.at.by_latents.shape[1]
    if not fit.curved_path:
        none = np.zeros((len(fit.optimum.t) * m, 0))
        return none, none
    basis = np.repeat(fit.curved_path.basis, m, axis=0)
    by_curve, weighed = by_curvature(objective, fit)
    return basis * by_curve.reshape(-1, 1), basis * weighed.reshape(-1, 1)


def _marginal_step(joint: Array, n_reported: int, neg2_log_prior_volume: float = 0.0) -> DriftStep | None:
    """Step and marginal covariance of the first `n_reported` unknowns; the volume is log det of the others' prior."""
    solution = solve_with_inverse(joint[1:, 1:], joint[1:, 0])
    if solution is None:
        return None
    step, covariance = solution
    cost = float(joint[0, 0] - joint[0, 1:] @ step)
    neg2_log_evidence = cost + neg2_log_prior_volume + float(np.linalg.slogdet(joint[1:, 1:])[1])
    return DriftStep(step[:n_reported], covariance[:n_reported, :n_reported], neg2_log_evidence)


def _model_average(models: list[DriftStep]) -> tuple[Array, Array]:
    """Mean and covariance of the mixture of models with equal prior probability."""
    neg2_log_evidence = np.array([model.neg2_log_evidence for model in models])
    probability = np.exp(-0.5 * (neg2_log_evidence - neg2_log_evidence.min()))
    probability /= probability.sum()
    steps = np.array([model.step for model in models])
    step = probability @ steps
    off = steps - step
    covariance = np.tensordot(probability, np.array([model.covariance for model in models]), axes=1)
    return step, covariance + (off.T * probability) @ off
