"""Moments along k_c's share in K_L against integrals over all variables and in two limits; coordinates and back."""

from __future__ import annotations

import numpy as np
import pytest

from soilbus.estimation.moments import moments_along_share
from soilbus.estimation.parametrization import Coordinates
from soilbus.terra.soils import SOILS

BOUND_SD = 4.0
"""Prior standard deviations to which a free parameter is confined."""


def problem(share, share_std, prior_std=1.2, miss=0.0, slope=-1.4, other_std=0.05):
    """Quadratic (4, 4) and gradient (4,) at a mode, and one other unknown o, of which o - slope s is measured.

    s is measured with share_std; the prior of log k_c has sd prior_std and its mean at the mode less miss.
    """
    rows = np.array([
        [share / share_std, 0.0, 0.0, 0.0],
        [-slope * share / other_std, 0.0, 0.0, 1.0 / other_std],
        [0.0, 1.0 / prior_std, 0.0, 0.0],
    ])  # fmt: skip
    of_prior = miss / prior_std**2
    return rows.T @ rows, np.array([-of_prior, of_prior, 0.0, 0.0])  # at the mode data and prior balance


def by_grid(quadratic, gradient, share):
    """Mean (2,) of log s and the other under the prior, second moments about it under Jeffreys', on a grid of both."""
    d = np.linspace(-14.0, np.log(0.99 / share), 3001)
    s = share * np.exp(d)
    own = np.stack([np.expm1(d), d, np.log((1.0 - s) / (1.0 - share))])
    centre, sd = -quadratic[3, :3] @ own / quadratic[3, 3], quadratic[3, 3] ** -0.5
    o = np.linspace(centre.min() - 7.0 * sd, centre.max() + 7.0 * sd, 1001)
    along, other = np.broadcast_arrays(d[:, None], o)
    z = np.stack([*np.broadcast_to(own[:, :, None], (3, *along.shape)), other])
    neg2_log = np.einsum("iab,ij,jab->ab", z, quadratic, z, optimize=True) + 2.0 * np.einsum("i,iab->ab", gradient, z)
    weight = np.exp(-0.5 * (neg2_log - neg2_log.min()))
    by_prior = weight / (1.0 - s)[:, None]
    mean = np.array([(along * by_prior).sum(), (other * by_prior).sum()]) / by_prior.sum()
    slopes = np.stack([np.exp(d), np.ones(len(d)), -s / (1.0 - s)])
    of_share = quadratic[:3, :3] - np.outer(quadratic[:3, 3], quadratic[3, :3]) / quadratic[3, 3]
    weight = weight * np.sqrt(np.einsum("ia,ij,ja->a", slopes, of_share, slopes))[:, None]
    off = np.stack([along - mean[0], other - mean[1]])
    return mean, np.einsum("iab,jab,ab->ij", off, off, weight / weight.sum())


@pytest.mark.parametrize("share", [0.01, 0.2])
@pytest.mark.parametrize("miss", [-1.0, 1.0])
def test_moments_equal_the_integrals_over_both_unknowns(share, miss):
    quadratic, gradient = problem(share, 0.08, miss=miss)
    found = moments_along_share(quadratic, gradient, share)
    mean, covariance = by_grid(quadratic, gradient, share)
    std = np.sqrt(np.diag(covariance))
    assert found.mean / std == pytest.approx(mean / std, abs=0.003)
    assert found.covariance / np.outer(std, std) == pytest.approx(covariance / np.outer(std, std), abs=0.003)


def test_a_share_that_the_data_determine_has_mode_and_curvature():
    share = 0.2
    quadratic, gradient = problem(share, 0.002)
    found = moments_along_share(quadratic, gradient, share)
    at = np.zeros((4, 2))
    at[:3, 0], at[3, 1] = (1.0, 1.0, -share / (1.0 - share)), 1.0
    expected = np.linalg.inv(at.T @ quadratic @ at)
    std = np.sqrt(np.diag(expected))
    assert np.abs(found.mean / std).max() < 0.02
    assert found.covariance / np.outer(std, std) == pytest.approx(expected / np.outer(std, std), abs=0.01)


def test_a_share_that_the_data_leave_open_has_the_prior():
    share = 1e-4
    quadratic, gradient = problem(share, 1.0)
    found = moments_along_share(quadratic, gradient, share)
    assert found.mean[0] == pytest.approx(0.0, abs=0.01)
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(1.2, rel=0.01)


def test_there_are_no_moments_where_another_unknown_is_not_determined():
    quadratic, gradient = problem(0.1, 0.05)
    quadratic[3] = quadratic[:, 3] = 0.0
    assert moments_along_share(quadratic, gradient, 0.1) is None


def test_coordinates_and_back(simulated):
    wet_clay = simulated(SOILS["wet_clay"], 50)
    rng = np.random.default_rng(1)
    coordinates = Coordinates(wet_clay.prior, 0.32)
    soil = np.asarray(wet_clay.soil)
    for _ in range(20):
        soil = np.asarray(wet_clay.soil) * np.exp(rng.normal(0.0, 0.3, 6))
        assert coordinates.soil_at(coordinates.position(soil)) == pytest.approx(soil, rel=1e-12)
    directions = coordinates.log_directions(soil)
    for k in range(6):
        h = 1e-6 * np.eye(6)[k]
        up, down = (coordinates.soil_at(coordinates.position(soil) + s * h) for s in (1, -1))
        assert np.log(up / down) / 2e-6 == pytest.approx(directions[:, k], abs=1e-8)
    far = coordinates.stepped(soil, np.full(6, 1e6))
    for _ in range(50):
        far = coordinates.stepped(far, np.full(6, 1e6))
    away = np.abs(np.log(far / wet_clay.prior.median)) / wet_clay.prior.log_std
    assert away.max() < BOUND_SD * (1.0 + 1e-9)
