"""Curves that begin, end or change within a window: one more unknown for each of its seconds.

As in `curve`, but on a straight way so many unknowns would only cost, and so they count
where the data speak for them.  At the optimum of a fit without them the window is linear:
that tells how much better it fits on a bending way, and how the way bends.  The wheels'
speeds are then freed of that, and the window is fitted anew; how well each second's curve
is known goes into what is said of the soil (`present`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.curve import rim_differences, rms, sides
from soilbus.estimation.gauss_newton import Fit, settled
from soilbus.estimation.linearised import Bend
from soilbus.estimation.normal_equations import Fitting, Place
from soilbus.estimation.posterior import PARAMETERS
from soilbus.estimation.readings import Readings
from soilbus.estimation.residuals import WindowProblem
from soilbus.estimation.window import Rig, Window

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

LASTS = 1.0
"""Seconds for which a curve counts as constant."""
BENT = 25.0
"""Fall of the cost from which the way is believed to bend; noise alone makes one of about 9 in a window of 10 s."""
FIRST_GAIN = 1 + len(PARAMETERS)
"""Column of Linearised.rows of the first gain."""


class Way(NamedTuple):
    """How the way bends: relative speeds (K,) beside the window's own curve in these seconds (K,), and what they cost.

    fall: how much lower the cost is with them, `cost` included; occam: logarithm, squared,
    of the room that they had beforehand over what the window leaves of it.
    """

    second: Indices
    relative: Array
    cost: float
    fall: float
    occam: float


def seconds(t: Array, last: float) -> Indices:
    """Which second times t [s] (N,) belong to, counted back from the last."""
    return -np.floor((last - t) / LASTS + 1e-6).astype(np.intp)


def bend_std(readings: Readings) -> Array:
    """How large (N,) at each instant the curve of its second may be beside that of the window, as relative speeds."""
    apart = rim_differences(readings)
    _, second = np.unique(seconds(readings.t, readings.t[-1]), return_inverse=True)
    own = np.array([rms(apart[second == i]) for i in range(second.max() + 1)])
    return np.asarray(np.hypot(own[second], rms(apart)))


def along_bends(fitting: Fitting, fit: Fit, std: Array) -> tuple[Array, Array]:
    """Derivatives (R,) of the residuals by the curve of their own second, over its std (N,), and these weighed."""
    problem, at = fitting.problem, fit.optimum.at
    columns = [FIRST_GAIN + problem.gain_names.index(f"speed.{wheel}") for wheel in problem.rig.wheels]
    of_residual, side = np.repeat(std, at.by_latents.shape[1]), sides(problem.rig)
    return of_residual * (at.rows[:, columns] @ side), of_residual * (at.weighed[:, columns] @ side)


def bending(fitting: Fitting, fit: Fit | None) -> Way | None:
    """How the way bends, where the data of a fit say that it does."""
    problem = fitting.problem
    if fit is None or not fit.converged or not sides(problem.rig).any():
        return None
    way = likeliest_way(fitting, fit, bend_std(problem))
    return way if way.fall > BENT and math.isfinite(way.occam) else None


def likeliest_way(fitting: Fitting, fit: Fit, std: Array) -> Way:
    """How the way bends by the window linearised at the optimum of a fit, for bends of this std (N,) beforehand."""
    optimum = fit.optimum
    place = Place(optimum.soil, optimum.gains, optimum.latents, fit.cost, 0)
    known, directions = fitting.before_at(place), fitting.directions(place)
    by_bend, weighed = along_bends(fitting, fit, std)
    second, first, index = np.unique(seconds(optimum.t, optimum.t[-1]), return_index=True, return_inverse=True)
    own = np.repeat(index, optimum.at.by_latents.shape[1]) == np.arange(len(second))[:, None]  # (K, R)
    across = (own * weighed) @ optimum.at.rows
    mixed = across @ directions
    normal = directions.T @ optimum.at.normal
    right = np.column_stack([normal[:, 0] + known.gradient, mixed.T])
    explained = mixed @ np.linalg.solve(normal @ directions + known.information, right)
    gradient = across[:, 0] - explained[:, 0]
    information = np.diag((own * weighed) @ by_bend) - explained[:, 1:] + np.eye(len(second))
    bend = -np.linalg.solve(information, gradient)
    occam = float(np.linalg.slogdet(information)[1])
    return Way(second, bend * std[first], float(bend @ bend), -float(gradient @ bend), occam)


def straightened(window: Window, rig: Rig, way: Way, last: float) -> Window:
    """The window with the wheels' speeds as without these bends; seconds count back from the `last` instant [s]."""
    bent = dict(zip(way.second.tolist(), way.relative.tolist(), strict=True))
    relative = np.array([bent.get(second, 0.0) for second in seconds(window.t, last).tolist()])
    return replace(window, speed=window.speed / (1.0 + relative[:, None] * sides(rig)))


def on_the_way(fitting: Fitting, fit: Fit, way: Way, straight: WindowProblem) -> tuple[Fitting, Fit]:
    """The fit of the straightened data; where that fails, the one there was with the cost that it has linearly."""
    bend = Bend(fit.optimum, bend_std(fitting.problem))

    def with_bend(of: Fit, cost: float) -> Fit:
        evidence = min(fit.evidence, of.evidence + cost - of.cost + way.occam)
        return replace(of, cost=cost, evidence=evidence, bend=bend)

    if straight.n == fitting.problem.n:
        again = Fitting(straight, fitting.coordinates.prior, fitting.before)
        optimum = fit.optimum
        with np.errstate(all="ignore"):
            new = settled(again, again.start(optimum.soil, optimum.latents.entry_angle, optimum.gains))
        if new is not None and new.converged and new.cost + way.cost < fit.cost:
            return again, with_bend(new, new.cost + way.cost)
    return fitting, with_bend(fit, fit.cost - way.fall)
