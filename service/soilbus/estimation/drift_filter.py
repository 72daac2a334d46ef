"""The soil under the wheels now, where a window's fit takes it for constant.

At the optimum of the fit the window is linear.  It is cut into pieces of which each has
its own soil, a random walk away from that of the piece before, while the sensors' gain
errors stay what they are: an information filter from piece to piece (e.g. Anderson &
Moore, Optimal Filtering, 1979, sect. 6.3).  What the last piece has is the present soil;
a constant one would be late by half a window, and too sure of itself.

A field changes along the way by and by, so that within a window a soil which changes much
does so steadily.  A walk that is to follow it must be so wide that it makes every
estimate unsure, and knows nothing of steps that all go one way.  So the change in a window is
either the walk alone or the walk and a steady change, each as likely as it foretells
the data, and what they say is averaged (multiple models: Bar-Shalom, Li & Kirubarajan,
Estimation with Applications to Tracking and Navigation, 2001, sect. 11.6).

On a way that bends (`bends`) its curves are unknown besides, as the gains are.

The linear window tells the mode.  By as much as the filter moves that, and by what it adds
to the covariance there (never less than nothing: what may wander is known the worse), all
else that a fit says moves too: moments, averages and rivals keep their shape.
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
from soilbus.estimation.solver import GaussianApproximation, Iterate, Objective

PIECES = 5
"""Pieces of a whole window."""
STEADY = 7.0
"""Sd of a steady change of the soil in the time of one window, in units of how far it wanders."""
_ENDS = np.arange(1.0, PIECES + 1.0) / PIECES


class DriftStep(NamedTuple):
    """From the optimum of a constant soil to the present one: step (F + A,) to take off, covariance, -2 log evidence.

    Of coordinates and active gains; evidences of one window compare with each other alone.
    """

    step: Array
    covariance: Array
    neg2_log_evidence: float


def at_window_end(fitting: Objective, fit: Fit, window: float, drift: float) -> Fit:
    """The fit with everything it believes of a soil that wanders.

    drift: sd by which each coordinate of the soil changes in the time of one window [s].
    The same fit where nothing wanders or the numbers stop being finite.  Cost and evidence
    stay those of a constant soil: a wandering one would explain too much that is no soil.
    """
    if not (drift or fit.curved_path):
        return fit
    optimum, still = fit.optimum, fitting.approximation_at(fit.optimum)
    if still is None:
        return fit
    place, free = Iterate(optimum.soil, optimum.gains, optimum.latents, fit.neg2_log_posterior, 0), len(fitting.free)
    likely = _changes(_joint(fitting, fit, still, window, drift), len(still.step), free, drift)
    if not likely:
        return fit
    step, covariance = _averaged(likely)
    covariance[:free, :free] += np.eye(free) * drift**2 / (3.0 * PIECES)  # the end of the last piece is not its mean
    gains = place.gains.copy()
    gains[fitting.active] -= step[free:]
    now = replace(place, soil=fitting.coordinates.stepped(place.soil, -step[:free]), gains=gains)
    mode = fitting.gaussian_with(now, covariance)

    def moved(gaussian: Gaussian) -> Gaussian:
        return (
            mode
            if gaussian is fit.mode
            else fitting.shifted(gaussian, still.step - step, covariance - still.covariance)
        )

    return replace(
        fit,
        mode=mode,
        gaussian=moved(fit.gaussian),
        second_mode=None
        if fit.second_mode is None
        else fit.second_mode._replace(gaussian=moved(fit.second_mode.gaussian)),
        marginalised=None if fit.marginalised is None else moved(fit.marginalised),
    )


def _changes(joint: Array, told: int, free: int, drift: float) -> list[DriftStep]:
    """How the soil may have changed: it wanders, or changes steadily besides; without what is not finite."""
    walk, steady = len(joint) - free, STEADY * drift
    both = [_change(joint[:walk, :walk], told)]
    if drift:
        of_steady = np.arange(walk, len(joint))
        joint[of_steady, of_steady] += 1.0 / steady**2
        both.append(_change(joint, told, 2.0 * free * math.log(steady)))
    return [change for change in both if change is not None]


def _joint(fitting: Objective, fit: Fit, still: GaussianApproximation, window: float, drift: float) -> Array:
    """Cost, half its gradient and information of the last piece's soil, gains, bends, and of a steady change (F,).

    The last, of the coordinates in the time of a window, as if nothing were known of it beforehand.
    """
    at, t, directions, prior = fit.optimum.at, fit.optimum.t, still.directions, still.prior
    free, told, m = len(fitting.free), directions.shape[1], at.by_latents.shape[1]
    ago = (t - t[-1]) / window
    soil, steady = slice(1, 1 + free), slice(-free, None)
    parts = []
    for residuals, bends in zip((at.rows, at.weighed), _by_bends(fitting, fit), strict=True):
        known = residuals @ directions
        parts.append(np.hstack([residuals[:, :1], known, bends, known[:, :free] * np.repeat(ago, m)[:, None]]))
    rows, weighed = parts
    then = np.eye(told, rows.shape[1] - 1)  # what was known before is of the soil then
    then[:free, steady] = ago[0] * np.eye(free)
    joint = np.zeros((rows.shape[1],) * 2)
    joint[0, 0] = prior.neg2_log_prior
    joint[1:, 1:] = then.T @ prior.information @ then
    joint[0, 1:] = joint[1:, 0] = then.T @ prior.gradient
    of_bends = np.arange(1 + told, len(joint) - free)
    joint[of_bends, of_bends] += 1.0
    steps = _ENDS if drift else _ENDS[-1:]
    stiff = np.eye(free) * PIECES / drift**2 if drift else np.zeros((free, free))
    ends = np.searchsorted(ago, steps - 1.0, side="right").tolist()
    for begin, end in zip([0, *ends[:-1]], ends, strict=True):
        if begin:
            link = joint[:, soil].copy()
            step = link[soil] + stiff
            link[soil] = -stiff
            joint[soil] = joint[:, soil] = 0.0
            joint[soil, soil] = stiff
            joint -= link @ np.linalg.solve(step, link.T)
        if end > begin:
            part = slice(begin * m, end * m)
            joint += rows[part].T @ weighed[part]
    return joint


def _by_bends(fitting: Objective, fit: Fit) -> tuple[Array, Array]:
    """Derivatives (N m, K) of the residuals by bends in their standard deviations, and these weighed."""
    m = fit.optimum.at.by_latents.shape[1]
    if not fit.curved_path:
        none = np.zeros((len(fit.optimum.t) * m, 0))
        return none, none
    of_bends = np.repeat(fit.curved_path.basis, m, axis=0)
    by_curve, weighed = by_curvature(fitting, fit)
    return of_bends * by_curve.reshape(-1, 1), of_bends * weighed.reshape(-1, 1)


def _change(joint: Array, told: int, room: float = 0.0) -> DriftStep | None:
    """What the first `told` unknowns change; room: -2 log of the density beforehand of the others at zero."""
    solution = solve_with_inverse(joint[1:, 1:], joint[1:, 0])
    if solution is None:
        return None
    step, covariance = solution
    cost = float(joint[0, 0] - joint[0, 1:] @ step)
    neg2_log_evidence = cost + room + float(np.linalg.slogdet(joint[1:, 1:])[1])
    return DriftStep(step[:told], covariance[:told, :told], neg2_log_evidence)


def _averaged(likely: list[DriftStep]) -> tuple[Array, Array]:
    """Mean and covariance of changes that were as likely as each other before the data."""
    neg2_log_evidence = np.array([change.neg2_log_evidence for change in likely])
    probability = np.exp(-0.5 * (neg2_log_evidence - neg2_log_evidence.min()))
    probability /= probability.sum()
    steps = np.array([change.step for change in likely])
    step = probability @ steps
    off = steps - step
    covariance = np.tensordot(probability, np.array([change.covariance for change in likely]), axes=1)
    return step, covariance + (off.T * probability) @ off
