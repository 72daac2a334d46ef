"""The peers do what their papers claim where their assumptions hold; on noisy windows ours beats them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.integrate import quad

from soilbus.estimation.multistart import fit_window
from soilbus.estimation.posterior import PARAMETERS, Estimate
from soilbus.terra.soils import SOILS
from soilbus.trials.bench.window import by_finite_differences
from tests.lab.peers import kalman, linear, newton_raphson
from tests.lab.peers.compare import Score, compared, comparison, duels, ours_is_ahead, truth
from tests.lab.peers.roster import OURS, Entry, least_squares, ours, roster
from tests.lab.peers.windows import simulated_case

NAMES = ("loam", "wet_clay", "dry_sand")
ALL_BUT_PHI_AND_N = ("k_c", "k_phi", "c", "K")


def off(answer, soil) -> dict[str, float]:
    """Relative error of each estimate."""
    return {name: e.value / truth(soil, name) - 1.0 for name, e in answer.items()}


@pytest.fixture(scope="module")
def quiet():
    """Windows without noise."""
    return {name: simulated_case(SOILS[name], 5, noise_free=True) for name in NAMES}


@pytest.fixture(scope="module")
def entries():
    """The roster without those that have tests of their own: least_squares (slow, our optimum)."""
    return [entry for entry in roster() if entry.method is not least_squares]


@pytest.fixture(scope="module")
def scores(entries):
    return compared(entries, NAMES, windows=2, seed=0)


def test_linear_recovers_c_and_phi_from_triangular_stresses():
    c, phi, K, radius, width = 3000.0, 0.45, 0.02, 0.5, 0.26
    angle, slip = np.array([[0.35], [0.45], [0.5]]), np.array([[0.1], [0.3], [0.5]])
    peak = np.array([[60e3], [110e3], [90e3]])
    middle = angle / 2.0
    moved = radius * (angle - middle - (1.0 - slip) * (np.sin(angle) - np.sin(middle)))
    shear = (c + peak * np.tan(phi)) * (1.0 - np.exp(-moved / K))

    def over_rim(height, trig, end):
        def stress(x):
            return height * (1.0 - abs(x - end / 2.0) / (end / 2.0)) * trig(x)

        return quad(stress, 0.0, end / 2.0)[0] + quad(stress, end / 2.0, end)[0]

    triangles = zip(peak[:, 0], shear[:, 0], angle[:, 0], strict=True)
    load = [radius * width * (over_rim(p, np.cos, a) + over_rim(s, np.sin, a)) for p, s, a in triangles]
    torque = radius**2 * width * shear * angle / 2.0
    answer = linear.solve(np.array(load)[:, None], torque, angle, slip, radius, width, K)
    assert answer["c"].value == pytest.approx(c, rel=1e-6)
    assert answer["phi"].value == pytest.approx(phi, rel=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_newton_raphson_and_the_filter_recover_the_truth_from_exact_readings(name, quiet):
    told_c_n = newton_raphson.estimate(quiet[name].knowing(("c", "n")))
    filtered = kalman.estimate(quiet[name].knowing(ALL_BUT_PHI_AND_N))
    assert set(told_c_n) == {"phi", "K", "bearing"}
    for answer in (told_c_n, filtered):
        assert max(map(abs, off(answer, SOILS[name]).values())) < 1e-3


def test_newton_raphson_fails_from_a_poor_start(quiet, monkeypatch):
    # The limitation that the paper's Table 1 names.
    case = quiet["loam"].knowing(("c", "n"))
    case.prior.median[PARAMETERS.index("K")] = 3.0
    assert newton_raphson.estimate(case) is None


def test_the_filter_is_robust_to_a_wild_reading():
    case = simulated_case(SOILS["loam"], 6).knowing(ALL_BUT_PHI_AND_N)
    before = kalman.estimate(case)
    case.problem.torque[60] *= 1.5
    after = kalman.estimate(case)
    for name in ("phi", "n"):
        assert after[name].value == pytest.approx(before[name].value, rel=0.01)


def test_least_squares_finds_our_optimum_and_our_covariance():
    # A check of our derivatives, weights and steps as much as of the peer.
    whole = simulated_case(SOILS["wet_clay"], 7)
    case = dataclasses.replace(whole, problem=whole.problem.thinned(20))
    mine, its = fit_window(case.problem, case.prior).mode.posterior, by_finite_differences(case.problem, case.prior)
    std = np.sqrt(np.diag(its.log_covariance))
    assert np.abs(np.log(np.asarray(mine.soil) / np.asarray(its.soil)) / std).max() < 0.02
    scaled = (mine.log_covariance - its.log_covariance) / np.outer(std, std)
    assert np.abs(scaled).max() < 0.05


@pytest.mark.parametrize("name", NAMES)
def test_ours_recovers_the_truth_from_exact_readings(name, quiet):
    # Unknown gains and the prior leave room, so in its own standard deviations.
    case = quiet[name].knowing(("c", "K"))
    answer = ours(case)
    for quantity in ("bearing", "phi", "n"):
        assert abs(answer[quantity].value - truth(case.soil, quantity)) < answer[quantity].std


def test_ours_is_closer_than_every_peer_on_noisy_windows(scores, entries):
    # All soils together.
    found = list(duels(scores))
    assert [(peer.name, quantity) for peer, quantity, ours_is_closer in found if not ours_is_closer] == []
    assert len(found) == 2 * 2 + 2 * 3 + 2 * 3
    assert ours_is_ahead(scores)
    assert len(comparison(scores).splitlines()) >= len(entries)


def test_ours_never_fails_and_covers_the_truth(scores, entries):
    plain = next(e for e in entries if e.name == OURS and not e.exact)
    assert scores[plain].failure_rate == 0.0
    covered = [scores[plain].coverage(q) for q in ("bearing", "phi", "n", "c", "K")]
    assert np.mean(covered) > 0.8  # 30 intervals of six windows


def test_a_peer_that_is_closer_or_a_failure_of_ours_is_said_to_be():
    soil, off_by = SOILS["loam"], np.linspace(0.05, 0.10, 12)

    def score_of(values) -> Score:
        answers = [None if np.isnan(v) else {"phi": Estimate(v * soil.phi, np.nan)} for v in values]
        return Score([soil] * len(answers), answers, [0.001] * len(answers))

    good, bad, failing = (score_of(v) for v in (1.0 + off_by / 2.0, 1.0 - off_by, [*(1.0 + off_by[1:] / 9.0), np.nan]))
    assert good.rms("phi") == pytest.approx(bad.rms("phi") / 2.0)
    mine, peer = Entry(OURS, ours), Entry("a peer", ours, note="something")
    ahead = [ours_is_ahead({mine: m, peer: p}) for m, p in ((bad, good), (good, bad), (failing, bad), (good, good))]
    assert ahead == [False, True, False, False]
