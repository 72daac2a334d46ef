"""Posteriors of several windows multiply as Gaussians of what the model is linear in, and not of its logarithm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import lognorm

from driven_windows import tracker_of, windows
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.gaussian import Gaussian, solve_with_inverse
from soilbus.estimation.multistart import Fit, fit_window
from soilbus.estimation.posterior import PARAMETERS, Posterior
from soilbus.estimation.solver import Iterate, Objective
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


def test_likelihood_factor_times_prior_is_the_posterior(simulated):
    one = simulated(SOILS["loam"], 1)
    problem, prior = one.problem(), one.prior
    mode = fit_window(problem, prior).mode
    factor = mode.likelihood_factor(prior)
    assert factor.covariance[K_C, K_C] > mode.covariance[K_C, K_C]
    objective = Objective(problem, prior, factor)
    quadratic = objective.prior_at(Iterate(mode.soil, mode.gains, None))
    scale = np.sqrt(np.diag(quadratic.information))
    assert quadratic.gradient / scale == pytest.approx(0.0, abs=1e-6)
    directions = objective.directions(Iterate(mode.soil, mode.gains, None))[1:]
    directions[: len(mode.soil)] /= mode.soil[:, None]  # of logarithms
    covariance = directions @ np.linalg.inv(quadratic.information) @ directions.T
    assert covariance == pytest.approx(mode.covariance, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("name", ["k_c", "n", "c"])
def test_the_prior_factor_is_the_product_of_likelihood_and_prior(name, simulated):
    """Along a parameter, with everything else at its conditional mean: Gaussian likelihood plus log-normal prior."""
    one, i = simulated(SOILS["loam"], 1), PARAMETERS.index(name)
    prior = one.prior
    mode = fit_window(one.problem(), prior).mode
    factor = mode.likelihood_factor(prior)
    variance = np.zeros_like(factor.covariance)  # independent, so that the others can stay
    variance[range(len(variance)), range(len(variance))] = np.diag(factor.covariance)
    factor = replace(factor, covariance=variance, offset=-2.0 * np.eye(6)[i])  # a value below zero would fit best
    objective = Objective(one.problem(), prior, factor)
    values, expected = [], []
    for ratio in np.exp(np.linspace(-3.0, 0.3, 41)):
        soil = mode.soil.copy()
        soil[i] *= ratio
        if name == "k_c":  # with the same K_L
            soil[1] -= (soil[0] - mode.soil[0]) / objective.coordinates.width
            of_k_phi = (mode.soil[1] - soil[1]) / mode.soil[1]
        else:
            of_k_phi = 0.0
        values.append(objective.prior_at(Iterate(soil, factor.gains, None)).neg2_log_prior)
        of_data = (ratio + 1.0) ** 2 / variance[i, i] + of_k_phi**2 / variance[1, 1]
        expected.append(of_data + (np.log(soil[i] / prior.median[i]) / prior.log_std[i]) ** 2)
    assert np.array(values) - values[-1] == pytest.approx(np.array(expected) - expected[-1], rel=1e-6, abs=1e-6)
    assert min(values) > -0.05  # -2 log prior is zero at its least value


def test_the_ridge_of_a_likelihood_factor_is_that_of_one_strength():
    """At one pressure only p = c + pressure tan phi is known: another mean on the ridge has the same ridge."""
    prior, pressure, wide = prior_of(reference_configuration()), 4e4, np.diag([1.0, 1.0, 1.0, 0.25, 0.36, 0.25])
    c, tan = 3e3, 0.5

    def strength(soil):  # derivatives by the logarithms of phi and c, over the strength
        slope = np.array([pressure * soil[3] * (1.0 + np.tan(soil[3]) ** 2), soil[4]])
        return slope / (soil[4] + pressure * np.tan(soil[3]))

    soil = np.array([6e3, 8e5, 0.6, np.arctan(tan), c, 0.02])
    information = np.diag(1.0 / np.diag(wide))
    information[3:5, 3:5] += np.outer(strength(soil), strength(soil)) / 0.005**2
    first = Gaussian(soil, np.zeros(0), np.linalg.inv(information))
    other = soil.copy()
    other[4], other[3] = 1.5e3, np.arctan(tan + 1.5e3 / pressure)
    moved = first.relinearised(other, np.zeros(0), prior, 0.3)
    across, along = strength(other), np.array([strength(other)[1], -strength(other)[0]])
    assert np.sqrt(across @ moved.covariance[3:5, 3:5] @ across) == pytest.approx(0.005, rel=0.03)
    assert along @ moved.covariance[3:5, 3:5] @ along > 0.1**2 * (along @ along)


def test_without_prior_variance_the_likelihood_factor_is_the_gaussian():
    prior = prior_of(reference_configuration([f"soil.{name}.std=0" for name in ("k_c", "n", "phi", "c")]))
    gaussian = Gaussian.of(prior, np.zeros(0))
    assert gaussian.likelihood_factor(prior) is gaussian


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
