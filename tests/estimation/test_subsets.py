"""One, five or all of the six soil parameters free, the others held; and what two tyre widths determine of k_c."""

from __future__ import annotations

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


PRIOR = 0.5
"""Sd of the logarithm of k_c; of the others it is wide."""


def test_two_tyre_widths_separate_k_c_from_k_phi(simulated):
    """Eight drives with tyres of 20 cm in front and 50 cm behind."""
    spread = np.array([PRIOR, 1.0, 0.5, 0.4, 0.25, 0.25])
    widths = [f"wheel.{name}.width={width}" for name, width in (("FL", 0.2), ("FR", 0.2), ("RL", 0.5), ("RR", 0.5))]
    away = []
    for seed in range(8):
        median = TRUTH * np.exp(spread * np.random.default_rng([400 + seed, 5]).standard_normal(6))
        problem = simulated(CLAY, 400 + seed, widths).problem()
        posterior = fit_window(problem, SoilPrior(median, spread)).posterior
        std = np.sqrt(np.diag(posterior.log_covariance))
        assert std[0] < 0.12 * PRIOR
        away.append(np.log(np.asarray(posterior.soil) / TRUTH) / std)
    for z in np.transpose(away)[[PARAMETERS.index("k_c"), PARAMETERS.index("k_phi")]]:
        assert np.abs(z).max() < 3.5
        assert 0.86 < (z**2).sum() < 26.2  # chi-square with 8 degrees of freedom: 99.8 %
