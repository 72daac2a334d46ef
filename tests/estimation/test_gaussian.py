"""Posteriors of several windows, and what follows from one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import lognorm

from driven_windows import tracker_of, windows
from soilbus.estimation.gaussian import solve_with_inverse
from soilbus.estimation.multistart import Fit
from soilbus.estimation.posterior import PARAMETERS, Posterior
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil

K_C = PARAMETERS.index("k_c")
CLAY = "clayey_soil_38"


def fits(name: str, seed: int, window: float) -> list[Fit]:
    """Fits of the windows, end to end, of one minute with varied slip and measured sinkage."""
    settings = [f"estimator.window={window}", f"estimator.hop={window}"]
    settings += [f"soil.{p}.value={getattr(SOILS[name], p)}" for p in ("c", "K")]
    settings += [f"soil.{p}.std={0.25 * getattr(SOILS[name], p)}" for p in ("c", "K")]
    config = reference_configuration(settings)
    recording = simulate(config, Scenario(60.0, (Patch(0.0, name, SOILS[name]),), slip=Swing(0.05, 0.40)), seed)
    tracker = tracker_of(config)
    return [tracker.estimate(*of_one).fit for of_one in windows(config, recording)]


def of_k_c(posterior: Posterior) -> tuple[float, float]:
    """log k_c and its sd."""
    return float(np.log(posterior.soil.k_c)), float(np.sqrt(posterior.log_covariance[K_C, K_C]))


@pytest.mark.parametrize("seed", [1, 2])
def test_consecutive_windows_determine_k_c_as_one_long_window_does(seed):
    """With Gaussians of log k_c, six windows of 10 s gave k_c of this clay 2.5 times too small, to a third."""
    windows_, whole = fits(CLAY, seed, 10.0), fits(CLAY, seed, 60.0)
    (log, std), (at_once, std_at_once) = of_k_c(windows_[-1].posterior), of_k_c(whole[-1].posterior)
    assert abs(log - at_once) < std_at_once
    assert 0.7 < std / std_at_once < 1.6
    assert abs(log - np.log(SOILS[CLAY].k_c)) < 2.5 * std


@pytest.mark.parametrize("sd", [0.01, 0.1, 0.3, 0.6, 1.0, 1.3])
def test_value_and_std_of_a_log_normal_contain_95_percent(sd):
    """Against scipy's log-normal distribution, narrow and wide."""
    covariance = np.zeros((6, 6))
    covariance[K_C, K_C] = sd**2
    estimate = Posterior(Soil(2000.0, 8e5, 0.6, 0.5, 2e3, 0.02), covariance).parameters()["k_c"]
    true = lognorm(sd, scale=2000.0)
    assert estimate.std**2 == pytest.approx(true.moment(2) - 2.0 * 2000.0 * true.mean() + 2000.0**2, rel=1e-6)
    contained = true.cdf(estimate.value + 1.96 * estimate.std) - true.cdf(estimate.value - 1.96 * estimate.std)
    assert 0.94 < contained < 0.97


def test_a_singular_or_badly_scaled_system_is_solved_or_refused():
    root = np.random.default_rng(0).normal(size=(5, 5)) * np.geomspace(1e-6, 1e6, 5)
    information = root.T @ root
    gradient = information @ np.arange(5.0)
    step, inverse = solve_with_inverse(information, gradient)
    scale = np.sqrt(np.diag(information))  # over twelve decades
    assert step * scale == pytest.approx(np.arange(5.0) * scale, rel=1e-8, abs=1e-6)
    assert inverse * np.outer(scale, scale) == pytest.approx(np.linalg.inv(information / np.outer(scale, scale)))
    with np.errstate(all="ignore"):
        assert solve_with_inverse(np.zeros((2, 2)), np.zeros(2)) is None
        assert solve_with_inverse(np.full((2, 2), np.nan), np.zeros(2)) is None


@pytest.mark.parametrize("std", [0.2, 0.5])
def test_what_follows_cohesion_is_as_open_as_a_log_normal_one(std):
    """tan phi on a line of one strength, c + p tan phi, against draws of a log-normal c."""
    soil, pressure = Soil(1e3, 1e6, 0.7, 0.5, 2e3, 0.02), 4e4
    c, phi = PARAMETERS.index("c"), PARAMETERS.index("phi")
    slope = -soil.c / pressure / (soil.phi * (1.0 + np.tan(soil.phi) ** 2))  # of log phi by log c
    covariance = np.zeros((6, 6))
    covariance[np.ix_([phi, c], [phi, c])] = std**2 * np.outer([slope, 1.0], [slope, 1.0])
    posterior = Posterior(soil, covariance)
    cohesion = soil.c * np.exp(std * np.random.default_rng(1).standard_normal(400_000))
    expected = np.sqrt(np.mean((cohesion - soil.c) ** 2))
    assert posterior.tan_phi().std == pytest.approx(expected / pressure, rel=0.01)
    assert posterior.parameters()["c"].std == pytest.approx(expected, rel=0.01)
    assert posterior.shear_strength(pressure).std < 1e-6 * expected
