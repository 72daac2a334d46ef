"""Curves: the wheels of one side go faster over the ground than the vehicle's middle, those of the other slower.

No sensor tells the yaw rate.  On a curve of radius R with track B a wheel's ground speed is
that of the middle times 1 -+ B/(2 R), and slip told from the middle's is as wrong as if its
speed sensor had just that gain error: on the left the opposite of on the right.  So a
curve is one more unknown of a window, along these gains.  By how much the rim speeds of the
two sides differ says how large it may be; whether they do for a curve or for slip, the
forces tell.

Curves that begin, end or change within a window: one more unknown at each of its seconds, straight lines between.

As in `curve`, but on a straight way so many unknowns would only cost, and so they count
where the data speak for them.  At the optimum of a fit without them the window is linear:
that tells how much better it fits on a bending way, and how the way bends.  The wheels'
speeds are then freed of that, and the window is fitted anew; how badly the curves are known
goes into what is said of the soil (`present`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.measurements import Measurements
from soilbus.estimation.multistart import Fit, fit_window, refine
from soilbus.estimation.observation_model import CurvedPathFit, ObservationModel
from soilbus.estimation.posterior import PARAMETERS
from soilbus.estimation.solver import Objective
from soilbus.estimation.window import Rig, Window, pairs

_SOIL = len(PARAMETERS)


def sides(rig: Rig) -> Array:
    """-1 for the wheels on the left, 1 for those on the right, 0 where an axle has not two wheels (W,)."""
    side = np.zeros(len(rig.wheels))
    side[pairs(rig)] = [[-1.0], [1.0]]
    return side


def rim_differences(readings: Measurements) -> Array:
    """Half the relative difference of rim speeds between the sides at each instant (N,); nan where not all turn."""
    side = sides(readings.rig)
    known = side != 0.0
    rim = readings.rig.radius * readings.speed
    if not known.any():
        return np.full(readings.n, np.nan)
    return np.where(readings.usable[:, known].all(axis=1), (rim @ side) / rim[:, known].sum(axis=1), np.nan)


def rim_difference(readings: Measurements) -> float:
    """Root mean square of these over the window, 0 where none is known."""
    apart = rim_differences(readings)
    known = apart[np.isfinite(apart)]
    return math.sqrt(float(np.mean(known**2))) if len(known) else 0.0


class Curve(NamedTuple):
    """A window's curve as one more unknown, as large as the rim speeds allow.

    side (6 + G,): derivatives of soil and gains by it, as `sides`; std: how large it may be, as a relative speed;
    of_gains: variance of the mean speed gain of a side, by the sensors alone.
    """

    side: Array
    std: float
    of_gains: float


def curve_of(readings: Measurements) -> Curve:
    """The curve that a window may be driven on."""
    side = np.zeros(_SOIL + len(readings.gain_std))
    first = readings.gain_names.index(f"speed.{readings.rig.wheels[0]}")
    side[_SOIL + first : _SOIL + first + readings.n_wheels] = sides(readings.rig)
    of_mean = side[_SOIL:] * readings.gain_std / max(np.count_nonzero(side), 1)
    return Curve(side, rim_difference(readings), float(of_mean @ of_mean))


def with_curve(gaussian: Gaussian, curve: Curve) -> Gaussian:
    """What is known before a window whose curve is not: as sharp as the rim speeds allow, either way."""
    return replace(gaussian, covariance=gaussian.covariance + np.outer(curve.side, curve.side * curve.std**2))


def without_curve(gaussian: Gaussian, curve: Curve) -> Gaussian:
    """What a window leaves known for later ones: its curve is not theirs, and hides what the speed sensors have of it.

    Of that only its prior is left.
    """
    side = curve.side
    count = np.count_nonzero(side)
    if not count:
        return gaussian
    covariance = with_curve(gaussian, curve).covariance
    mean_along = covariance @ side / count
    spread = float(side @ mean_along) / count + curve.of_gains
    if not spread > 0.0:
        return gaussian
    step = -mean_along / spread * float(side[_SOIL:] @ gaussian.gains) / count
    return gaussian.shifted(step, covariance - np.outer(mean_along, mean_along) / spread)


APART = 1.0
"""Seconds between two knots of the curve."""
BENT = 25.0
"""Fall of the cost from which the way is believed to bend; noise alone makes one of about 9 in a window of 10 s."""
FIRST_GAIN = 1 + len(PARAMETERS)
"""Column of Linearised.rows of the first gain."""


class CurvedPath(NamedTuple):
    """How the way bends: relative speeds (K,) beside the window's own curve at knots (K,) [s], and what they cost.

    occam: logarithm, squared, of the room that they had beforehand over what the window leaves of it.
    """

    knots: Array
    relative: Array
    neg2_log_prior: float
    occam: float


def curvature_basis(readings: Measurements) -> tuple[Array, Array]:
    """How large (K,) a curve may be at each knot, and the relative speeds (N, K) at the instants by such curves.

    As in `curve`, by the rim speeds: there and in the whole window.
    """
    hats = np.maximum(1.0 - np.abs(readings.t[:, None] - knots_of(readings.t)) / APART, 0.0)
    apart = rim_differences(readings)
    known = np.isfinite(apart)
    near = (hats > 0.0) & known[:, None]
    square = np.where(known, apart, 0.0) ** 2
    std = np.sqrt(square @ near / np.maximum(near.sum(axis=0), 1) + square.sum() / max(int(known.sum()), 1))
    return std, hats * std


def knots_of(t: Array) -> Array:
    """Knots (K,) [s] for instants t (N,), counted back from the last."""
    count = math.ceil((t[-1] - t[0]) / APART - 1e-6)
    return np.asarray(t[-1] - APART * np.arange(count, -1, -1))


def by_curvature(fitting: Objective, fit: Fit) -> tuple[Array, Array]:
    """Derivatives (N, m) of the residuals by a curve at their own instant, as a relative speed, and these weighed."""
    problem, at = fitting.problem, fit.optimum.at
    columns = [FIRST_GAIN + problem.gain_names.index(f"speed.{wheel}") for wheel in problem.rig.wheels]
    shape, side = at.by_latents.shape[:2], sides(problem.rig)
    return (at.rows[:, columns] @ side).reshape(shape), (at.weighed[:, columns] @ side).reshape(shape)


def detected_curvature(fitting: Objective, fit: Fit | None) -> CurvedPath | None:
    """How the way bends, by the window linearised at the optimum of a fit; None where the data do not say so."""
    problem = fitting.problem
    if fit is None or not fit.converged or not sides(problem.rig).any():
        return None
    optimum = fit.optimum
    approximation = fitting.approximation_at(optimum)
    if approximation is None:
        return None
    std, by_bends = curvature_basis(fitting.problem)
    by_curve, weighed = by_curvature(fitting, fit)
    rows = optimum.at.rows.reshape(*weighed.shape, -1)
    across = by_bends.T @ (weighed[:, None] @ rows)[:, 0]
    of_gradient, of_information = approximation.explained(across @ approximation.directions)
    gradient = across[:, 0] - of_gradient
    own = (by_curve * weighed).sum(axis=1)
    information = by_bends.T @ (own[:, None] * by_bends) - of_information + np.eye(len(std))
    bend = -np.linalg.solve(information, gradient)
    fall = -float(gradient @ bend)
    if not fall > BENT:
        return None
    return CurvedPath(knots_of(optimum.t), bend * std, float(bend @ bend), float(np.linalg.slogdet(information)[1]))


def straightened(window: Window, rig: Rig, way: CurvedPath) -> Window:
    """The window with the wheels' speeds as without these bends."""
    relative = np.interp(window.t, way.knots, way.relative)
    return replace(window, speed=window.speed / (1.0 + relative[:, None] * sides(rig)))


