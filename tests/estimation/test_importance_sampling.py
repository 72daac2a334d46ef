"""Exact posteriors by importance sampling against the nested average that the service reports."""

from __future__ import annotations

from dataclasses import replace

import minima
import numpy as np
import pytest

from soilbus.estimation.assembly import prior_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.laplace import attainable_variance, counted, profile_over_n, with_nested_laplace
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.parametrization import Coordinates
from soilbus.estimation.posterior import SoilPrior
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Swing
from soilbus.terra.wheel import Soil
from soilbus.validation import importance_sampling as exact
from soilbus.validation.cramer_rao import cramer_rao
from soilbus.validation.importance_sampling import sample_posterior

STILL = Swing(0.0, 1e-9)


@pytest.fixture(scope="module")
def ill_told():
    """A window of constant slip and loads on wet clay."""
    config = reference_configuration([*minima.told("wet_clay"), "soil.k_c.value=43680", "soil.k_c.std=20000"])
    problem = minima.window(config, "wet_clay", 4.0, minima.constant(0.15), True, 5, STILL)
    prior = prior_of(config)
    return problem, prior, Gaussian.of(prior, problem.gain_std), fit_window(problem, prior)


def test_the_average_along_n_has_the_moments_of_the_exact_posterior(ill_told):
    problem, prior, before, fit = ill_told
    found = sample_posterior(problem, prior, before, fit, 500, np.random.default_rng(1))
    assert found.share.sum() == pytest.approx(1.0)
    assert found.effective > 60.0
    whole = with_nested_laplace(problem, prior, before, fit).reported
    along = profile_over_n(problem, prior, before, fit)
    nodes = attainable_variance(along, prior, before)
    u = [node.u for node in along.nodes]
    told = np.array([np.interp(found.logs[:, 2], u, column) for column in nodes.T]).T
    assert told[:, 0].max() > 2.0 * told[:, 0].min()  # k_c is said as its error counts, so this is worth a look
    # Where errors count alike and spread evenly: k_phi is what the bearing capacity and the others leave.
    coordinates = Coordinates(prior, float(problem.rig.width.mean()))
    position = np.array([coordinates.position(soil) for soil in np.exp(found.logs)])
    of_all, of_k_c = counted(found.share, told)
    mean = of_all @ position
    mean[0] = of_k_c @ position[:, 0]
    std = np.sqrt(found.share @ (position - mean) ** 2)
    chance = 3.5 / np.sqrt(found.effective)
    assert np.abs((coordinates.position(whole.soil) - mean) / std).max() < 0.1 + chance
    # The average is never surer; how much less sure where k_c may be next to nothing, is its own choice.
    back = np.linalg.inv(coordinates.log_directions(whole.soil))
    ratio = np.sqrt(np.diag(back @ whole.covariance[:6, :6] @ back.T)) / std
    assert ratio.min() > 1.0 - 0.1 - chance / np.sqrt(2.0)
    assert ratio.max() < 1.5


def test_where_moments_leave_the_share_of_k_c_no_deviation_the_draws_are_by_the_curvature(ill_told, monkeypatch):
    problem, prior, before, fit = ill_told
    along = profile_over_n(problem, prior, before, fit)

    def without_deviation(node):
        """As at a share of k_c next to nothing: its logarithm and that of k_phi go together."""
        covariance = node.fit.gaussian.covariance.copy()
        covariance[0], covariance[:, 0] = covariance[1], covariance[:, 1]
        covariance[0, 0] = covariance[1, 1]
        return node._replace(fit=replace(node.fit, gaussian=replace(node.fit.gaussian, covariance=covariance)))

    flat = along._replace(nodes=[without_deviation(node) for node in along.nodes])
    told = sample_posterior(problem, prior, before, fit, 500, np.random.default_rng(1))
    monkeypatch.setattr(exact, "ridge", lambda *_: flat)
    again = sample_posterior(problem, prior, before, fit, 500, np.random.default_rng(2))
    (mean, std), (other, _) = (moments(found) for found in (told, again))
    chance = 3.5 * np.sqrt(1.0 / told.effective + 1.0 / again.effective)
    assert again.effective > 30.0
    assert np.abs((other - mean) / std).max() < chance


def moments(found):
    mean = found.share @ found.logs
    return mean, np.sqrt(found.share @ (found.logs - mean) ** 2)


def test_each_soil_has_the_bound_of_a_window_on_it(ill_told):
    problem, prior, before, fit = ill_told
    found = sample_posterior(problem, prior, before, fit, 300, np.random.default_rng(1))
    calm = profile_over_n(problem, prior, before, fit).problem
    for i in np.argsort(found.share)[-20:]:
        bound = cramer_rao(calm, prior, Soil(*np.exp(found.logs[i]).tolist())).log_covariance
        std, told = (np.sqrt(each.diagonal()) for each in (bound, found.bound[i]))
        assert told == pytest.approx(std, rel=0.05)
        assert (np.abs(found.bound[i] - bound) <= 0.1 * std[:, None] * std).all()


def test_without_a_ridge_there_are_no_samples(ill_told):
    problem, prior, _, _ = ill_told
    held = SoilPrior(prior.median, np.where(np.arange(6) == 0, 0.0, prior.log_std))
    before, fit = Gaussian.of(held, problem.gain_std), fit_window(problem, held)
    assert sample_posterior(problem, held, before, fit, 10, np.random.default_rng(1)) is None
