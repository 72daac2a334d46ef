"""A slower descent for models that are far from the truth, where the fast one goes astray.

The cost of a soil with gains and effects depends on where the latents are, and one linear
step does not bring them to their best where residuals are many standard deviations: then
the fast descent refuses good steps and creeps.  Here the latents follow at every place
before its cost counts, and no step is taken that does not lower it (Levenberg-Marquardt on
what is left: variable projection, Golub & Pereyra 1973, SIAM J. Numer. Anal. 10:413).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from soilbus.estimation.gauss_newton import Fit, fit_at
from soilbus.estimation.normal_equations import Fitting, Place, Point

MAX_STEPS = 10
ENOUGH = 0.05
"""Fall of the cost that ends the descent."""
MOST_DAMPING = 1e4


def descended(fitting: Fitting, starts: Sequence[Place]) -> Fit | None:
    """The optimum below the best of some places; None where the numbers are not finite."""
    with np.errstate(all="ignore"):
        found = [place for place in (_relaxed(fitting, start) for start in starts) if place is not None]
        if not found:
            return None
        here = min(found, key=lambda place: place[1].cost)
        damping, falling = 1e-3, np.inf
        for _ in range(MAX_STEPS):
            step = here[1].step(damping)
            if step is None:
                break
            moved = fitting.moved(*here, step)
            there = _relaxed(fitting, replace(moved, gains=fitting.problem.allowed(moved.gains)))
            if there is None or there[1].cost >= here[1].cost:
                damping *= 10.0
                if damping > MOST_DAMPING:
                    break
                continue
            falling = here[1].cost - there[1].cost
            here, damping = there, damping * 0.1
            if falling < ENOUGH:
                break
        fit = fit_at(fitting, here[0])
        return None if fit is None else replace(fit, converged=falling < ENOUGH or damping > MOST_DAMPING)


def _relaxed(fitting: Fitting, place: Place) -> tuple[Place, Point] | None:
    """The place with its latents where they fit best, and the normal equations there."""
    point = fitting.point(place)
    if point is None:
        return None
    place = fitting.moved(place, point, np.zeros(len(point.gradient)))
    point = fitting.point(place)
    return None if point is None else (place, point)
