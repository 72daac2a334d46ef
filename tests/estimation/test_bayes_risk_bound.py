"""The Bayes-risk bound against brute force, and against estimators by powers of the bound."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from tests.lab.bayes_risk_bound import bayes_risk

WEIGHT_POWERS = (-1.0, 0.0, 1.0, 2.0)
"""Powers of the weights that a bound is the greatest of."""

GRID = np.linspace(-3.0, 3.0, 601)
NOISE = 0.4
BOUND = NOISE / np.sqrt((1.2 * GRID**2 + 0.1) ** 2 + NOISE**2)
"""Cramér-Rao sd of x, of which a cubic is measured with noise and x itself with sd 1: large at the flat middle."""


def cubic(soil):
    return 0.4 * soil**3 + 0.1 * soil


def posterior(of_cubic, of_soil):
    """Probabilities (R, grid) under a flat prior, by measurements (R,) of the cubic and of the soil itself."""
    likelihood = norm.pdf(of_cubic[:, None], cubic(GRID), NOISE) * norm.pdf(of_soil[:, None], GRID, 1.0)
    return likelihood / likelihood.sum(axis=1, keepdims=True)


def windows(truth, n, rng):
    return posterior(cubic(truth) + NOISE * rng.standard_normal(n), truth + rng.standard_normal(n))


def test_no_estimate_has_a_smaller_weighted_loss_than_the_risk():
    rng = np.random.default_rng(1)
    share = rng.dirichlet(np.ones(5000))
    value, bound = rng.standard_normal((5000, 2)), rng.uniform(0.1, 0.8, (5000, 2))
    found = bayes_risk(value, share, bound, np.zeros(2))
    for i, tilt in enumerate(WEIGHT_POWERS):
        for q in range(2):
            counted = share * bound[:, q] ** (-2.0 - tilt)
            loss = minimize_scalar(lambda x, q=q, counted=counted: counted @ (value[:, q] - x) ** 2)
            assert loss.fun < found.risk[i, q] < 1.01 * loss.fun  # the sample's own mean is allowed for
            assert found.weight[i, q] == pytest.approx((share * bound[:, q] ** -tilt).sum())
            if tilt == 0.0:
                assert found.error[q] == pytest.approx(loss.x, abs=1e-6)
    assert found.effective == pytest.approx(1.0 / (share**2).sum())


def test_the_risk_of_few_samples_is_unbiased():
    rng = np.random.default_rng(2)
    (share,) = windows(1.0, 1, rng)
    (risk,) = bayes_risk(GRID[:, None], share, BOUND[:, None], np.zeros(1)).risk[WEIGHT_POWERS.index(0.0)]
    of_few = []
    for _ in range(400):
        drawn = rng.choice(len(GRID), 40, p=share)
        found = bayes_risk(GRID[drawn, None], np.full(40, 1 / 40), BOUND[drawn, None], np.zeros(1))
        of_few.append(found.risk[WEIGHT_POWERS.index(0.0), 0])
    assert np.mean(of_few) == pytest.approx(risk, abs=4.0 * np.std(of_few) / 20.0)


def test_a_held_quantity_has_no_error_and_no_risk():
    value = np.column_stack([np.linspace(-1.0, 1.0, 9), np.full(9, 0.3)])
    bound = np.column_stack([np.full(9, 0.5), np.zeros(9)])
    found = bayes_risk(value, np.full(9, 1 / 9), bound, np.array([0.0, 0.3]))
    assert found.error == pytest.approx(np.zeros(2))
    assert found.risk[:, 1] == pytest.approx(np.zeros(len(WEIGHT_POWERS)))
    assert (found.risk[:, 0] > 0.0).all()


@pytest.mark.parametrize("power", [-2.0, 0.0, 1.0, 2.0, 3.0, 4.0])
def test_every_estimator_exceeds_the_bound_on_some_soil(power):
    # Posterior means weighted by a power of the bound; soils are uniform.
    rng = np.random.default_rng(3)
    soils = np.linspace(-1.5, 1.5, 31)
    risk, weight, error = [], [], []
    for soil in soils:
        shares = windows(soil, 300, rng)
        each = [bayes_risk(GRID[:, None], share, BOUND[:, None], np.array([soil])) for share in shares]
        risk.append(np.sum([a.risk for a in each], axis=0)[:, 0])
        weight.append(np.sum([a.weight for a in each], axis=0)[:, 0])
        counted = shares * BOUND**-power
        own = (counted @ GRID) / counted.sum(axis=1) - soil
        error.append(np.sqrt(np.mean((own / np.interp(soil, GRID, BOUND)) ** 2)))
    least = np.sqrt((np.sum(risk, axis=0) / np.sum(weight, axis=0)).max())
    assert least > 1.1  # the Cramér-Rao bound of one soil is too small here
    assert max(error) > least


def test_with_one_bound_for_all_soils_the_bound_is_attained():
    rng = np.random.default_rng(4)
    value = 0.3 * rng.standard_normal((100_000, 1))
    found = bayes_risk(value, np.full(100_000, 1e-5), np.full((100_000, 1), 0.3), np.zeros(1))
    assert np.sqrt(found.risk / found.weight) == pytest.approx(np.ones((len(WEIGHT_POWERS), 1)), rel=0.01)
