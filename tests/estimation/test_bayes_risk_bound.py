"""The least error of any estimate against brute force, and against estimates that try to do better."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from soilbus.validation.bayes_risk_bound import WEIGHT_POWERS, bayes_risk

GRID = np.linspace(-3.0, 3.0, 601)
NOISE = 0.4
BOUND = NOISE / np.sqrt((1.2 * GRID**2 + 0.1) ** 2 + NOISE**2)
"""Of a cubic that is read with noise and known to a std of one besides: flat in the middle."""


def read(soil):
    return 0.4 * soil**3 + 0.1 * soil


def posterior(reading, told):
    """Shares of the grid, whatever is the true one, by a reading (R,) and what was told of it (R,)."""
    likelihood = norm.pdf(reading[:, None], read(GRID), NOISE) * norm.pdf(told[:, None], GRID, 1.0)
    return likelihood / likelihood.sum(axis=1, keepdims=True)


def windows(truth, n, rng):
    return posterior(read(truth) + NOISE * rng.standard_normal(n), truth + rng.standard_normal(n))


def test_no_choice_has_a_smaller_mean_than_the_one_told():
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


def test_few_samples_tell_the_same_on_average():
    rng = np.random.default_rng(2)
    (share,) = windows(1.0, 1, rng)
    (risk,) = bayes_risk(GRID[:, None], share, BOUND[:, None], np.zeros(1)).risk[WEIGHT_POWERS.index(0.0)]
    of_few = []
    for _ in range(400):
        drawn = rng.choice(len(GRID), 40, p=share)
        found = bayes_risk(GRID[drawn, None], np.full(40, 1 / 40), BOUND[drawn, None], np.zeros(1))
        of_few.append(found.risk[WEIGHT_POWERS.index(0.0), 0])
    assert np.mean(of_few) == pytest.approx(risk, abs=4.0 * np.std(of_few) / 20.0)


def test_what_is_held_has_no_error_and_no_risk():
    value = np.column_stack([np.linspace(-1.0, 1.0, 9), np.full(9, 0.3)])
    bound = np.column_stack([np.full(9, 0.5), np.zeros(9)])
    found = bayes_risk(value, np.full(9, 1 / 9), bound, np.array([0.0, 0.3]))
    assert found.error == pytest.approx(np.zeros(2))
    assert found.risk[:, 1] == pytest.approx(np.zeros(len(WEIGHT_POWERS)))
    assert (found.risk[:, 0] > 0.0).all()


@pytest.mark.parametrize("power", [-2.0, 0.0, 1.0, 2.0, 3.0, 4.0])
def test_every_estimate_is_worse_than_that_on_some_soil(power):
    # Means of the posterior by any power of the bound; soils as the windows allow them: uniform.
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
    assert least > 1.1  # the bound of a soil alone is too small here
    assert max(error) > least


def test_where_all_soils_are_told_alike_the_bound_is_what_is_attained():
    rng = np.random.default_rng(4)
    value = 0.3 * rng.standard_normal((100_000, 1))
    found = bayes_risk(value, np.full(100_000, 1e-5), np.full((100_000, 1), 0.3), np.zeros(1))
    assert np.sqrt(found.risk / found.weight) == pytest.approx(np.ones((len(WEIGHT_POWERS), 1)), rel=0.01)
