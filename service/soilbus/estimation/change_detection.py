"""Where one soil ends and the next begins, told by how the newest instants disagree with what was known.

A generalised likelihood ratio over the instant of change, as in Page's cumulative sum
(Basseville & Nikiforov, Detection of Abrupt Changes, 1993, ch. 2): from the residuals since
a candidate instant, what the known soil could still explain within its uncertainty is
taken off, and the rest is compared with noise alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.observation_model import Linearisation
from soilbus.estimation.solver import Iterate, Objective
from soilbus.estimation.window import Window


class ChangeStatistic(NamedTuple):
    """First instant (index) that may be on another soil, and the log likelihood ratio that speaks for it."""

    instant: int
    ratio: float


def change_statistic(
    fitting: Objective, joint_prior: Gaussian, place: Iterate, at: Linearisation, first: int, enough: float
) -> ChangeStatistic:
    """The likeliest beginning of another soil among the instants from `first` on.

    The residuals are linearised at a place that earlier data told (`at`); `joint_prior` is what
    they told.  Below `enough` the ratio is only an upper bound.
    """
    n, m = at.by_latents.shape[:2]
    if first >= n:
        return ChangeStatistic(max(n - 1, 0), 0.0)
    rows, weighed = (a.reshape(n, m, -1)[first:] for a in (at.rows, at.weighed))
    misfit = np.einsum("im,im->i", rows[:, :, 0], weighed[:, :, 0])
    count = np.count_nonzero(rows.any(axis=2), axis=1).astype(float)
    ratio = _ratio(misfit, count)
    if ratio.max() <= enough:
        return ChangeStatistic(first + int(np.argmax(ratio)), float(ratio.max()))
    known = fitting.with_joint_prior(joint_prior)
    by_known = known.directions(place)
    gradient = np.einsum("imk,im->ik", weighed, rows[:, :, 0]) @ by_known
    information = by_known.T @ np.einsum("imk,iml->ikl", rows, weighed) @ by_known
    told = known.prior_at(place).information
    begin = int(np.argmax(_ratio(misfit - _explained(gradient, information + told), count)))
    # From there on together: another point within what is known must not pass for another soil.
    left = misfit[begin:].sum() - _explained(gradient[begin:].sum(0), information[begin:].sum(0) + told)
    return ChangeStatistic(first + begin, float(_ratio(left[None], count[begin:].sum(keepdims=True))[0]))


def _explained(gradient: Array, information: Array) -> Array:
    """Misfit that the best step of what is known takes away, for (..., K) and (..., K, K)."""
    step = np.linalg.solve(information, gradient[..., None])[..., 0]
    return np.asarray((gradient * step).sum(-1))


def _ratio(misfit: Array, count: Array) -> Array:
    """Log likelihood ratio of residuals larger than noise from each instant on.

    From each instant's sum of squares and number of residuals (N,).
    """
    misfit, count = (np.cumsum(a[::-1])[::-1] for a in (misfit, count))
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.maximum(misfit / count, 1.0)
        return np.where(count > 0.0, 0.5 * count * (excess - 1.0 - np.log(excess)), 0.0)


class Transition(NamedTuple):
    """Wheels come onto another soil: the front ones from `begin` to `end` [s], the rear ones `lag` [s] later."""

    begin: float
    end: float
    lag: float


def without_transition(window: Window, crossing: Transition, front: NDArray[np.bool_]) -> Window:
    """The window without what wheels measured on the way from one soil to the other.

    Before crossing.begin everything counts as of the first soil, and a wheel counts again
    when it must be on the second.  `front` (W,) tells the wheels of the front axle.
    """
    arrived = crossing.end + np.where(front, 0.0, crossing.lag)
    between = (window.t[:, None] >= crossing.begin) & (window.t[:, None] < arrived)

    def blanked(values: Array) -> Array:
        return np.where(between, np.nan, values)

    return replace(
        window, torque=blanked(window.torque), load=blanked(window.load), speed=blanked(window.speed),
        sinkage=blanked(window.sinkage),
    )  # fmt: skip
