"""The soil under the wheels now, where a window's fit takes it for constant.

At the optimum of the fit the window is linear.  It is cut into pieces of which each has
its own soil, a random walk away from that of the piece before, while the sensors' gain
errors stay what they are: an information filter from piece to piece (e.g. Anderson &
Moore, Optimal Filtering, 1979, sect. 6.3).  What the last piece has is the present soil;
a constant one would be late by half a window, and too sure of itself.

On a way that bends (`bends`) each second of a piece has a curve of its own besides, which is no
soil's.

The linear window tells the mode.  By as much as the filter moves that, and by what it adds
to the covariance there (never less than nothing: what may wander is known the worse), all
else that a fit says moves too: moments, averages and rivals keep their shape.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.belief import Belief
from soilbus.estimation.bends import along_bends, seconds
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
    of_residual = np.zeros((len(directions), 1 + directions.shape[1]))
    of_residual[0, 0] = 1.0
    of_residual[:, 1:] = directions
    joint = np.zeros((of_residual.shape[1],) * 2)  # cost, half its gradient, information: of gains and the piece's soil
    joint[1:, 1:] = before.information
    joint[0, 1:] = joint[1:, 0] = before.gradient
    soil = slice(1, 1 + free)
    steps = _ENDS if drift else _ENDS[-1:]
    stiff = np.eye(free) * PIECES / drift**2 if drift else np.zeros((free, free))
    of_bends = _Bends.of(fitting, fit, fit.bend.std) if fit.bend else None
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
            rows = slice(begin * m, end * m)
            normal = optimum.at.rows[rows].T @ optimum.at.weighed[rows]
            if of_bends is not None:
                normal -= of_bends.explained(optimum.at.rows, begin * m, end * m)
            joint += of_residual.T @ normal @ of_residual
    constant = of_residual.T @ optimum.at.normal @ of_residual[:, 1:]
    still = solved(constant[1:] + before.information, constant[0] + before.gradient)
    wandering = solved(joint[1:, 1:], joint[1:, 0])
    if wandering is None or still is None:
        return fit
    step, covariance = wandering
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


class _Bends(NamedTuple):
    """Derivatives (R,) of the residuals by the curve of their own second, these weighed, and which second that is."""

    rows: Array
    weighed: Array
    second: NDArray[np.intp]

    @classmethod
    def of(cls, fitting: Fitting, fit: Fit, std: Array) -> _Bends:
        t, m = fit.optimum.t, fit.optimum.at.by_latents.shape[1]
        return cls(*along_bends(fitting, fit, std), np.repeat(seconds(t, t[-1]), m))

    def explained(self, rows: Array, begin: int, end: int) -> Array:
        """Of the normal equations (1 + 6 + G, 1 + 6 + G) of these residuals what bends can take away."""
        part = slice(begin, end)
        own = self.second[part] == np.unique(self.second[part])[:, None]
        across = (own * self.weighed[part]) @ rows[part]
        return np.asarray(across.T @ (across / (1.0 + own @ (self.weighed[part] * self.rows[part]))[:, None]))
