"""scipy.optimize.least_squares on our residuals, parameters and priors, with finite differences.

What one would write without our derivatives by the soil: unknowns are the logarithms of
the free soil parameters and the gains of the sensors, each in units of its prior's
standard deviation; residuals are those of ours, with the same elimination of the true
loads and speeds.  Both elimination and weights depend on the soil, and a fit that may
change its own weights is biased; so they are frozen at the last pass's optimum, loads and
speeds at the measured values in the first.  Start: the prior's median.  Error bars: from
the last Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from soilbus.arrays import Array
from soilbus.estimation.observation_model import Latents, Linearisation, ObservationModel
from soilbus.estimation.posterior import Posterior
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soil_laws import lumped_modulus
from soilbus.terra.wheel import Soil, WheelState, sinkage, wheel_forces
from tests.lab.peers.windows import B_REF, Z_REF, Answer, Case, fit_model, reading_covariance

PASSES = 4
REACH = 4.0
"""Prior standard deviations that a parameter may leave the median by, as in ours."""


def estimate(case: Case) -> Answer | None:
    """None where least_squares does not converge."""
    posterior = fit(case)
    if posterior is None:
        return None
    free = {name: e for name, e in posterior.parameters().items() if e.std > 0.0}
    return free | {"bearing": posterior.bearing_pressure(Z_REF, B_REF)}


def fit(case: Case) -> Posterior | None:
    """The posterior of the soil alone."""
    problem, prior, free = case.problem, case.prior, case.prior.free
    x = np.zeros(len(free) + len(problem.gain_std))
    reach = np.where(np.arange(len(x)) < len(free), REACH, np.inf)

    def parted(x: Array) -> tuple[Soil, Array]:
        logs = np.zeros(6)
        logs[free] = prior.log_std[free] * x[: len(free)]
        return Soil(*(prior.median * np.exp(logs)).tolist()), problem.gain_std * x[len(free) :]

    soil, gains = parted(x)
    latents = problem.start(soil)
    for turn in range(PASSES):
        at = problem.linearise(soil, gains, latents)
        if turn:
            latents = problem.with_entry_angles(problem.updated(at, latents, np.zeros(6), np.zeros(len(gains))), soil)
            at = problem.linearise(soil, gains, latents)
        residuals = _whitened(problem, at, latents, gains)
        try:
            found = least_squares(
                lambda x, residuals=residuals: np.concatenate([residuals(*parted(x)), x]), x, bounds=(-reach, reach)
            )
        except ValueError:  # a residual that is not finite
            return None
        if not found.success:
            return None
        x = found.x
        soil, gains = parted(x)
    covariance = np.linalg.inv(found.jac.T @ found.jac)[: len(free), : len(free)]
    log_covariance = np.zeros((6, 6))
    log_covariance[np.ix_(free, free)] = covariance * np.outer(prior.log_std[free], prior.log_std[free])
    return Posterior(soil, log_covariance)


def _whitened(
    problem: ObservationModel, at: Linearisation, latents: Latents, frozen: Array
) -> Callable[[Soil, Array], Array]:
    """Readings less model of torques, draft balance and sinkages, whitened, by soil and gains (G,)."""
    rig, W = problem.rig, problem.n_wheels
    whiten = np.linalg.inv(np.linalg.cholesky(reading_covariance(problem, at)))
    now = np.concatenate([latents.load, latents.speed, latents.ground_speed[:, None]], axis=1)
    measured = np.concatenate([problem.load, problem.speed, problem.ground_speed[:, None]], axis=1)
    slip = 1.0 - latents.ground_speed[:, None] / (rig.radius * latents.speed)
    angle, scale = latents.entry_angle, 1.0 / (1.0 + frozen)

    def residuals(soil: Soil, gains: Array) -> Array:
        nonlocal angle  # the last one's is the best first guess
        K_L = lumped_modulus(soil.k_c, soil.k_phi, rig.width)
        state = WheelState(angle, slip, rig.radius, rig.width, K_L, soil.n, np.tan(soil.phi), soil.c, soil.K)
        angle = entry_angle_for_load(latents.load, state, fit_model())
        _, pull, torque = wheel_forces(state._replace(entry_angle=angle), fit_model())
        # A reading less what the sensor makes of the truth, in units of the truth at the frozen gains.
        draft = pull.sum(1) - (problem.demand - problem.draft)
        misfit = [(problem.torque - (1.0 + gains[:W]) * torque) * scale[:W]]
        misfit.append(((problem.draft - (1.0 + gains[-1]) * draft) * scale[-1])[:, None])
        misfit.append(problem.sinkage - sinkage(angle, rig.radius))
        linear = at.by_latents @ ((measured - (1.0 + gains[W:-1]) * now) * scale[W:-1])[:, :, None]
        return np.asarray(whiten @ (np.concatenate(misfit, axis=1)[:, :, None] + linear)).ravel()

    return residuals
