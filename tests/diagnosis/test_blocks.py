"""Scores of blocks against exact leave-one-out of a linear Gaussian model, and what a linear effect changes."""

from types import SimpleNamespace

import numpy as np
import pytest

from soilbus.diagnosis.blocks import Part, block_scores, expected_change
from soilbus.estimation.gaussian import Gaussian

SOIL = 6


def linear(rng: np.random.Generator, blocks: int, rows: int, effects: int):
    """Rows (R, 1 + 6 + G) of a linear model with unit noise, block of each row; derivatives of a residual."""
    parameters = SOIL + effects
    J = rng.normal(size=(blocks * rows, parameters))
    r = rng.normal(size=blocks * rows)
    return np.column_stack([r, J]), np.repeat(np.arange(blocks), rows)


def part_of(rows, block, members):
    at = SimpleNamespace(rows=rows[members], weighed=rows[members])
    return Part(
        np.ones(SOIL), np.zeros(rows.shape[1] - 1 - SOIL), at, block[members], np.ones((members.sum(), 1), bool)
    )


def test_each_block_is_predicted_from_all_others_as_by_a_fit_to_these():
    rng = np.random.default_rng(1)
    rows, block = linear(rng, 5, 8, 2)
    std = np.full(rows.shape[1] - 1, 0.7)
    prior = Gaussian(np.ones(SOIL), np.zeros(2), np.diag(std**2))
    parts = part_of(rows, block, block < 3), part_of(rows, block, block >= 3)
    found = block_scores([parts], [prior], [prior], np.zeros(2, bool), 0)
    for b in range(5):
        J, r = rows[block != b][:, 1:], rows[block != b][:, 0]
        covariance = np.linalg.inv(J.T @ J + np.diag(std**-2.0))
        mean = -covariance @ J.T @ r
        own = rows[block == b]
        predicted = np.eye(len(own)) + own[:, 1:] @ covariance @ own[:, 1:].T
        left = own[:, 0] + own[:, 1:] @ mean
        chi2 = left @ np.linalg.solve(predicted, left)
        assert found.chi2[b] == pytest.approx(chi2)
        assert found.neg2_log[b] == pytest.approx(chi2 + np.linalg.slogdet(predicted)[1])
        assert found.rows[b] == 8


def test_recordings_share_gains_and_have_a_soil_each():
    rng = np.random.default_rng(2)
    (one, block), (two, _) = linear(rng, 4, 6, 2), linear(rng, 4, 6, 2)
    first = block < 2
    half = Gaussian(np.ones(SOIL), np.zeros(2), np.diag([1.0] * SOIL + [2.0, 2.0]))  # of two recordings
    given = (
        [(part_of(rows, block, first), part_of(rows, block, ~first)) for rows in (one, two)],
        [half, half],
        [half, half],
    )
    found = block_scores(*given, np.zeros(2, bool), 0)
    J = np.zeros((48, 2 * SOIL + 2))
    J[:24, :SOIL], J[24:, SOIL : 2 * SOIL] = one[:, 1 : 1 + SOIL], two[:, 1 : 1 + SOIL]
    J[:, 2 * SOIL :] = np.vstack([one, two])[:, 1 + SOIL :]
    r, number = np.concatenate([one[:, 0], two[:, 0]]), np.concatenate([block, block + 4])
    for b in range(8):
        others, own = number != b, number == b
        covariance = np.linalg.inv(J[others].T @ J[others] + np.eye(J.shape[1]))
        left = r[own] - J[own] @ covariance @ J[others].T @ r[others]
        predicted = np.eye(6) + J[own] @ covariance @ J[own].T
        assert found.chi2[b] == pytest.approx(left @ np.linalg.solve(predicted, left))


def test_each_gain_is_predicted_from_the_data_and_the_other_gains():
    """A hundredth of its prior stays, so that one is determined which no data show."""
    rng = np.random.default_rng(3)
    rows, block = linear(rng, 4, 8, 2)
    precision = np.array([2.0] * SOIL + [5.0, 0.5])
    prior = Gaussian(np.ones(SOIL), np.array([0.3, -0.2]), np.diag(1.0 / precision))
    parts = part_of(rows, block, block < 2), part_of(rows, block, block >= 2)
    found = block_scores([parts], [prior], [prior], np.zeros(2, bool), 2)
    J, r = rows[:, 1:], rows[:, 0]
    start = np.append(np.zeros(SOIL), prior.gains)
    for k, of_prior in enumerate(precision[SOIL:]):
        weaker = precision.copy()
        weaker[SOIL + k] *= 0.01
        covariance = np.linalg.inv(J.T @ J + np.diag(weaker))
        off = (covariance @ (weaker * start - J.T @ r) - start)[SOIL + k]
        variance, own = 1.0 / (0.99 * of_prior), covariance[SOIL + k, SOIL + k]
        assert found.neg2_log[k] == pytest.approx(off**2 / (variance + own) + np.log1p(own / variance))
    assert found.rows.tolist() == [0.0] * 2 + [8.0] * 4


def test_the_score_of_a_single_block_is_its_evidence():
    rng = np.random.default_rng(4)
    rows, block = linear(rng, 1, 20, 1)
    prior = Gaussian(np.ones(SOIL), np.zeros(1), np.diag([0.5] * SOIL + [3.0]))
    first = np.arange(20) < 12
    found = block_scores(
        [(part_of(rows, block, first), part_of(rows, block, ~first))], [prior], [prior], np.zeros(1, bool), 0
    )
    covariance = np.eye(20) + rows[:, 1:] @ prior.covariance @ rows[:, 1:].T
    evidence = rows[:, 0] @ np.linalg.solve(covariance, rows[:, 0]) + np.linalg.slogdet(covariance)[1]
    assert found.neg2_log == pytest.approx([evidence])


def test_an_absent_effect_is_expected_to_cost_what_its_parameters_learn_of_noise():
    rng = np.random.default_rng(3)
    J = rng.normal(size=(400, 3))
    H = J.T @ J
    changes = [expected_change(H, J.T @ rng.normal(size=400)) for _ in range(2000)]
    assert np.mean(changes) == pytest.approx(3.0, abs=0.2)  # twice 3 parameters less the 3 of noise that they fit
    assert expected_change(H, H @ np.array([0.5, 0.0, 0.0])) < -60.0
    assert expected_change(np.zeros((2, 2)), np.zeros(2)) == 0.0
