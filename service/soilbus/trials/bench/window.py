"""Bench of a window's fit: ours beside scipy.optimize.least_squares with finite differences.

    minimise |whitened residuals(log soil, gains)|^2 + |(log soil - prior median) / prior sd|^2 + |gains / their sd|^2

Both have the same window, prior, wheel model, noise and unknowns; loads and speeds of every instant are eliminated.
Both start at the prior's median; ours then also tries other soils.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from soilbus.arrays import Array
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.linearisation import Latents, Linearisation
from soilbus.estimation.multistart import Fit, fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.options import ESTIMATOR, HELD
from soilbus.estimation.posterior import PARAMETERS, Posterior, SoilPrior
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import Soil, sinkage, state_on, wheel_forces
from soilbus.trials.bench.figure import Figure, in_turn
from soilbus.trials.windows import observed

SOILS = ("loam", "wet_clay", "dry_sand")
EXACT_AND_ROUGH = (("c", "K"), ("K", "c"))
"""Pairs: the parameter known exactly, and the one known to a quarter, whose prior median is a quarter too large."""
WINDOW_LENGTH = 10.0
"""[s]."""
ROUNDS = 4
"""Timed runs, of which the shortest counts."""
MAX_DISTANCE_SD = 0.05
"""Greatest distance of the two ends in any parameter, in posterior standard deviations."""
PASS_TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-8)
"""Relative fall of the cost that ends each pass of least_squares (its ftol; the last is its default).

Each pass has the weights and the eliminated loads and speeds of the end of the one before, so an exact end of all but
the last would be wasted. Four passes are the least that bring all six windows to the same end as ours."""
RELATIVE_DIFFERENCE = 1e-5
"""Relative step of the finite differences. The default, 1.5e-8, takes more steps: entry angles are solved to 1e-12."""
AT_REST = replace(ESTIMATOR, standing=HELD)
"""The peer knows no relaxation, inertia and lateness."""


class Window(NamedTuple):
    """Window to fit, and what is known beforehand."""

    problem: ObservationModel
    prior: SoilPrior


def window_solve_speedup() -> Figure:
    """Compare our solution of a window of four wheels with scipy's; AssertionError where the ends differ."""
    windows = [window_of(soil, *known) for known in EXACT_AND_ROUGH for soil in SOILS]
    apart, times = [], []
    for window in windows:
        apart.append(distance(window, fit_window(*window), by_finite_differences(*window)))
        if not apart[-1] < MAX_DISTANCE_SD:
            raise AssertionError(f"ours and least_squares end {apart[-1]:.2g} standard deviations apart")
        times.append(in_turn((partial(fit_window, *window), partial(by_finite_differences, *window)), ROUNDS))
    ours, peer = np.array(times).T
    return Figure(
        float(peer.mean() / ours.mean()), 5.0,
        f"least_squares {1e3 * peer.mean():.0f} ms, ours {1e3 * ours.mean():.0f} ms",
        f"cold 10 s window, four wheels, k_c k_phi n phi and c or K free; mean of {len(windows)}, "
        f"ends {max(apart):.0e} sd apart",
    )  # fmt: skip


def distance(window: Window, ours: Fit | None, peer: Posterior) -> float:
    """Return how far the peer's end is from ours, in sd of the worst parameter."""
    if ours is None or not ours.converged:
        raise AssertionError("our fit failed")
    free = window.prior.free
    std = np.sqrt(np.diag(ours.mode.covariance)[free])
    return float(np.max(np.abs(np.log(np.asarray(peer.soil) / ours.mode.soil)[free]) / std))