def fit_on_curved_path(
    fitting: Objective, fit: Fit, way: CurvedPath, straight: ObservationModel
) -> tuple[Objective, Fit]:
    """The fit of the straightened data; where there is none that is better, the one there was.

    Bends may have led that far astray, so it is no more than a place to begin.
    """
    prior, joint_prior, optimum = fitting.coordinates.prior, fitting.joint_prior, fit.optimum
    if straight.n != fitting.problem.n:
        return fitting, fit
    again = Objective(straight, prior, joint_prior)
    with np.errstate(all="ignore"):
        new = refine(again, again.start(optimum.soil, optimum.latents.entry_angle, optimum.gains))
    if new is None or not new.converged:
        new = fit_window(straight, prior, joint_prior)
    if new is None or not new.converged or new.neg2_log_posterior + way.neg2_log_prior > fit.neg2_log_posterior:
        return fitting, fit
    cost, neg2_log_evidence = (
        new.neg2_log_posterior + way.neg2_log_prior,
        new.neg2_log_evidence + way.neg2_log_prior + way.occam,
    )
    bend = CurvedPathFit(optimum, curvature_basis(fitting.problem)[1])
    return again, replace(
        new, neg2_log_posterior=cost, neg2_log_evidence=min(fit.neg2_log_evidence, neg2_log_evidence), curved_path=bend
    )
