"""Posteriors of several windows, and what follows from one."""

import numpy as np
import pytest
from scipy.stats import lognorm

from driven_windows import tracker_of, windows
from soilbus.estimation.gaussian import Gaussian, solve_with_inverse
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


def joint(seed: int) -> tuple[Gaussian, np.ndarray]:
    """A joint Gaussian of the soil and four gains, the second held, and the prior sd of the gains."""
    rng = np.random.default_rng(seed)
    std = np.array([0.02, 0.0, 0.5, 3.0])
    free = np.concatenate([np.full(6, 0.3), std])
    root = free[:, None] * rng.standard_normal((10, 14)) / 5.0
    return Gaussian(rng.uniform(1.0, 2.0, 6), std * rng.standard_normal(4), root @ root.T), std


@pytest.mark.parametrize("kept", [1.0, 0.7, 0.2, 0.0])
def test_a_forgotten_gain_has_the_geometric_mean_of_posterior_and_prior(kept):
    """By the information filter: precisions and precisions times means are averaged; p(soil | gains) stays."""
    before, std = joint(3)
    after, at = before.forgotten(kept, std), [0, 2, 3]
    old, new = (np.linalg.inv(g.covariance[6:, 6:][np.ix_(at, at)]) for g in (before, after))
    assert new == pytest.approx(kept * old + np.diag((1.0 - kept) / std[at] ** 2), rel=1e-9)
    assert new @ after.gains[at] == pytest.approx(kept * old @ before.gains[at], rel=1e-8, abs=1e-9)
    for value in (np.zeros(3), std[at]):
        known = [g.given(np.array(at), value) for g in (before, after)]
        assert known[1].soil == pytest.approx(known[0].soil, rel=1e-9)
        assert known[1].covariance == pytest.approx(known[0].covariance, abs=1e-12)


def test_a_given_gain_conditions_the_soil():
    """By the other formula: the precision matrix without the rows of what is given."""
    before, _ = joint(5)
    at, value = np.array([0, 2]), np.array([0.01, -0.2])
    after, rest = before.given(at, value), [*range(6), 9]
    precision = np.linalg.inv(before.covariance[np.ix_([*rest, 6, 8], [*rest, 6, 8])])
    assert after.covariance[np.ix_(rest, rest)] == pytest.approx(np.linalg.inv(precision[:7, :7]), rel=1e-6)
    moved = -np.linalg.solve(precision[:7, :7], precision[:7, 7:] @ (value - before.gains[at]))
    assert np.log(after.soil / before.soil) == pytest.approx(moved[:6], rel=1e-6)
    assert after.gains[at] == pytest.approx(value)
