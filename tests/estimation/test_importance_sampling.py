"""Posteriors by importance sampling against the nested Laplace approximation that the service reports."""

from __future__ import annotations

import numpy as np
import pytest

from soilbus.estimation.assembly import prior_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.laplace import attainable_variance, error_weights, profile_over_n, with_nested_laplace
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.parametrization import Coordinates
from soilbus.estimation.posterior import SoilPrior
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Swing
from soilbus.terra.wheel import Soil
from tests.lab import local_optima
from tests.lab.cramer_rao import cramer_rao
from tests.lab.importance_sampling import sample_posterior

STILL = Swing(0.0, 1e-9)


@pytest.fixture(scope="module")
def uncertain():
    """A window of constant slip and loads on wet clay, which determines k_c and n badly."""
    config = reference_configuration(
        [*local_optima.c_and_K_known("wet_clay"), "soil.k_c.value=43680", "soil.k_c.std=20000"]
    )
    problem = local_optima.window(config, "wet_clay", 4.0, local_optima.constant(0.15), True, 5, STILL)
    prior = prior_of(config)
    return problem, prior, Gaussian.of(prior, problem.gain_std), fit_window(problem, prior)


def test_the_average_along_n_has_the_moments_of_the_sampled_posterior(uncertain):
    problem, prior, joint_prior, fit = uncertain
    found = sample_posterior(problem, prior, joint_prior, fit, 1500, np.random.default_rng(1))
    assert found.share.sum() == pytest.approx(1.0)
    assert found.effective > 60.0
    reported = with_nested_laplace(problem, prior, joint_prior, fit).reported
    along = profile_over_n(problem, prior, joint_prior, fit)
    of_nodes = attainable_variance(along, prior, joint_prior)
    u = [node.u for node in along.nodes]
    attainable = np.array([np.interp(found.logs[:, 2], u, column) for column in of_nodes.T]).T
    assert attainable[:, 0].max() > 2.0 * attainable[:, 0].min()  # the weights of errors matter
    # In coordinates, where k_phi is replaced by the bearing pressure.
    coordinates = Coordinates(prior, float(problem.rig.width.mean()))
    position = np.array([coordinates.position(soil) for soil in np.exp(found.logs)])
    of_all, of_k_c = error_weights(found.share, attainable)
    mean = of_all @ position
    mean[0] = of_k_c @ position[:, 0]
    std = np.sqrt(found.share @ (position - mean) ** 2)
    chance = 3.5 / np.sqrt(found.effective)
    assert np.abs((coordinates.position(reported.soil) - mean) / std).max() < 0.1 + chance
    # The average is never more certain; where k_c may be close to zero it is less certain by design.
    back = np.linalg.inv(coordinates.log_directions(reported.soil))
    ratio = np.sqrt(np.diag(back @ reported.covariance[:6, :6] @ back.T)) / std
    assert ratio.min() > 1.0 - 0.1 - chance / np.sqrt(2.0)
    assert ratio.max() < 1.5


def moments(found):
    mean = found.share @ found.logs
    return mean, np.sqrt(found.share @ (found.logs - mean) ** 2)


def test_each_sample_has_the_cramer_rao_bound_of_a_window_on_its_soil(uncertain):
    problem, prior, joint_prior, fit = uncertain
    found = sample_posterior(problem, prior, joint_prior, fit, 300, np.random.default_rng(1))
    denoised = profile_over_n(problem, prior, joint_prior, fit).problem
    for i in np.argsort(found.share)[-20:]:
        bound = cramer_rao(denoised, prior, Soil(*np.exp(found.logs[i]).tolist())).log_covariance
        std, found_std = (np.sqrt(each.diagonal()) for each in (bound, found.bound[i]))
        assert found_std == pytest.approx(std, rel=0.05)
        assert (np.abs(found.bound[i] - bound) <= 0.1 * std[:, None] * std).all()


def test_with_k_c_held_there_are_no_samples(uncertain):
    problem, prior, _, _ = uncertain
    held = SoilPrior(prior.median, np.where(np.arange(6) == 0, 0.0, prior.log_std))
    joint_prior, fit = Gaussian.of(held, problem.gain_std), fit_window(problem, held)
    assert sample_posterior(problem, held, joint_prior, fit, 10, np.random.default_rng(1)) is None
