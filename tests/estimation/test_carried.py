"""What is carried from window to window adds up in k_c, in which the model is linear, and not in its logarithm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drives import tracker_of, windows
from scipy.stats import lognorm

from soilbus.estimation.assembly import prior_of
from soilbus.estimation.gaussian import Gaussian
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
    """Of the windows, end to end, of a minute of varied pull; sinkage is measured."""
    settings = [f"estimator.window={window}", f"estimator.hop={window}"]
    settings += [f"soil.{p}.value={getattr(SOILS[name], p)}" for p in ("c", "K")]
    settings += [f"soil.{p}.std={0.25 * getattr(SOILS[name], p)}" for p in ("c", "K")]
    config = reference_configuration(settings)
    recording = simulate(config, Scenario(60.0, (Patch(0.0, name, SOILS[name]),), slip=Swing(0.05, 0.40)), seed)
    tracker = tracker_of(config)
    return [tracker.estimate(*of_one).fit for of_one in windows(config, recording)]


def of_k_c(posterior: Posterior) -> tuple[float, float]:
    """Logarithm of k_c and its standard deviation."""
    return float(np.log(posterior.soil.k_c)), float(np.sqrt(posterior.log_covariance[K_C, K_C]))


def test_what_data_told_and_the_prior_are_together_what_they_were(simulated):
    one = simulated(SOILS["loam"], 1)
    problem, prior = one.problem(), one.prior
    mode = fit_window(problem, prior).mode
    told = mode.likelihood_factor(prior)
    assert told.covariance[K_C, K_C] > mode.covariance[K_C, K_C]
    fitting = Objective(problem, prior, told)
    known = fitting.prior_at(Iterate(mode.soil, mode.gains, None, np.inf, 0))
    scale = np.sqrt(np.diag(known.information))
    assert known.gradient / scale == pytest.approx(0.0, abs=1e-6)
    directions = fitting.directions(Iterate(mode.soil, mode.gains, None, np.inf, 0))[1:]
    directions[: len(mode.soil)] /= mode.soil[:, None]  # of logarithms
    covariance = directions @ np.linalg.inv(known.information) @ directions.T
    assert covariance == pytest.approx(mode.covariance, rel=1e-6, abs=1e-12)


def test_two_that_tell_k_c_badly_tell_it_as_their_product_does(simulated):
    """Against an integral over k_c: the least cost of Gaussian data and log-normal prior, and the curvature there."""
    one = simulated(SOILS["loam"], 1)
    prior = one.prior
    mode = fit_window(one.problem(), prior).mode
    told = replace(mode.likelihood_factor(prior), k_c_offset=-2.0)  # a k_c below zero would fit best
    fitting = Objective(one.problem(), prior, told)
    k_c = mode.soil[K_C] * np.exp(np.linspace(-3.0, 1.0, 41))
    along = told.covariance[:, K_C] / told.covariance[K_C, K_C]
    shift = k_c / mode.soil[K_C] + 1.0
    costs = []
    for k, off in zip(k_c, shift, strict=True):
        soil, gains = told.soil * np.exp(along[:6] * off), told.gains + along[6:] * off
        soil[K_C] = k
        costs.append(fitting.prior_at(Iterate(soil, gains, None, np.inf, 0)).neg2_log_prior)
    of_data = shift**2 / told.covariance[K_C, K_C]
    of_prior = (np.log(k_c / prior.median[K_C]) / prior.log_std[K_C]) ** 2
    expected = of_data + of_prior
    assert costs - np.min(costs) == pytest.approx(expected - expected.min(), rel=1e-6, abs=1e-6)
    assert abs(np.min(costs)) < 0.05  # what is known costs nothing where it is likeliest


def test_what_is_given_or_moved_stays_told_by_data(simulated):
    one = simulated(SOILS["loam"], 1)
    told = fit_window(one.problem(), one.prior).mode.likelihood_factor(one.prior)
    n = PARAMETERS.index("n")
    held = told.conditioned_on(n, float(np.log(told.soil[n])) + 0.02)
    along = told.covariance[:, n] / told.covariance[n, n]
    assert held.soil[K_C] == told.soil[K_C]
    assert held.k_c_offset == pytest.approx(told.k_c_offset + 0.02 * along[K_C])
    assert held.soil[n] == pytest.approx(told.soil[n] * np.exp(0.02))


def test_a_prior_without_doubt_about_k_c_has_nothing_apart():
    prior = prior_of(reference_configuration(["soil.k_c.std=0"]))
    gaussian = Gaussian.of(prior, np.zeros(0))
    assert gaussian.likelihood_factor(prior) is gaussian


@pytest.mark.parametrize("seed", [1, 2])
def test_windows_in_a_row_tell_k_c_as_one_long_window_does(seed):
    """In logarithms six windows of 10 s had told k_c of this clay to a third, and a factor of 2.5 too small."""
    row, whole = fits(CLAY, seed, 10.0), fits(CLAY, seed, 60.0)
    (log, std), (at_once, std_at_once) = of_k_c(row[-1].reported.posterior), of_k_c(whole[-1].reported.posterior)
    assert abs(log - at_once) < std_at_once
    assert 0.7 < std / std_at_once < 1.6
    assert abs(log - np.log(SOILS[CLAY].k_c)) < 2.5 * std


@pytest.mark.parametrize("sd", [0.01, 0.1, 0.3, 0.6, 1.0, 1.3])
def test_value_and_std_hold_what_they_say_however_wide(sd):
    """Against scipy's log-normal distribution."""
    covariance = np.zeros((6, 6))
    covariance[K_C, K_C] = sd**2
    told = Posterior(Soil(2000.0, 8e5, 0.6, 0.5, 2e3, 0.02), covariance).parameters()["k_c"]
    true = lognorm(sd, scale=2000.0)
    assert told.std**2 == pytest.approx(true.moment(2) - 2.0 * 2000.0 * true.mean() + 2000.0**2, rel=1e-6)
    held = true.cdf(told.value + 1.96 * told.std) - true.cdf(told.value - 1.96 * told.std)
    assert 0.94 < held < 0.97
