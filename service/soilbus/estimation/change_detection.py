"""Change detection: from which instant on the newest residuals disagree with the predicted soil.

    Q(k) = min over d of  sum_{i >= k} |r_i + J_i d|^2_{S_i^-1} + d' H d          H information of the predicted soil
    GLR(k) = n_k / 2 (q - 1 - log q),    q = max(Q(k) / n_k, 1)                     n_k residuals from instant k on

A generalised log likelihood ratio over the instant k of change (GLR; Basseville & Nikiforov, Detection of Abrupt
Changes, 1993, ch. 2): residuals larger than noise against noise alone, after the part that the predicted
soil explains within its covariance (step d) is removed.  The likeliest k is where a new soil may begin.
`Transition` is the time between two soils, when wheels of the two axles stand on different ones.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.observation_model import RESIDUAL, Linearisation
from soilbus.estimation.solver import Iterate, Objective
from soilbus.estimation.window import Window


class ChangeStatistic(NamedTuple):
    """Index of the first instant that may be on another soil, and its log likelihood ratio."""

    instant: int
    ratio: float


def change_statistic(
    objective: Objective, joint_prior: Gaussian, iterate: Iterate, at: Linearisation, first: int, threshold: float
) -> ChangeStatistic:
    """The likeliest beginning of another soil among the instants from `first` on.

    Parameters
    ----------
    objective : Objective
        Of the window.
    joint_prior : Gaussian
        Prediction of soil and gains by earlier data.
    iterate : Iterate
        Where the residuals are linearised: the prediction's mean.
    at : Linearisation
        The residuals there.
    first : int
        Index of the first instant that may be on another soil.
    threshold : float
        Log likelihood ratio up to which an upper bound suffices, to save time.

    Returns
    -------
    ChangeStatistic
    """
    n, m = at.by_latents.shape[:2]
    if first >= n:
        return ChangeStatistic(max(n - 1, 0), 0.0)
    rows, weighed = (a.reshape(n, m, -1)[first:] for a in (at.rows, at.weighed))
    misfit = np.einsum("im,im->i", rows[:, :, RESIDUAL], weighed[:, :, RESIDUAL])
    count = np.count_nonzero(rows.any(axis=2), axis=1).astype(float)
    ratio = _log_likelihood_ratio(misfit, count)
    if ratio.max() <= threshold:
        return ChangeStatistic(first + int(np.argmax(ratio)), float(ratio.max()))
    with_prior = objective.with_joint_prior(joint_prior)
    directions = with_prior.directions(iterate)
    gradient = np.einsum("imk,im->ik", weighed, rows[:, :, RESIDUAL]) @ directions
    information = directions.T @ np.einsum("imk,iml->ikl", rows, weighed) @ directions
    prior_information = with_prior.prior_at(iterate).information
    begin = int(np.argmax(_log_likelihood_ratio(misfit - _explained(gradient, information + prior_information), count)))
    # One common step for all instants from there on: the predicted soil itself must not pass for another.
    unexplained = misfit[begin:].sum() - _explained(
        gradient[begin:].sum(0), information[begin:].sum(0) + prior_information
    )
    return ChangeStatistic(
        first + begin, float(_log_likelihood_ratio(unexplained[None], count[begin:].sum(keepdims=True))[0])
    )


def _explained(gradient: Array, information: Array) -> Array:
    """Part of Q that the best step d explains, for half gradients (..., K) and information (..., K, K)."""
    step = np.linalg.solve(information, gradient[..., None])[..., 0]
    return np.asarray((gradient * step).sum(-1))


def _log_likelihood_ratio(misfit: Array, count: Array) -> Array:
    """GLR (N,) from each instant on, by the sum of squares and the number of residuals of each instant (N,)."""
    misfit, count = (np.cumsum(a[::-1])[::-1] for a in (misfit, count))
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.maximum(misfit / count, 1.0)
        return np.where(count > 0.0, 0.5 * count * (excess - 1.0 - np.log(excess)), 0.0)


class Transition(NamedTuple):
    """Wheels come onto another soil: the front ones between `begin` and `end` [s], the rear ones `lag` [s] later."""

    begin: float
    end: float
    lag: float


def without_transition(window: Window, transition: Transition, front: NDArray[np.bool_]) -> Window:
    """The window without the wheels' measurements during a transition.

    Parameters
    ----------
    window : Window
        The whole window.
    transition : Transition
        Before its `begin` all data are of the first soil; a wheel's data count again when it has arrived.
    front : Array
        Which wheels (W,) are on the front axle.

    Returns
    -------
    Window
        With nan in torque, load, speed and sinkage of wheels between the soils.
    """
    arrived = transition.end + np.where(front, 0.0, transition.lag)
    between = (window.t[:, None] >= transition.begin) & (window.t[:, None] < arrived)

    def blanked(values: Array) -> Array:
        return np.where(between, np.nan, values)

    return replace(
        window, torque=blanked(window.torque), load=blanked(window.load), speed=blanked(window.speed),
        sinkage=blanked(window.sinkage),
    )  # fmt: skip
