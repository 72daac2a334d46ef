"""Bench of a window's fit: ours beside scipy.optimize.least_squares with finite differences.

    minimise |whitened residuals(log soil)|^2 + |(log soil - prior median) / prior sd|^2

Both have the same window, prior, wheel model, noise and unknowns: five soil parameters as logarithms, gains known,
loads and speeds of every instant eliminated. Both start at the prior's median; ours then also tries other soils.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from soilbus.arrays import Array
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.multistart import Fit, fit_window
from soilbus.estimation.observation_model import Latents, Linearisation, ObservationModel
from soilbus.estimation.posterior import SoilPrior
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import Soil, sinkage, state_on, wheel_forces
from soilbus.trials.bench.figure import Figure, in_turn
from soilbus.trials.windows import fit_from_soil, observed

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


class Window(NamedTuple):
    """A window to fit, and what is known beforehand."""

    problem: ObservationModel
    prior: SoilPrior

    @property
    def start(self) -> Soil:
        """The prior's median."""
        return Soil(*self.prior.median.tolist())


def window_solve_speedup() -> Figure:
    """10 s, four wheels, five free parameters, cold; AssertionError where the two come to different ends."""
    windows = [window_of(soil, *known) for known in EXACT_AND_ROUGH for soil in SOILS]
    apart, times = [], []
    for window in windows:
        apart.append(distance(window, fit_window(*window), by_finite_differences(window)))
        if not apart[-1] < MAX_DISTANCE_SD:
            raise AssertionError(f"ours and least_squares end {apart[-1]:.2g} standard deviations apart")
        times.append(in_turn(_works(window), ROUNDS))
    ours, alone, peer = np.array(times).T
    singly = ", ".join(f"{ratio:.1f}" for ratio in peer / ours)
    return Figure(
        float(peer.mean() / ours.mean()), 5.0,
        f"least_squares {1e3 * peer.mean():.0f} ms, ours {1e3 * ours.mean():.0f} ms",
        f"cold 10 s window, four wheels, k_c k_phi n phi and c or K free; mean of {len(windows)}, "
        f"ends {max(apart):.0e} sd apart",
        more=(
            f"least_squares starts once, ours searches from several soils; ours from that one start: "
            f"{1e3 * alone.mean():.0f} ms, {peer.mean() / alone.mean():.1f} times as fast.",
            f"Singly, {', '.join(SOILS)} with c known, then with K known: {singly} times as fast.",
        ),
    )  # fmt: skip


def distance(window: Window, ours: Fit | None, peer: Soil) -> float:
    """How far the peer's end is from ours, in our standard deviation of the parameter where that is most."""
    if ours is None or not ours.converged:
        raise AssertionError("our fit failed")
    free = window.prior.free
    std = np.sqrt(np.diag(ours.mode.covariance)[free])
    return float(np.max(np.abs(np.log(np.asarray(peer) / ours.mode.soil)[free]) / std))


def by_finite_differences(window: Window) -> Soil:
    """The most probable soil by scipy's least_squares.

    Unknowns are the logarithms' distances from the prior's median in its standard
    deviations.  Weights and the elimination of loads and speeds depend on the soil, and a
    fit that may change its own weights is biased: so each pass has them fixed.
    """
    problem, prior = window
    free, gains = prior.free, np.zeros(len(window.problem.gain_std))

    def soil_at(x: Array) -> Soil:
        logs = np.zeros(len(prior.median))
        logs[free] = prior.log_std[free] * x
        return Soil(*(prior.median * np.exp(logs)).tolist())

    x = np.zeros(len(free))
    latents = problem.start(soil_at(x))
    at = problem.linearise(soil_at(x), gains, latents)
    for turn, ftol in enumerate(PASS_TOLERANCES):
        if turn:
            soil = soil_at(x)
            at = problem.linearise(soil, gains, latents)
            latents = problem.with_entry_angles(problem.updated(at, latents, np.zeros(len(prior.median)), gains), soil)
            at = problem.linearise(soil, gains, latents)
        residuals = _whitened(problem, at, latents)
        x = least_squares(
            lambda x, residuals=residuals: np.concatenate([residuals(soil_at(x)), x]), x,
            jac="2-point", diff_step=RELATIVE_DIFFERENCE, ftol=ftol,
        ).x  # fmt: skip
    return soil_at(x)


def _whitened(problem: ObservationModel, at: Linearisation, latents: Latents) -> Callable[[Soil], Array]:
    """Measured less predicted torques, draft balance and sinkages, whitened, as a function of the soil.

    Loads and speeds are eliminated as in ours: they are measured with noise that goes through the model, linear about
    `latents`, into every residual.
    """
    own = np.concatenate([problem.torque_var, problem.demand_var[:, None], problem.sinkage_var], axis=1)
    covariance = at.by_latents * at.variance[:, None] @ at.by_latents.swapaxes(1, 2)
    np.einsum("nww->nw", covariance)[:] += own
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    now = np.concatenate([latents.load, latents.speed, latents.ground_speed[:, None]], axis=1)
    linear = (at.by_latents @ (at.corrected - now)[:, :, None])[:, :, 0]
    slip = 1.0 - latents.ground_speed[:, None] / (problem.rig.radius * latents.speed)
    angle = latents.entry_angle

    def residuals(soil: Soil) -> Array:
        nonlocal angle  # the last one's is the best first guess
        state = state_on(soil, angle, slip, problem.rig.radius, problem.rig.width)
        angle = entry_angle_for_load(latents.load, state, problem.model)
        _, pull, torque = wheel_forces(state._replace(entry_angle=angle), problem.model)
        balance = problem.demand - pull.sum(1)
        misfit = [problem.torque - torque, balance[:, None], problem.sinkage - sinkage(angle, problem.rig.radius)]
        return np.asarray((whiten @ (np.concatenate(misfit, axis=1) + linear)[:, :, None]).ravel())

    return residuals


def _works(window: Window) -> tuple[Callable[[], object], ...]:
    """Ours, ours from one start, and the peer."""
    return (
        lambda: fit_window(*window),
        lambda: fit_from_soil(*window, window.start),
        lambda: by_finite_differences(window),
    )


def window_of(name: str, exact: str, rough: str) -> Window:
    """A simulated drive with slip swept from 0.05 to 0.4."""
    soil = soil_named(name)
    median = 1.25 * getattr(soil, rough)
    config = reference_configuration([
        f"soil.{exact}.value={getattr(soil, exact)}", f"soil.{exact}.std=0",
        f"soil.{rough}.value={median}", f"soil.{rough}.std={0.25 * median}",
        *(f"noise.{quantity}.gain=0" for quantity in ("torque", "load", "speed", "ground_speed", "draft")),
    ])  # fmt: skip
    channels = simulate(config, excited(name, WINDOW_LENGTH), seed=1).channels
    return Window(observed(config, channels, WINDOW_LENGTH), prior_of(config))
