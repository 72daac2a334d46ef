"""Moments along the share of k_c in K_L against integrals over all variables, and where they are known."""

from __future__ import annotations

import numpy as np
import pytest

from soilbus.estimation.parametrization import moments_along_share


def problem(share, share_std, prior_std=1.2, miss=0.0, slope=-1.4, other_std=0.05):
    """Quadratic (4, 4) and gradient (4,) at a mode, with one other o that is measured less slope times s.

    s is measured with this std; log k_c was known within prior_std before, about the mode times exp(-miss).
    """
    rows = np.array([
        [share / share_std, 0.0, 0.0, 0.0],
        [-slope * share / other_std, 0.0, 0.0, 1.0 / other_std],
        [0.0, 1.0 / prior_std, 0.0, 0.0],
    ])  # fmt: skip
    pull = miss / prior_std**2
    return rows.T @ rows, np.array([-pull, pull, 0.0, 0.0])  # the data are in balance with what was known


def by_grid(quadratic, gradient, share):
    """Mean (2,) of log s and the other as the prior counts, Jeffreys' second moments about it, on a grid of both."""
    d = np.linspace(-14.0, np.log(0.99 / share), 3001)
    s = share * np.exp(d)
    own = np.stack([np.expm1(d), d, np.log((1.0 - s) / (1.0 - share))])
    centre, sd = -quadratic[3, :3] @ own / quadratic[3, 3], quadratic[3, 3] ** -0.5
    o = np.linspace(centre.min() - 7.0 * sd, centre.max() + 7.0 * sd, 1001)
    along, other = np.broadcast_arrays(d[:, None], o)
    z = np.stack([*np.broadcast_to(own[:, :, None], (3, *along.shape)), other])
    cost = np.einsum("iab,ij,jab->ab", z, quadratic, z, optimize=True) + 2.0 * np.einsum("i,iab->ab", gradient, z)
    weight = np.exp(-0.5 * (cost - cost.min()))
    by_prior = weight / (1.0 - s)[:, None]
    mean = np.array([(along * by_prior).sum(), (other * by_prior).sum()]) / by_prior.sum()
    slopes = np.stack([np.exp(d), np.ones(len(d)), -s / (1.0 - s)])
    known = quadratic[:3, :3] - np.outer(quadratic[:3, 3], quadratic[3, :3]) / quadratic[3, 3]
    weight = weight * np.sqrt(np.einsum("ia,ij,ja->a", slopes, known, slopes))[:, None]
    off = np.stack([along - mean[0], other - mean[1]])
    return mean, np.einsum("iab,jab,ab->ij", off, off, weight / weight.sum())


@pytest.mark.parametrize("share", [0.01, 0.2])
@pytest.mark.parametrize("miss", [-1.0, 1.0])
def test_moments_are_the_integrals(share, miss):
    quadratic, gradient = problem(share, 0.08, miss=miss)
    found = moments_along_share(quadratic, gradient, share)
    mean, covariance = by_grid(quadratic, gradient, share)
    std = np.sqrt(np.diag(covariance))
    assert found.mean / std == pytest.approx(mean / std, abs=0.003)
    assert found.covariance / np.outer(std, std) == pytest.approx(covariance / np.outer(std, std), abs=0.003)


def test_a_share_told_well_leaves_the_mode_and_its_curvature():
    share = 0.2
    quadratic, gradient = problem(share, 0.002)
    found = moments_along_share(quadratic, gradient, share)
    at = np.zeros((4, 2))
    at[:3, 0], at[3, 1] = (1.0, 1.0, -share / (1.0 - share)), 1.0
    expected = np.linalg.inv(at.T @ quadratic @ at)
    std = np.sqrt(np.diag(expected))
    assert np.abs(found.mean / std).max() < 0.02
    assert found.covariance / np.outer(std, std) == pytest.approx(expected / np.outer(std, std), abs=0.01)


def test_a_share_not_told_is_as_known_before():
    share = 1e-4
    quadratic, gradient = problem(share, 1.0)
    found = moments_along_share(quadratic, gradient, share)
    assert found.mean[0] == pytest.approx(0.0, abs=0.01)
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(1.2, rel=0.01)


def test_others_that_nothing_tells_have_no_moments():
    quadratic, gradient = problem(0.1, 0.05)
    quadratic[3] = quadratic[:, 3] = 0.0
    assert moments_along_share(quadratic, gradient, 0.1) is None
