"""Change detection: from which instant on the newest residuals disagree with the predicted soil.

    Q(k) = min over d of  sum_{i >= k} |r_i + J_i d|^2_{S_i^-1} + d' H d          H information of the predicted soil
    GLR(k) = n_k / 2 (q - 1 - log q),    q = max(Q(k) / n_k, 1)                     n_k residuals from instant k on

A generalised log likelihood ratio over the instant k of change (Basseville & Nikiforov, Detection of Abrupt Changes,
1993, ch. 2), after the part that the predicted soil explains within its covariance (step d) is removed.

The threshold h follows from a false-alarm probability: where the m last instants, of r residuals each, are noise,

    P(max over k of GLR(k) > h) = P(GLR(1) > h) + b^2 phi(b) / 2  sum_{j = 2..m} exp(-0.583 b / sqrt(j)) / (j u_j)
    P(GLR(1) > h) = Phi(-b) + phi(b) (1 / u_1 - 1 / b)
    b = sqrt(2 h),    u_j = (q_j - 1) sqrt(r j / 2),    q_j - 1 - log q_j = 2 h / (r j)

The sum is the rate at which a normalised random walk, looked at after each of j steps, first passes b (Siegmund,
Sequential Analysis, 1985, ch. 4 and 10); 1 / u_j is the tail of chi-square there (Lugannani & Rice 1980, Adv. Appl.
Prob. 12:475).
`Transition` is the time between two soils, when wheels of the two axles stand on different ones.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.linearisation import RESIDUAL, Linearisation
from soilbus.estimation.solver import Iterate, Objective
from soilbus.estimation.window import WHEEL_QUANTITIES, Window


class ChangeStatistic(NamedTuple):
    """Index of the first instant that may be on another soil, its log likelihood ratio, and the threshold."""

    instant: int
    ratio: float
    threshold: float

    @property
    def is_alarm(self) -> bool:
        """Whether the ratio passes the threshold, so that noise is not the reason."""
        return self.ratio > self.threshold


def change_statistic(
    objective: Objective, joint_prior: Gaussian, iterate: Iterate, at: Linearisation, first: int, false_alarms: float
) -> ChangeStatistic:
    """Return the likeliest beginning of another soil among the instants from index `first` on.

    joint_prior predicts soil and gains by earlier data; `at` holds the residuals at its mean, `iterate`. false_alarms
    is the probability that the noise of one window passes the threshold; a ratio below it is an upper bound.
    """
    n, m = at.by_latents.shape[:2]
    if first >= n:
        return ChangeStatistic(max(n - 1, 0), 0.0, math.inf)
    rows, weighed = at.rows.reshape(n, m, -1)[first:], at.weighed.reshape(n, m, -1)[first:]
    misfit = np.einsum("im,im->i", rows[:, :, RESIDUAL], weighed[:, :, RESIDUAL])
    count = np.count_nonzero(rows.any(axis=2), axis=1).astype(float)
    ratio = log_likelihood_ratio(misfit, count)
    threshold = alarm_threshold(false_alarms, n - first, max(round(float(count.mean())), 1))
    if ratio.max() <= threshold:
        return ChangeStatistic(first + int(np.argmax(ratio)), float(ratio.max()), threshold)
    with_prior = Objective(objective.problem, objective.coordinates.prior, joint_prior)
    directions, jacobian = with_prior.directions(iterate.soil), with_prior.prior_jacobian(iterate.soil)
    gradient = np.einsum("imk,im->ik", weighed, rows[:, :, RESIDUAL]) @ directions
    information = directions.T @ np.einsum("imk,iml->ikl", rows, weighed) @ directions
    prior_information = jacobian.T @ with_prior.prior_precision @ jacobian
    begin = int(np.argmax(log_likelihood_ratio(misfit - _explained(gradient, information + prior_information), count)))
    # One common step for all instants from there on: the predicted soil itself must not pass for another.
    explained = _explained(gradient[begin:].sum(0), information[begin:].sum(0) + prior_information)
    ratio = log_likelihood_ratio((misfit[begin:].sum() - explained)[None], count[begin:].sum(keepdims=True))
    return ChangeStatistic(first + begin, float(ratio[0]), threshold)


def _explained(gradient: Array, information: Array) -> Array:
    """Part of Q that the best step d explains, for half gradients (..., K) and information (..., K, K)."""
    step = np.linalg.solve(information, gradient[..., None])[..., 0]
    return np.asarray((gradient * step).sum(-1))


def log_likelihood_ratio(misfit: Array, count: Array) -> Array:
    """Return the GLR (N,) from each instant on, from each instant's sum of squares and number of residuals (N,)."""
    misfit, count = np.cumsum(np.stack([misfit, count])[:, ::-1], axis=1)[:, ::-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.maximum(misfit / count, 1.0)
        return np.where(count > 0.0, 0.5 * count * (excess - 1.0 - np.log(excess)), 0.0)


@lru_cache(maxsize=256)
def alarm_threshold(probability: float, instants: int, residuals: int) -> float:
    """Return the threshold, a log likelihood ratio, that the largest GLR of noise passes with a probability.

    The probability is 0.1 at most; `residuals` has each of the `instants` at which a change may begin.

    Examples
    --------
    >>> round(alarm_threshold(1e-5, instants=31, residuals=9), 1)
    11.3
    """
    low, high = 0.5, 700.0
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _false_alarms(middle, instants, residuals) > probability else (low, middle)
    return high


def _false_alarms(threshold: float, instants: int, residuals: int) -> float:
    """Probability that the largest GLR of noise passes a threshold."""
    b, j = math.sqrt(2.0 * threshold), np.arange(1.0, instants + 1.0)
    count = residuals * j
    q = 1.0 + b * np.sqrt(2.0 / count) + 2.0 * threshold / count
    for _ in range(8):  # Newton steps
        q -= (q - 1.0 - np.log(q) - 2.0 * threshold / count) / (1.0 - 1.0 / q)
    u = (q - 1.0) * np.sqrt(0.5 * count)
    density = math.exp(-threshold) / math.sqrt(2.0 * math.pi)
    of_last = 0.5 * math.erfc(b / math.sqrt(2.0)) + density * (1.0 / u[0] - 1.0 / b)
    others = 0.5 * b**2 * density * np.exp(-0.583 * b / np.sqrt(j)) / (j * u)
    return float(of_last + others[1:].sum())


class Transition(NamedTuple):
    """Wheels come onto another soil: the first between `begin` and `end` [s], the last ones up to `lag` [s] later."""

    begin: float
    end: float
    lag: float


def without_transition(window: Window, transition: Transition, ahead: Array) -> Window:
    """Return the window with nan in torque, load, speed and sinkage of wheels between the soils; ahead as `Rig.ahead`.

    Before its `begin` all data are of the first soil; a wheel's data count again when it has arrived.
    """
    arrived = transition.end + (1.0 - ahead) * transition.lag
    between = (window.t[:, None] >= transition.begin) & (window.t[:, None] < arrived)
    blanked: dict[str, Any] = {q: np.where(between, np.nan, getattr(window, q)) for q in WHEEL_QUANTITIES}
    return replace(window, **blanked)
