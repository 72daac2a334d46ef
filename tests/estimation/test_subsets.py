"""One, five or all of the six soil parameters free, the others held; and what two tyre widths determine of k_c."""

from itertools import combinations

import numpy as np
import pytest

from cramer_rao import cramer_rao
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.terra.soils import SOILS

CLAY = SOILS["wet_clay"]
TRUTH = np.asarray(CLAY)
LOG_STD = 0.4
SUBSETS = [subset for size in (1, 5, 6) for subset in combinations(range(6), size)]


def prior_of(free, log_std=LOG_STD):
    """Prior medians of the free parameters with an error of this size, the others held at the truth."""
    spread = np.zeros(6)
    spread[list(free)] = log_std
    miss = np.array([1.0, -0.7, 0.5, -1.0, 0.8, -0.6]) * spread
    return SoilPrior(TRUTH * np.exp(miss), spread)


@pytest.fixture(scope="module")
def clay(simulated):
    return simulated(CLAY, 300).problem()


@pytest.fixture(scope="module")
def all_free(clay):
    return np.diag(cramer_rao(clay, prior_of(range(6)), CLAY).log_covariance)


@pytest.mark.parametrize("free", SUBSETS, ids=lambda free: "+".join(PARAMETERS[i] for i in free))
def test_free_ones_are_found_and_held_ones_held(free, clay, all_free):
    prior = prior_of(free)
    fit = fit_window(clay, prior)
    assert fit.converged
    posterior, held = fit.posterior, [i for i in range(6) if i not in free]
    covariance = posterior.log_covariance
    assert [posterior.soil[i] for i in held] == [CLAY[i] for i in held]  # to the last bit
    assert not covariance[held].any()
    assert not covariance[:, held].any()
    assert all(posterior.parameters()[PARAMETERS[i]].std == 0.0 for i in held)
    std = np.sqrt(np.diag(covariance))[list(free)]
    assert (std > 0.0).all()
    assert (std < 0.7 * LOG_STD).all()  # the window tells something of each
    variance = np.diag(cramer_rao(clay, prior, CLAY).log_covariance)[list(free)]
    assert std == pytest.approx(np.sqrt(variance), rel=0.25)  # at the estimate, the bound is at the truth
    assert (variance <= all_free[list(free)] * (1.0 + 1e-9)).all()  # who knows the others knows these better
    miss = np.log(np.asarray(posterior.soil) / TRUTH)[list(free)]
    squares = miss @ np.linalg.solve(covariance[np.ix_(free, free)], miss)
    assert squares < 22.5  # chi-square with up to 6 degrees of freedom: 99.9 %
    assert fit.chi2 == pytest.approx(1.0, abs=0.15)


def test_nothing_free_is_the_prior(clay):
    posterior = fit_window(clay, prior_of(())).posterior
    assert posterior.soil == CLAY
    assert not posterior.log_covariance.any()
    assert posterior.bearing_pressure(0.02, 0.3).std == posterior.tan_phi().std == 0.0


WIDTHS = {"unlike": (0.20, 0.50), "alike": (0.35, 0.35)}
PRIOR = 0.5
"""Sd of the logarithm of k_c; of the others it is wide."""


@pytest.fixture(scope="module")
def fits(simulated):
    """Eight drives each with unlike and with equal tyre widths in front and behind."""
    spread = np.array([PRIOR, 1.0, 0.5, 0.4, 0.25, 0.25])

    def fit(widths, seed):
        wheels = {"FL": 0, "FR": 0, "RL": 1, "RR": 1}
        settings = [f"wheel.{name}.width={widths[axle]}" for name, axle in wheels.items()]
        prior_median = TRUTH * np.exp(spread * np.random.default_rng([seed, 5]).standard_normal(6))
        problem = simulated(CLAY, seed, settings).problem()
        return prior_median, fit_window(problem, SoilPrior(prior_median, spread)).posterior

    return {which: [fit(widths, 400 + seed) for seed in range(8)] for which, widths in WIDTHS.items()}


def deviations(posteriors, name):
    """Error of the logarithm in its own standard deviations."""
    i = PARAMETERS.index(name)
    return np.array([
        np.log(p.soil[i] / TRUTH[i]) / np.sqrt(p.log_covariance[i, i]) for p in posteriors
    ])  # fmt: skip


def test_two_tyre_widths_separate_k_c_from_k_phi(fits):
    unlike = [posterior for _, posterior in fits["unlike"]]
    assert max(np.sqrt(p.log_covariance[0, 0]) for p in unlike) < 0.12 * PRIOR
    for name in ("k_c", "k_phi"):
        z = deviations(unlike, name)
        assert np.abs(z).max() < 3.5
        assert 0.86 < (z**2).sum() < 26.2  # chi-square with 8 degrees of freedom: 99.8 %


def known_before(prior_median, K_L, width):
    """Mean and std of log k_c by the prior alone, where k_c / width + k_phi is K_L."""
    k_c = width * K_L * np.linspace(0.0, 1.0, 20_002)[1:-1]
    k_phi = K_L - k_c / width
    off = np.log(np.stack([k_c, k_phi])) - np.log(prior_median[:2])[:, None]
    weight = np.exp(-0.5 * ((off[0] / PRIOR) ** 2 + off[1] ** 2)) / (k_c * k_phi)  # uniform in k_c
    mean = np.average(np.log(k_c), weights=weight)
    return mean, np.sqrt(np.average((np.log(k_c) - mean) ** 2, weights=weight))


def test_equal_widths_leave_k_c_at_its_prior(fits):
    # With its own part in K_L, which is known: the share of k_phi has a prior too, if a wide one.
    for prior_median, posterior in fits["alike"]:
        mean, std = known_before(prior_median, posterior.soil.k_phi + posterior.soil.k_c / 0.35, 0.35)
        assert np.sqrt(posterior.log_covariance[0, 0]) == pytest.approx(std, rel=0.08)
        assert std > 0.9 * PRIOR
        assert np.log(posterior.soil.k_c) == pytest.approx(mean, abs=0.25 * PRIOR)  # the mode, not the mean
        # What the tyres do tell is the pressure under themselves.
        own, narrow = (posterior.bearing_pressure(0.1, width) for width in (0.35, 0.10))
        assert own.std / own.value < 0.03
        assert narrow.std / narrow.value > 0.1