def by_finite_differences(problem: ObservationModel, prior: SoilPrior) -> Posterior:
    """Return the most probable soil by scipy's least_squares, with the covariance of its last Jacobian.

    Notes
    -----
    Unknowns are the logarithms' distances from the prior's median and the gains, each in its prior's standard
    deviations. Weights and the elimination of loads and speeds depend on the soil, and a fit that may change its own
    weights is biased: so each pass has them fixed.
    """
    free = prior.free

    def parted(x: Array) -> tuple[Soil, Array]:
        logs = np.zeros(len(prior.median))
        logs[free] = prior.log_std[free] * x[: len(free)]
        return Soil(*(prior.median * np.exp(logs)).tolist()), problem.gain_std * x[len(free) :]

    x = np.zeros(len(free) + len(problem.gain_std))
    soil, gains = parted(x)
    latents = problem.start(soil)
    for turn, ftol in enumerate(PASS_TOLERANCES):
        at = problem.linearise(soil, gains, latents)
        if turn:
            step = np.zeros(len(prior.median)), np.zeros(len(gains))
            latents = problem.with_entry_angles(problem.updated(at, latents, *step), soil)
            at = problem.linearise(soil, gains, latents)
        residuals = _whitened(problem, at, latents, gains)
        found = least_squares(
            lambda x, residuals=residuals: np.concatenate([residuals(*parted(x)), x]), x,
            jac="2-point", diff_step=RELATIVE_DIFFERENCE, ftol=ftol,
        )  # fmt: skip
        x = found.x
        soil, gains = parted(x)
    log_covariance = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    covariance = np.linalg.inv(found.jac.T @ found.jac)[: len(free), : len(free)]
    log_covariance[np.ix_(free, free)] = covariance * np.outer(prior.log_std[free], prior.log_std[free])
    return Posterior(soil, log_covariance)


def _whitened(
    problem: ObservationModel, at: Linearisation, latents: Latents, frozen: Array
) -> Callable[[Soil, Array], Array]:
    """Measured less predicted torques, draft and sinkages, whitened, as a function of soil and gains.

    Loads and speeds are eliminated as in ours: they are measured with noise that goes through the model, linear about
    `latents`, into every residual.
    """
    rig, W, scale = problem.rig, problem.n_wheels, 1.0 / (1.0 + frozen)
    draft_gain = 3 * W + 1  # after those of torques, loads, speeds and ground speed
    own = np.concatenate([problem.torque_var, problem.demand_var[:, None], problem.sinkage_var], axis=1)
    covariance = at.by_latents * at.variance[:, None] @ at.by_latents.swapaxes(1, 2)
    np.einsum("nww->nw", covariance)[:] += own
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    now = np.concatenate([latents.load, latents.speed, latents.ground_speed[:, None]], axis=1)
    measured = np.concatenate([problem.load, problem.speed, problem.ground_speed[:, None]], axis=1)
    slip = 1.0 - latents.ground_speed[:, None] / (rig.radius * latents.speed)
    angle = latents.entry_angle

    def residuals(soil: Soil, gains: Array) -> Array:
        nonlocal angle  # the last one's is the best first guess
        state = state_on(soil, angle, slip, rig.radius, rig.width)
        angle = entry_angle_for_load(latents.load, state, problem.model)
        _, pull, torque = wheel_forces(state._replace(entry_angle=angle), problem.model)
        draft = pull.sum(1) - (problem.demand - problem.draft)
        misfit = [
            (problem.torque - (1.0 + gains[:W]) * torque) * scale[:W],
            ((problem.draft - (1.0 + gains[draft_gain]) * draft) * scale[draft_gain])[:, None],
            problem.sinkage - sinkage(angle, rig.radius),
        ]
        linear = at.by_latents @ ((measured - (1.0 + gains[W:draft_gain]) * now) * scale[W:draft_gain])[:, :, None]
        return np.asarray((whiten @ (np.concatenate(misfit, axis=1)[:, :, None] + linear)).ravel())

    return residuals


def window_of(name: str, exact: str, rough: str) -> Window:
    """Return the window of a simulated drive with slip swept from 0.05 to 0.4."""
    soil = soil_named(name)
    median = 1.25 * getattr(soil, rough)
    config = reference_configuration([
        f"soil.{exact}.value={getattr(soil, exact)}", f"soil.{exact}.std=0",
        f"soil.{rough}.value={median}", f"soil.{rough}.std={0.25 * median}",
        *(f"noise.{quantity}.gain=0" for quantity in ("torque", "load", "speed", "ground_speed", "draft")),
    ])  # fmt: skip
    channels = simulate(config, excited(name, WINDOW_LENGTH), seed=1).channels
    return Window(observed(config, channels, WINDOW_LENGTH, AT_REST), prior_of(config))
