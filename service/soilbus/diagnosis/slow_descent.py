"""A slower descent for models that are far from the truth, where the fast one goes astray.

The cost of a soil with gains and effects depends on where the latents are, and one linear
step does not bring them to their best where residuals are many standard deviations: then
the fast descent refuses good steps and creeps.  Here the latents follow at every place
before its cost counts, and no step is taken that does not lower it (Levenberg-Marquardt on
what is left: variable projection, Golub & Pereyra 1973, SIAM J. Numer. Anal. 10:413).
"""

from __future__ import annotations

import numpy as np

from soilbus.estimation.gauss_newton import Fit
from soilbus.estimation.linearised import Optimum
from soilbus.estimation.normal_equations import Fitting, Place, Point

MAX_STEPS = 15
SLOWLY = 30.0
"""Fall of the cost that is not worth a slow step, over that which is not worth a fast one: a tenth decides nothing."""
ENOUGH_FAR = 2e-3
"""Share of what the cost is above NEAR that is no fall worth a step."""
EASED, HELD_BACK = 0.3, 10.0
"""What a step that lowers the cost, and one that does not, makes of the damping."""
MOST_DAMPING = 1e4
FOLLOWED = 2
"""Linearisations that bring latents as measured to their best."""
NEAR = 2.0
"""Cost for each residual below which one linear step brings the latents to their best."""


def descended(fitting: Fitting, end: Place, start: Place, enough: float) -> Fit | None:
    """The optimum below where the fast descent ended, or below its start where that costs less.

    `enough` is a fall of the cost that is not worth a step.  None where the numbers are not finite.
    """
    with np.errstate(all="ignore"):
        here = _begun(fitting, start, end.cost) or _relaxed(fitting, end)
        if here is None:
            return None
        damping, falling, steps = 1e-2, np.inf, 0
        while falling > _enough(fitting, here[1], enough) and damping < MOST_DAMPING and steps < MAX_STEPS:
            step = here[1].step(damping)
            there = None if step is None else _relaxed(fitting, fitting.moved(*here, step))
            steps += 1
            if there is None or there[1].cost >= here[1].cost:
                damping *= HELD_BACK
            else:
                falling, damping = here[1].cost - there[1].cost, damping * EASED
                here = there
        return _fit(fitting, *here, steps, converged=steps < MAX_STEPS)


def _relaxed(fitting: Fitting, place: Place) -> tuple[Place, Point] | None:
    """The place with latents where they fit best, and the normal equations there.

    Where residuals are no longer many standard deviations the linear model has brought them there.
    """
    point = fitting.point(place)
    if point is None:
        return None
    return (place, point) if point.cost < NEAR * fitting.problem.n_rows else _followed(fitting, place, point)


def _begun(fitting: Fitting, start: Place, below: float) -> tuple[Place, Point] | None:
    """The start and its normal equations where it costs less than what is to be gone below, latents and all.

    With latents as measured it seems to cost too little, which then no step would lower.
    """
    point = fitting.point(start)
    here = None if point is None else (start, point)
    for _ in range(FOLLOWED):
        if here is None or here[1].cost >= below:
            return None
        here = _followed(fitting, *here)
    return here if here is not None and here[1].cost < below else None


def _followed(fitting: Fitting, place: Place, point: Point) -> tuple[Place, Point] | None:
    """The place with its latents where the linear model there says that they fit best."""
    place = fitting.moved(place, point, np.zeros(len(point.gradient)))
    there = fitting.point(place)
    return None if there is None else (place, there)


def _enough(fitting: Fitting, point: Point, enough: float) -> float:
    """Fall of the cost at a point below which a step was the last."""
    return max(SLOWLY * enough, ENOUGH_FAR * (point.cost - NEAR * fitting.problem.n_rows))


def _fit(fitting: Fitting, place: Place, point: Point, steps: int, converged: bool) -> Fit | None:
    beliefs = fitting.beliefs(place, point, place.soil)
    if beliefs is None:
        return None
    return Fit(
        belief=beliefs[1],
        mode=beliefs[1],
        sinkage=fitting.problem.mean_sinkage(place.as_soil(), place.gains, place.latents),
        optimum=Optimum(fitting.problem.t, place.soil, place.gains, place.latents, point.at),
        cost=point.cost,
        evidence=point.evidence,
        rows=fitting.problem.n_rows,
        iterations=steps,
        converged=converged,
    )
