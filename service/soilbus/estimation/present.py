"""The soil under the wheels now, where a window's fit takes it for constant.

At the optimum of the fit the window is linear.  It is cut into pieces of which each has
its own soil, a random walk away from that of the piece before, while the sensors' gain
errors stay what they are: an information filter from piece to piece (e.g. Anderson &
Moore, Optimal Filtering, 1979, sect. 6.3).  What the last piece has is the present soil;
a constant one would be late by half a window, and too sure of itself.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.gauss_newton import Fit
from soilbus.estimation.normal_equations import Fitting, Place, Point, solved

Array = NDArray[np.float64]

PIECES = 5
"""Pieces of a whole window."""


def at_present(fitting: Fitting, fit: Fit, window: float, drift: float) -> Fit:
    """The fit with the belief of a soil that wanders.

    drift: sd by which each coordinate of the soil changes in the time of one window [s].
    The same fit where nothing wanders or the numbers stop being finite.  Cost and evidence
    stay those of a constant soil: a wandering one would explain too much that is no soil.
    """
    optimum, t = fit.optimum, fit.optimum.t
    place = Place(optimum.soil, optimum.gains, optimum.latents, fit.cost, 0)
    whole = fitting.with_before(place, optimum.at)
    if whole is None or not drift:
        return fit
    since_end = (t[-1] - t) / window * PIECES
    cuts = np.searchsorted(-since_end, -np.arange(PIECES - 1.0, 0.0, -1.0), side="right")
    cuts = np.unique([0, *cuts.tolist(), len(t)])
    stiffness = PIECES / drift**2
    free, m = len(fitting.free), optimum.at.by_latents.shape[1]
    directions = fitting.directions(place)
    of_residual = np.column_stack([np.eye(len(directions))[:, 0], directions])
    joint = np.zeros((of_residual.shape[1],) * 2)  # cost, minus half its gradient, and information of the piece's soil
    joint[1:, 1:] = whole.known
    joint[0, 1:] = joint[1:, 0] = whole.gradient - directions.T @ optimum.at.normal[:, 0]
    soil = slice(1, 1 + free)
    for k, (begin, end) in enumerate(zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True)):
        if k:
            step = joint[soil, soil] + stiffness * np.eye(free)
            link = joint[:, soil].copy()
            link[soil] = -stiffness * np.eye(free)
            joint[soil] = joint[:, soil] = 0.0
            joint[soil, soil] = stiffness * np.eye(free)
            joint -= link @ np.linalg.solve(step, link.T)
        rows = slice(begin * m, end * m)
        normal = optimum.at.rows[rows].T @ optimum.at.weighed[rows]
        joint += of_residual.T @ normal @ of_residual
    inverse = solved(joint[1:, 1:], joint[1:, 0])
    if inverse is None:
        return fit
    gains = place.gains.copy()
    gains[fitting.active] -= inverse[0][free:]
    now = replace(place, soil=fitting.coordinates.moved(place.soil, -inverse[0][:free]), gains=gains)
    left = Point(joint[1:, 1:], whole.known, whole.bend, joint[1:, 0], whole.cost, optimum.at)
    belief = fitting.belief(now, left)
    if belief is None:
        return fit
    within = fitting.coordinates.log_directions(now.soil) * drift / math.sqrt(3.0 * PIECES)
    return replace(fit, belief=belief.drifted(within @ within.T, np.zeros(len(gains))))
