"""The denoised observation model: latents shrunk to their expectation, and no information from noise."""

from __future__ import annotations

import numpy as np
import pytest

from soilbus.estimation.assembly import prior_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.laplace import profile_over_n
from soilbus.estimation.multistart import fit_window, refine
from soilbus.estimation.observation_model import shrunk_latents
from soilbus.estimation.solver import Iterate, Objective
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Swing
from soilbus.terra.soils import SOILS
from tests.lab import computed_loads, local_optima
from tests.lab.cramer_rao import cramer_rao


def test_noise_is_shrunk_to_the_mean_and_a_signal_stays():
    rng = np.random.default_rng(2)
    signal = np.outer(np.sin(np.arange(200.0) / 9.0), [3.0, -1.0, 2.0, 0.0])
    sd = np.array([0.1, 0.2, 0.3, 0.1])
    noise = sd * rng.standard_normal(signal.shape)
    variance = np.broadcast_to(sd**2, signal.shape)
    level = 5.0 + noise
    assert shrunk_latents(level, variance) == pytest.approx(np.broadcast_to(level.mean(0), level.shape))
    calm = shrunk_latents(signal + noise, variance)
    left, before = (((x - signal) / sd).std() for x in (calm, signal + noise))
    assert left < 0.6 * before  # one direction of four
    exact = variance * np.array([1.0, 1.0, 1.0, 0.0])
    assert shrunk_latents(signal + noise, exact)[:, 3] == pytest.approx((signal + noise)[:, 3])


def test_a_window_without_variation_is_no_more_certain_than_the_bound():
    # With the latents as fitted, noise counts as information on n: the sd is a third below the Cramér-Rao bound.
    soil, still = SOILS["wet_clay"], Swing(0.0, 1e-9)
    config = reference_configuration(
        [*local_optima.c_and_K_known("wet_clay"), "soil.k_c.value=43680", "soil.k_c.std=20000"]
    )
    prior, ratio = prior_of(config), []
    for seed in range(8):
        problem = local_optima.window(config, "wet_clay", 10.0, local_optima.constant(0.1), False, 40 + seed, still)
        fit = fit_window(problem, prior)
        calm, latents = problem.denoised(fit.optimum)
        before = Gaussian.of(prior, problem.gain_std)
        iterate = Iterate(fit.optimum.soil, fit.optimum.gains, latents)
        top = refine(Objective(calm, prior, before), iterate)
        bound = cramer_rao(calm, prior, soil).log_covariance[2, 2]
        ratio.append([one.mode.covariance[2, 2] / bound for one in (fit, top)])
    fitted, denoised = np.sqrt(np.median(ratio, axis=0))
    assert denoised > 0.85
    assert fitted < 0.93 * denoised


def test_a_free_wheel_adds_no_noise_to_a_window_that_is_denoised():
    # The speed of a free wheel follows from the ground speed.  With a noise of its own it passes the ground speed's for
    # a signal of three channels: tan phi moves by 0.9 sd (rms) where nothing but noise is taken out.
    moved = []
    for seed in range(6):
        task = computed_loads.Task("tractor-2wd", "axle cells", "loam", 0.0, 300 + seed)
        problem, prior = computed_loads.window_of(task)
        fit = fit_window(problem, prior)
        along = profile_over_n(problem, prior, Gaussian.of(prior, problem.gain_std), fit, has_nodes=False)
        before, after = (one.mode.posterior.tan_phi() for one in (fit, along.top))
        moved.append((after.value - before.value) / before.std)
    assert np.sqrt(np.mean(np.square(moved))) < 0.4
