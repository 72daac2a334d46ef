"""Descents of one fit: far from the optimum by the soil alone, near it by soil, gains and latents together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.coordinates import MAX_STEP
from soilbus.estimation.normal_equations import Fitting, Place, Point

Array = NDArray[np.float64]

CONVERGED, CONVERGED_RESUMED = 1e-6, 3e-3
"""Squared length of a step in posterior standard deviations that ends the fit, and one that is resumed from the
window before: what such a step leaves behind is much less."""
LEFT_OVER, LEFT_OVER_RESUMED = 2e-8, 1e-4
"""The same for what a full step leaves behind, foreseen from how fast the steps shrink."""
SETTLING = 1.0
"""The same, below which the latents and gains join in."""
ENOUGH = 0.02
"""Relative fall of the cost below which the approach has done its part."""
LITTLE = 1e-3
"""The same where other parameters than the soil's move too."""
WORSE = 20.0
"""Rise of the cost that a step may bring: where the cost bends, steps that overshoot come back by themselves."""
AT_FIRST = 0.02
"""Share of the cost by which it may rise besides at the first step: with latents as measured it seems too low."""
SLOWLY = 0.5
"""Length of a step over that of the last, along it, above which steps are extrapolated."""
MAX_STRIDE = 8.0
MAX_REFUSED = 5
"""Steps taken back one after the other after which a fit has failed: what is left is noise of the linear model."""
IDLE, NEARLY = 2, 1.0
"""Steps in a row that do not lower the cost, and how little they must foresee, after which no further one will."""
FAR = 10.0
"""Standard deviations on a few instants beyond which an end is not the optimum looked at."""


class Settled(NamedTuple):
    """Where a descent ended: the place one step on from the `last` one, whose `point` foresaw it.

    length is the squared length of that step in posterior standard deviations.
    """

    place: Place
    last: Place
    point: Point
    length: float
    iterations: int
    converged: bool


def approach(
    fitting: Fitting,
    soil: Array,
    most: int,
    least: float = ENOUGH,
    gains: Array | None = None,
    known: Sequence[Place] = (),
    hopeless: float = np.inf,
) -> Place | None:
    """Levenberg-damped steps of the soil and the active gains, latents as measured, until they are short.

    A descent that is foreseen to end at one of the `known` places ends there at once; one
    that is foreseen to cost more than `hopeless`, or that has no further step, is None.
    """
    place = fitting.start(soil, gains=gains)
    point = fitting.point(place)
    damping, ease, trials = 1e-3, 0.1, 1
    while point is not None:
        step = point.step(damping)
        if step is None:
            return None
        length = point.length(step)
        if point.cost - length > hopeless:
            return None
        if length < SETTLING or trials >= most or damping > 1e6:
            return replace(place, cost=point.cost, trials=trials)
        for end in known:
            if _leads_to(fitting, place, point, step, end):
                return replace(end, trials=trials)
        new_place = fitting.restarted(place, point, step)
        new = fitting.point(new_place)
        trials += 1
        if new is None or new.cost >= point.cost:
            damping, ease = 10.0 * damping, 1.0
            continue
        enough = point.cost - new.cost < least * point.cost
        place, point, damping, ease = new_place, new, damping * ease, 0.1
        if enough:
            return replace(place, cost=point.cost, trials=trials)
    return None


def _leads_to(fitting: Fitting, place: Place, point: Point, step: Array, end: Place) -> bool:
    """Whether a step of the soil comes so near to where another descent ended that this one will end there too.

    Only a short step is trusted to tell.
    """
    if np.abs(step).max() > MAX_STEP:
        return False
    off = fitting.coordinates.position(end.soil) - fitting.coordinates.position(place.soil) - step
    return point.length(off) < FAR**2


def _stride(point: Point, last: Array, share: float, step: Array) -> float:
    """How many times a step to go that follows this share of the last one (Aitken's extrapolation).

    More than once where steps shrink slowly, less where they turn back.
    """
    left = 1.0 - (1.0 - float(last @ point.information @ step) / point.length(last)) / share
    return min(1.0 / max(1.0 - left, 1.0 / MAX_STRIDE), MAX_STRIDE) if abs(left) > SLOWLY else 1.0


def settle(
    fitting: Fitting,
    near: Place,
    most: int,
    left_over: float = LEFT_OVER,
    before: float = 0.0,
    refusals: int = MAX_REFUSED,
    hopeless: float = np.inf,
    enough: float = CONVERGED,
    nothing: float = 0.0,
) -> Settled | None:
    """Steps of soil, gains and latents together from a place near the optimum.

    `before` is the squared length of the step that led there, if it was one of these; a step
    of less than `enough` is the last, and one after which the cost twice fell by less than
    `nothing` though little more was foreseen: along a bent valley steps overshoot for ever.
    Given up after more `refusals` in a row, and where the foreseen cost is above `hopeless`.
    None where the numbers stop being finite.

    A step that makes things worse is taken back and tried again shorter: damping would
    hold back just the weak directions, along which the steps overshoot.
    """
    best: tuple[Place, Point] | None = None
    share, length, refused = 1.0, np.inf, 0
    iterations, converged = near.trials, False
    last_step: Array | None = None
    last_share = 1.0
    worse = np.inf
    lowest: Settled | None = None
    idle = 0
    for _ in range(most):
        iterations += 1
        point = fitting.point(near)
        if best is not None and (point is None or point.cost > best[1].cost + worse):
            near, point = best
            if refused == 1:
                near = fitting.carried(near)
                point = fitting.point(near)
            share = 0.4 * min(share, 1.0)
            before, last_step = 0.0, None  # nothing can be foreseen after a refused step
            refused += 1
            if refused > refusals:
                break
        else:
            share, refused = min(2.0 * share, 1.0), 0
        full = None if point is None else point.step()
        if point is None or full is None:
            return None
        worse = WORSE if best is not None else WORSE + AT_FIRST * point.cost
        best = (near, point)
        length = point.length(full)
        if last_step is not None and share == 1.0:
            share = _stride(point, last_step, last_share, full)
        near = fitting.moved(near, point, share * full)
        last_step, last_share = full, share
        converged = length < enough or (share == 1.0 and length * length < left_over * before)
        before = length if share == 1.0 else 0.0
        if converged or point.cost - length > hopeless:
            break
        idle = idle + 1 if lowest is not None and lowest.point.cost - point.cost < nothing else 0
        if lowest is None or point.cost < lowest.point.cost:
            lowest = Settled(near, *best, length, iterations, converged=True)
        if nothing > 0.0 and idle >= IDLE and lowest.length < NEARLY:
            return lowest._replace(iterations=iterations)
    if best is None:
        return None
    if not converged and lowest is not None and lowest.length < CONVERGED_RESUMED:
        return lowest._replace(iterations=iterations)
    return Settled(near, *best, length, iterations, converged)
