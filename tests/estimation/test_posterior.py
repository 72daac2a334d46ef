"""Priors and propagated uncertainty against Monte Carlo of the log-normal distribution."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from soilbus.estimation.model_form import FormPosterior
from soilbus.estimation.posterior import PARAMETERS, Posterior, SoilPrior
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil

LOAM = SOILS["loam"]
VALUES = dict(zip(PARAMETERS, LOAM, strict=True))


def correlated(size: float, seed: int = 0) -> np.ndarray:
    """A covariance of logarithms with strong correlations and sd of about `size`."""
    root = np.random.default_rng(seed).normal(0.0, size / np.sqrt(6.0), (6, 6))
    return root @ root.T


def draws(posterior: Posterior, n: int) -> np.ndarray:
    logs = np.random.default_rng(1).multivariate_normal(np.log(posterior.soil), posterior.log_covariance, n)
    return np.exp(logs)


@settings(max_examples=25)
@given(value=st.floats(1e-3, 1e6), share=st.floats(0.01, 1.0))
def test_prior_is_log_normal_with_that_median_and_coefficient_of_variation(value, share):
    prior = SoilPrior.from_value_std(dict.fromkeys(PARAMETERS, (value, share * value)))
    assert prior.median == pytest.approx(np.full(6, value))
    n = 200_000
    sample = np.exp(np.log(value) + prior.log_std[0] * np.random.default_rng(2).standard_normal(n))
    assert np.median(sample) == pytest.approx(value, rel=0.01)
    assert sample.std() / sample.mean() == pytest.approx(share, rel=0.05)
    assert prior.free.tolist() == list(range(6))


def test_a_parameter_with_std_zero_is_held():
    given_ = {name: (v, 0.0 if name in ("c", "K") else 0.3 * v) for name, v in VALUES.items()} | {"c": (0.0, 0.0)}
    prior = SoilPrior.from_value_std(given_)
    assert prior.free.tolist() == [0, 1, 2, 3]
    assert prior.log_std[4:].tolist() == [0.0, 0.0]
    assert prior.median[4] == 0.0


def test_what_is_open_has_a_std_that_is_a_number():
    """Of a parameter at its bound, where the variance of its logarithm may be anything."""
    posterior = Posterior(LOAM, np.diag([900.0, 4e3, 0.05, 0.02, 900.0, 0.3]))
    stds = [estimate.std / estimate.value for estimate in posterior.parameters().values()]
    assert np.isfinite([*stds, posterior.tan_phi().std]).all()
    assert 7.0 < stds[0] == stds[1] < 100.0


def test_strength_may_be_known_where_cohesion_and_friction_are_not():
    """On a line of one strength a change of c is made up for by tan phi."""
    pressure, tan = 4e4, np.tan(LOAM.phi)
    by_log_c = np.zeros(6)
    by_log_c[PARAMETERS.index("c")] = 1.0
    by_log_c[PARAMETERS.index("phi")] = -LOAM.c / pressure / (LOAM.phi * (1.0 + tan**2))
    posterior = Posterior(LOAM, 0.5**2 * np.outer(by_log_c, by_log_c))
    of_c = LOAM.c * np.sqrt(np.exp(0.5) - 2.0 * np.exp(0.125) + 1.0)  # root mean square of a log-normal one
    assert posterior.tan_phi().std == pytest.approx(of_c / pressure)
    assert posterior.shear_strength(pressure).value == pytest.approx(LOAM.c + pressure * tan)
    assert posterior.shear_strength(pressure).std < 1e-6 * LOAM.c  # the root of a variance of rounding
    assert posterior.shear_strength(2.0 * pressure).std == pytest.approx(of_c)


@pytest.mark.parametrize("seed", range(4))
def test_bearing_pressure_and_tan_phi_against_monte_carlo(seed):
    soil = list(SOILS.values())[seed * 5]
    posterior = Posterior(soil, correlated(0.03, seed))
    sample = Soil(*draws(posterior, 200_000).T)
    pressure = (sample.k_c / 0.3 + sample.k_phi) * 0.02**sample.n
    bearing = posterior.bearing_pressure(0.02, 0.3)
    assert bearing.value == pytest.approx((soil.k_c / 0.3 + soil.k_phi) * 0.02**soil.n, rel=1e-12)
    assert bearing.std == pytest.approx(pressure.std(), rel=0.03)
    assert posterior.tan_phi().value == pytest.approx(np.tan(soil.phi), rel=1e-12)
    assert posterior.tan_phi().std == pytest.approx(np.tan(sample.phi).std(), rel=0.03)


def test_a_scalar_has_the_std_by_its_gradient():
    posterior = Posterior(LOAM, correlated(0.02, 7))
    weights = np.array([1e-3, 2e-6, 3.0, -4.0, 1e-3, 50.0])
    sample = draws(posterior, 200_000) @ weights
    assert posterior.propagate(weights) == pytest.approx(sample.std(), rel=0.02)
    assert posterior.propagate(np.zeros(6)) == 0.0
    certain = Posterior(LOAM._replace(c=0.0), np.zeros((6, 6)))
    assert certain.propagate(weights) == 0.0
    assert certain.bearing_pressure(0.02, 0.3).std == 0.0


def test_a_variance_below_zero_by_rounding_is_zero():
    covariance = np.diag([1e-4, -1e-20, 0.0, 0.0, 0.0, 0.0])
    assert Posterior(LOAM, covariance).propagate(np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])) == 0.0


def test_an_added_covariance_adds_up_and_never_exceeds_the_prior():
    rng = np.random.default_rng(5)
    prior = SoilPrior(np.ones(6), np.array([0.8, 0.5, 0.0, 0.4, 0.6, 0.3]))
    free = np.flatnonzero(prior.log_std)
    root = rng.standard_normal((5, 5)) * 400.0
    own = np.zeros((6, 6))
    own[np.ix_(free, free)] = np.linalg.inv(root @ root.T + np.diag(prior.log_std[free] ** -2))
    by = rng.standard_normal((6, 2)) * 1e-2
    posterior = Posterior(Soil(*np.ones(6)), own)
    small = posterior.with_added_covariance(by @ by.T, prior).log_covariance
    expected = own + (by @ by.T) * np.outer(prior.log_std > 0.0, prior.log_std > 0.0)
    assert small == pytest.approx(expected, rel=0.02, abs=1e-7)  # the data outweigh the prior by far
    huge = posterior.with_added_covariance(1e6 * by @ by.T, prior).log_covariance
    assert np.all(np.diag(huge) <= prior.log_std**2 * (1.0 + 1e-9))
    assert np.all(np.linalg.eigvalsh(huge - small) > -1e-6)
    unchanged = posterior.with_added_covariance(np.zeros((6, 6)), prior).log_covariance
    assert unchanged == pytest.approx(own, rel=1e-6, abs=1e-12)


def test_a_posterior_over_two_forms_of_the_contact_has_their_mean_and_covariance():
    """Against draws: of the configured form, or as often as the shift of the mean says of Gaussian form parameters."""
    rng = np.random.default_rng(6)
    prior = SoilPrior(np.ones(6), np.array([2.0, 1.5, 0.0, 1.4, 1.6, 1.3]))
    root = 0.05 * rng.standard_normal((6, 6)) * (prior.log_std > 0.0)[:, None]
    by_form = 0.5 * rng.standard_normal((9, 4)) * np.concatenate([prior.log_std > 0.0, np.ones(3)])[:, None]
    spread, mean = 0.1 * rng.standard_normal((4, 4)), np.array([-0.2, 0.1, 0.15, 0.3])
    form = FormPosterior(by_form, mean, spread @ spread.T)
    n, is_open = 400_000, form.log_shift[0] / (by_form[0] @ mean)
    assert 0.0 < is_open < 1.0
    of_form = np.where(rng.random(n) > is_open, 0.0, mean[:, None] + spread @ rng.standard_normal((4, n)))
    drawn = root @ rng.standard_normal((6, n)) + by_form[:6] @ of_form
    found = Posterior(Soil(*np.ones(6)), root @ root.T).with_added_covariance(
        form.log_covariance, prior, form.log_shift
    )
    sd = np.sqrt(np.diag(found.log_covariance))
    assert np.log(found.soil) == pytest.approx(drawn.mean(axis=1), abs=0.01 * sd.max())
    assert found.log_covariance == pytest.approx(np.cov(drawn), abs=0.01 * sd.max() ** 2)


def test_a_shift_never_exceeds_the_prior_sd():
    prior = SoilPrior(np.ones(6), np.array([0.8, 0.5, 0.0, 0.4, 0.6, 0.3]))
    posterior = Posterior(Soil(*np.ones(6)), np.diag(0.01 * prior.log_std**2))
    for side in (-1.0, 1.0):
        far = posterior.with_added_covariance(np.zeros((6, 6)), prior, side * 5.0 * np.ones(6))
        assert np.log(far.soil) == pytest.approx(side * prior.log_std)
