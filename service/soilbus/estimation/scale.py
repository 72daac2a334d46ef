"""Sinkages on a scale of their own: what a window's chi-square as a whole does not see.

Sinkage sensors that read a tenth too little make another soil of it, which explains the
rest nearly as well: chi-square rises by a tenth, no more than what passes for noise, and
bearing pressures go astray by a fifth.  But nothing in a soil makes all sinkages, or those of one wheel,
proportionally larger, so that along this one direction the data tell it from any soil: a score test
(Rao 1948, Proc. Camb. Phil. Soc. 44:50), at the optimum of the fit, with no fit of its own.
"""

from __future__ import annotations

import numpy as np

from soilbus.estimation.gauss_newton import Fit
from soilbus.estimation.normal_equations import Fitting
from soilbus.terra.wheel import Soil

OFF_SCALE = 25.0
"""Fall of the cost, if sinkages were measured on another scale, from which that is no noise."""


def sinkages_off_scale(fitting: Fitting, fit: Fit) -> bool:
    """Whether the sinkages of all wheels, or of one, would fit much better on another scale; no where there are none.

    The information that the noise of loads and speeds leaves of the scale is taken too
    large, as if there were none: the fall of the cost is a little underestimated.
    """
    problem, optimum = fitting.problem, fit.optimum
    around = fitting.around(optimum)
    if not problem.with_sinkage or around is None:
        return False
    at, soil = optimum.at, Soil(*optimum.soil.tolist())
    (n, m), wheels = at.by_latents.shape[:2], problem.n_wheels
    sinkage = np.where(problem.has_sinkage, problem.sinkages(soil, optimum.gains, optimum.latents), 0.0)
    weighed = at.weighed.reshape(n, m, -1)[:, m - wheels :]
    of_wheels = np.einsum("iw,iwk->wk", sinkage, weighed)
    of_gradient, of_information = around.explained(of_wheels @ around.directions)
    gradient = of_wheels[:, 0] - of_gradient
    square = np.divide(sinkage**2, problem.sinkage_var, where=problem.has_sinkage, out=np.zeros((n, wheels)))
    information = np.diag(square.sum(axis=0)) - of_information
    scales = np.vstack([np.ones(wheels), np.eye(wheels)[sinkage.any(axis=0)]])
    fall = (scales @ gradient) ** 2 / np.einsum("sw,wv,sv->s", scales, information, scales)
    return bool(fall.max() > OFF_SCALE)
