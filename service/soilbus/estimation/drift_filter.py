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
from soilbus.estimation.gaussian import Belief, solved
from soilbus.estimation.multistart import Fit
from soilbus.estimation.path_curvature import along_bends
from soilbus.estimation.solver import Around, Fitting, Place

PIECES = 5
"""Pieces of a whole window."""
STEADY = 7.0
"""Sd of a steady change of the soil in the time of one window, in units of how far it wanders."""
_ENDS = np.arange(1.0, PIECES + 1.0) / PIECES


class Change(NamedTuple):
    """From the optimum of a constant soil to the present one: step (F + A,) to take off, covariance, -2 log evidence.

    Of coordinates and active gains; evidences of one window compare with each other alone.
    """

    step: Array
    covariance: Array
    evidence: float


def at_present(fitting: Fitting, fit: Fit, window: float, drift: float) -> Fit:
    """The fit with everything it believes of a soil that wanders.

    drift: sd by which each coordinate of the soil changes in the time of one window [s].
    The same fit where nothing wanders or the numbers stop being finite.  Cost and evidence
    stay those of a constant soil: a wandering one would explain too much that is no soil.
    """
    if not (drift or fit.bend):
        return fit
    optimum, still = fit.optimum, fitting.around(fit.optimum)
    if still is None:
        return fit
    place, free = Place(optimum.soil, optimum.gains, optimum.latents, fit.cost, 0), len(fitting.free)
    likely = _changes(_joint(fitting, fit, still, window, drift), len(still.step), free, drift)
    if not likely:
        return fit
    step, covariance = _averaged(likely)
    covariance[:free, :free] += np.eye(free) * drift**2 / (3.0 * PIECES)  # the end of the last piece is not its mean
    gains = place.gains.copy()
    gains[fitting.active] -= step[free:]
    now = replace(place, soil=fitting.coordinates.moved(place.soil, -step[:free]), gains=gains)
    mode = fitting.believed(now, covariance)

    def moved(belief: Belief) -> Belief:
        return mode if belief is fit.mode else fitting.changed(belief, still.step - step, covariance - still.covariance)

    return replace(
        fit,
        mode=mode,
        belief=moved(fit.belief),
        rival=None if fit.rival is None else fit.rival._replace(belief=moved(fit.rival.belief)),
        averaged=None if fit.averaged is None else moved(fit.averaged),
    )


def _changes(joint: Array, told: int, free: int, drift: float) -> list[Change]:
    """How the soil may have changed: it wanders, or changes steadily besides; without what is not finite."""
    walk, steady = len(joint) - free, STEADY * drift
    both = [_change(joint[:walk, :walk], told)]
    if drift:
        of_steady = np.arange(walk, len(joint))
        joint[of_steady, of_steady] += 1.0 / steady**2
        both.append(_change(joint, told, 2.0 * free * math.log(steady)))
    return [change for change in both if change is not None]


def _joint(fitting: Fitting, fit: Fit, still: Around, window: float, drift: float) -> Array:
    """Cost, half its gradient and information of the last piece's soil, gains, bends, and of a steady change (F,).

    The last, of the coordinates in the time of a window, as if nothing were known of it beforehand.
    """
    at, t, directions, before = fit.optimum.at, fit.optimum.t, still.directions, still.known
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
    joint[0, 0] = before.cost
    joint[1:, 1:] = then.T @ before.information @ then
    joint[0, 1:] = joint[1:, 0] = then.T @ before.gradient
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


def _by_bends(fitting: Fitting, fit: Fit) -> tuple[Array, Array]:
    """Derivatives (N m, K) of the residuals by bends in their standard deviations, and these weighed."""
    m = fit.optimum.at.by_latents.shape[1]
    if not fit.bend:
        none = np.zeros((len(fit.optimum.t) * m, 0))
        return none, none
    of_bends = np.repeat(fit.bend.bends, m, axis=0)
    by_curve, weighed = along_bends(fitting, fit)
    return of_bends * by_curve.reshape(-1, 1), of_bends * weighed.reshape(-1, 1)


def _change(joint: Array, told: int, room: float = 0.0) -> Change | None:
    """What the first `told` unknowns change; room: -2 log of the density beforehand of the others at zero."""
    solution = solved(joint[1:, 1:], joint[1:, 0])
    if solution is None:
        return None
    step, covariance = solution
    cost = float(joint[0, 0] - joint[0, 1:] @ step)
    evidence = cost + room + float(np.linalg.slogdet(joint[1:, 1:])[1])
    return Change(step[:told], covariance[:told, :told], evidence)


def _averaged(likely: list[Change]) -> tuple[Array, Array]:
    """Mean and covariance of changes that were as likely as each other before the data."""
    evidence = np.array([change.evidence for change in likely])
    probability = np.exp(-0.5 * (evidence - evidence.min()))
    probability /= probability.sum()
    steps = np.array([change.step for change in likely])
    step = probability @ steps
    off = steps - step
    covariance = np.tensordot(probability, np.array([change.covariance for change in likely]), axes=1)
    return step, covariance + (off.T * probability) @ off
