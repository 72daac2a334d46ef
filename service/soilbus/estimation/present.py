"""The soil under the wheels now, where a window's fit takes it for constant.

At the optimum of the fit the window is linear.  It is cut into pieces of which each has
its own soil, a random walk away from that of the piece before, while the sensors' gain
errors stay what they are: an information filter from piece to piece (e.g. Anderson &
Moore, Optimal Filtering, 1979, sect. 6.3).  What the last piece has is the present soil;
a constant one would be late by half a window, and too sure of itself.

On a way that bends (`bends`) its curves are unknown besides, as the gains are.

The linear window tells the mode.  By as much as the filter moves that, and by what it adds
to the covariance there (never less than nothing: what may wander is known the worse), all
else that a fit says moves too: moments, averages and rivals keep their shape.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.belief import Belief
from soilbus.estimation.bends import along_bends
from soilbus.estimation.gauss_newton import Fit
from soilbus.estimation.normal_equations import Fitting, Place, solved

Array = NDArray[np.float64]

PIECES = 5
"""Pieces of a whole window."""
_ENDS = np.arange(1.0, PIECES + 1.0) / PIECES


def at_present(fitting: Fitting, fit: Fit, window: float, drift: float) -> Fit:
    """The fit with everything it believes of a soil that wanders.

    drift: sd by which each coordinate of the soil changes in the time of one window [s].
    The same fit where nothing wanders or the numbers stop being finite.  Cost and evidence
    stay those of a constant soil: a wandering one would explain too much that is no soil.
    """
    if not (drift or fit.bend):
        return fit
    optimum, t = fit.optimum, fit.optimum.t
    place = Place(optimum.soil, optimum.gains, optimum.latents, fit.cost, 0)
    before = fitting.before_at(place)
    free, m = len(fitting.free), optimum.at.by_latents.shape[1]
    directions = fitting.directions(place)
    rows, weighed, bends = optimum.at.rows, optimum.at.weighed, 0
    if fit.bend:
        of_bends = np.repeat(fit.bend.bends, m, axis=0)
        by_curve, weighed_curve = (a.reshape(-1, 1) for a in along_bends(fitting, fit))
        rows = np.column_stack([rows, of_bends * by_curve])
        weighed = np.column_stack([weighed, of_bends * weighed_curve])
        bends = of_bends.shape[1]
    told = directions.shape[1]
    of_residual = np.zeros((rows.shape[1], 1 + told + bends))
    of_residual[0, 0] = 1.0
    of_residual[: len(directions), 1 : 1 + told] = directions
    of_residual[len(directions) :, 1 + told :] = np.eye(bends)
    joint = np.zeros((of_residual.shape[1],) * 2)  # cost, half its gradient, information: of gains and the piece's soil
    joint[1 : 1 + told, 1 : 1 + told] = before.information
    joint[0, 1 : 1 + told] = joint[1 : 1 + told, 0] = before.gradient
    joint[1 + told :, 1 + told :] = np.eye(bends)
    soil = slice(1, 1 + free)
    steps = _ENDS if drift else _ENDS[-1:]
    stiff = np.eye(free) * PIECES / drift**2 if drift else np.zeros((free, free))
    ends = np.searchsorted(t - t[-1], window * (steps - 1.0), side="right").tolist()
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
            joint += of_residual.T @ (rows[part].T @ weighed[part]) @ of_residual
    constant = directions.T @ optimum.at.normal
    still = solved(constant @ directions + before.information, constant[:, 0] + before.gradient)
    wandering = solved(joint[1:, 1:], joint[1:, 0])
    if wandering is None or still is None:
        return fit
    step, covariance = wandering[0][:told], wandering[1][:told, :told]
    covariance[:free, :free] += np.eye(free) * drift**2 / (3.0 * PIECES)  # the end of the last piece is not its mean
    gains = place.gains.copy()
    gains[fitting.active] -= step[free:]
    now = replace(place, soil=fitting.coordinates.moved(place.soil, -step[:free]), gains=gains)
    mode = fitting.believed(now, covariance)

    def moved(belief: Belief) -> Belief:
        return mode if belief is fit.mode else fitting.changed(belief, still[0] - step, covariance - still[1])

    return replace(
        fit,
        mode=mode,
        belief=moved(fit.belief),
        rival=None if fit.rival is None else fit.rival._replace(belief=moved(fit.rival.belief)),
        averaged=None if fit.averaged is None else moved(fit.averaged),
    )
