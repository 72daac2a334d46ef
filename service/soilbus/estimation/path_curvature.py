"""Path curvature: on a curve each side has its own ground speed, which looks like a gain error of wheel speed.

    V_w = V (1 -+ s),    s = B / (2 R)      track B, radius R of the curve; - on the inner side, + on the outer
    window's own curvature:   s ~ N(0, std^2), std the rms of half the relative difference of rim speeds
    within the window:        s(t) += sum_k a_k hat_k(t), knots every second, a_k ~ N(0, std_k^2)

Without a yaw rate, slip computed from the speed of the vehicle's middle is as wrong as if the speed sensors
had the gain errors +-s.  The window's own curvature is therefore one more unknown along these gains
(`with_curvature`); the difference of the rim speeds bounds its size, and the forces decide between curvature
and slip.  Curves that begin, end or change within a window need the knots.  On a straight path these would only
widen the posterior, so `detected_curvature` tests them on the window linearised at the optimum without them; if
they are significant, `straightened` removes them from the wheel speeds and the window is fitted again.  Their
uncertainty enters the posterior in drift_filter.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.instrumentation import with_speeds
from soilbus.estimation.measurements import Measurements
from soilbus.estimation.multistart import Fit, fit_window, refine
from soilbus.estimation.observation_model import FIRST_GAIN, RESIDUAL, CurvedPathFit, ObservationModel
from soilbus.estimation.posterior import PARAMETERS
from soilbus.estimation.solver import Objective
from soilbus.estimation.window import Rig, Window, pairs

_SOIL = len(PARAMETERS)


class PathCurvature(NamedTuple):
    """Prior of a window's path curvature, s = B / (2 R).

    side (6 + G,): derivatives of soil logarithms and gains by s, the `sides` of the wheels at their speed gains.
    std: prior sd of s.  gain_variance: variance of the mean speed gain of a side, by the sensors alone.
    """

    side: Array
    std: float
    gain_variance: float


class CurvedPath(NamedTuple):
    """Detected path curvature: s beyond the window's own at knots (K,) [s], relative (K,), and its -2 log prior.

    occam: log determinant of its information over that of its prior, the Occam term of -2 log evidence.
    """

    knots: Array
    relative: Array
    neg2_log_prior: float
    occam: float


def curvature_of(measurements: Measurements) -> PathCurvature:
    """Prior of the path curvature of a window, by its rim speeds."""
    side = np.zeros(_SOIL + len(measurements.gain_std))
    side[_SOIL + speed_gains(measurements)] = sides_of_sensors(measurements.rig)
    of_mean = side[_SOIL:] * measurements.gain_std / max(np.count_nonzero(side), 1)
    return PathCurvature(side, rim_difference(measurements), float(of_mean @ of_mean))


def with_curvature(gaussian: Gaussian, curvature: PathCurvature) -> Gaussian:
    """Joint prior of a window with unknown path curvature: its variance is added along the speed gains."""
    added = np.outer(curvature.side, curvature.side * curvature.std**2)
    return replace(gaussian, covariance=gaussian.covariance + added)


def without_curvature(gaussian: Gaussian, curvature: PathCurvature) -> Gaussian:
    """Posterior of a window as a prior of later ones, which have other path curvatures.

    Along `side` a window cannot separate curvature from speed gains; there only the prior of the gains remains.
    """
    side = curvature.side
    count = np.count_nonzero(side)
    if not count:
        return gaussian
    covariance = with_curvature(gaussian, curvature).covariance
    mean_along = covariance @ side / count
    spread = float(side @ mean_along) / count + curvature.gain_variance
    if not spread > 0.0:
        return gaussian
    step = -mean_along / spread * float(side[_SOIL:] @ gaussian.gains) / count
    return gaussian.shifted(step, covariance - np.outer(mean_along, mean_along) / spread)


def detected_curvature(objective: Objective, fit: Fit | None) -> CurvedPath | None:
    """Path curvature at knots, if it lowers -2 log posterior by more than `TrackerOptions.significance`.

    Parameters
    ----------
    objective : Objective
        Of the fitted window.
    fit : Fit or None
        Its fit; the window is linearised at its optimum.

    Returns
    -------
    CurvedPath or None
    """
    problem = objective.problem
    if fit is None or not fit.converged or not sides(problem.rig).any():
        return None
    optimum = fit.optimum
    approximation = objective.approximation_at(optimum)
    if approximation is None:
        return None
    std, basis = curvature_basis(objective.problem)
    by_curve, weighed = by_curvature(objective, fit)
    rows = optimum.at.rows.reshape(*weighed.shape, -1)
    cross = basis.T @ (weighed[:, None] @ rows)[:, 0]
    of_gradient, of_information = approximation.explained(cross @ approximation.directions)
    gradient = cross[:, RESIDUAL] - of_gradient
    own = (by_curve * weighed).sum(axis=1)
    information = basis.T @ (own[:, None] * basis) - of_information + np.eye(len(std))
    amplitude = -np.linalg.solve(information, gradient)
    fall = -float(gradient @ amplitude)
    if not fall > problem.options.tracker.significance:
        return None
    occam = float(np.linalg.slogdet(information)[1])
    return CurvedPath(knots_of(problem), amplitude * std, float(amplitude @ amplitude), occam)


def straightened(window: Window, rig: Rig, path: CurvedPath) -> Window:
    """The window with the wheel speeds that it would have without the curvature at knots."""
    relative = np.interp(window.t, path.knots, path.relative)
    return with_speeds(window, rig, window.speed / (1.0 + relative[:, None] * sides(rig)))


def fit_on_curved_path(
    objective: Objective, fit: Fit, path: CurvedPath, straight: ObservationModel
) -> tuple[Objective, Fit]:
    """The fit of straightened data, with the prior and Occam term of the curvature in its costs.

    Parameters
    ----------
    objective, fit : Objective, Fit
        Without curvature at knots.  Its optimum may be far off, and is only the start.
    path : CurvedPath
        The detected curvature.
    straight : ObservationModel
        Of the window straightened by `path`.

    Returns
    -------
    Objective, Fit
        Those given where the new fit is not better.
    """
    prior, joint_prior, optimum = objective.coordinates.prior, objective.joint_prior, fit.optimum
    if straight.n != objective.problem.n:
        return objective, fit
    straight_objective = Objective(straight, prior, joint_prior)
    with np.errstate(all="ignore"):
        new = refine(
            straight_objective, straight_objective.start(optimum.soil, optimum.latents.entry_angle, optimum.gains)
        )
    if new is None or not new.converged:
        new = fit_window(straight, prior, joint_prior)
    if new is None or not new.converged or new.neg2_log_posterior + path.neg2_log_prior > fit.neg2_log_posterior:
        return objective, fit
    return straight_objective, replace(
        new,
        neg2_log_posterior=new.neg2_log_posterior + path.neg2_log_prior,
        neg2_log_evidence=min(fit.neg2_log_evidence, new.neg2_log_evidence + path.neg2_log_prior + path.occam),
        curved_path=CurvedPathFit(optimum, curvature_basis(objective.problem)[1]),
    )


def by_curvature(objective: Objective, fit: Fit) -> tuple[Array, Array]:
    """Derivatives (N, m) of the residuals by the curvature s of their own instant, and these weighed."""
    problem, at = objective.problem, fit.optimum.at
    columns = FIRST_GAIN + speed_gains(problem)
    shape, side = at.by_latents.shape[:2], sides_of_sensors(problem.rig)
    return (at.rows[:, columns] @ side).reshape(shape), (at.weighed[:, columns] @ side).reshape(shape)


def curvature_basis(measurements: Measurements) -> tuple[Array, Array]:
    """Prior sd (K,) of the curvature at each knot, by the rim speeds near it and in all; hats (N, K) times it."""
    away = np.abs(measurements.t[:, None] - knots_of(measurements))
    hats = np.maximum(1.0 - away / measurements.options.posterior.knot_spacing, 0.0)
    differences = rim_differences(measurements)
    known = np.isfinite(differences)
    near = (hats > 0.0) & known[:, None]
    square = np.where(known, differences, 0.0) ** 2
    std = np.sqrt(square @ near / np.maximum(near.sum(axis=0), 1) + square.sum() / max(int(known.sum()), 1))
    return std, hats * std


def knots_of(measurements: Measurements) -> Array:
    """Times (K,) [s] of the knots for a window, counted back from its last instant."""
    t, spacing = measurements.t, measurements.options.posterior.knot_spacing
    count = math.ceil((t[-1] - t[0]) / spacing - 1e-6)
    return np.asarray(t[-1] - spacing * np.arange(count, -1, -1))


def sides(rig: Rig) -> Array:
    """Side (W,) of each wheel: -1 left, 1 right, 0 on an axle without two wheels."""
    side = np.zeros(len(rig.wheels))
    side[pairs(rig)] = [[-1.0], [1.0]]
    return side


def sides_of_sensors(rig: Rig) -> Array:
    """As `sides`, of the speed sensors: 0 for one of several wheels, whose mean speed a curve leaves."""
    side = sides(rig)
    if rig.instrumentation is not None:
        own = [row.kind == "channel" and np.count_nonzero(row.weight) == 1 for row in rig.instrumentation.speed]
        side = np.where(own, side, 0.0)
    return side


def speed_gains(measurements: Measurements) -> NDArray[np.intp]:
    """Places (W,) of the gains of the wheel speeds: after those of torques and loads."""
    return np.arange(2 * measurements.n_wheels, 3 * measurements.n_wheels)


def rim_differences(measurements: Measurements) -> Array:
    """Half the relative difference of rim speeds between the sides at each instant (N,); nan where one is unusable."""
    side = sides(measurements.rig)
    known = side != 0.0
    rim = measurements.rig.radius * measurements.speed
    if not known.any():
        return np.full(measurements.n, np.nan)
    return np.where(measurements.usable[:, known].all(axis=1), (rim @ side) / rim[:, known].sum(axis=1), np.nan)


def rim_difference(measurements: Measurements) -> float:
    """Root mean square of `rim_differences` over the window; 0 where none is known."""
    differences = rim_differences(measurements)
    known = differences[np.isfinite(differences)]
    return math.sqrt(float(np.mean(known**2))) if len(known) else 0.0
