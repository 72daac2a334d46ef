"""The peers do what their papers claim where their assumptions hold; on noisy windows ours beats them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.integrate import quad

from soilbus.estimation.multistart import fit_window
from soilbus.estimation.posterior import PARAMETERS, Estimate
from soilbus.terra.soils import SOILS
from tests.lab.peers import finite_differences, kalman, linear, newton_raphson, ours
from tests.lab.peers.compare import compared, comparison, ours_is_ahead, verdict
from tests.lab.peers.roster import OURS, Entry, roster
from tests.lab.peers.scores import Duel, Score, duel, truth
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
    return [entry for entry in roster() if entry.method is not finite_differences.estimate]


@pytest.fixture(scope="module")
def scores(entries):
    return compared(entries, NAMES, windows=2, seed=0, step=lambda: None)


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
    mine, its = fit_window(case.problem, case.prior).mode.posterior, finite_differences.fit(case)
    std = np.sqrt(np.diag(its.log_covariance))
    assert np.abs(np.log(np.asarray(mine.soil) / np.asarray(its.soil)) / std).max() < 0.02
    scaled = (mine.log_covariance - its.log_covariance) / np.outer(std, std)
    assert np.abs(scaled).max() < 0.05


@pytest.mark.parametrize("name", NAMES)
def test_ours_recovers_the_truth_from_exact_readings(name, quiet):
    # Unknown gains and the prior leave room, so in its own standard deviations.
    case = quiet[name].knowing(("c", "K"))
    answer = ours.estimate(case)
    for quantity in ("bearing", "phi", "n"):
        assert abs(answer[quantity].value - truth(case.soil, quantity)) < answer[quantity].std


def rms(scores, entry, quantity) -> float:
    """Over the windows of all soils; a failure counts as being off by everything."""
    return float(np.sqrt(np.mean(np.nan_to_num(scores[entry].errors(quantity), nan=1.0) ** 2)))


def test_ours_is_closer_than_every_peer_on_noisy_windows(scores, entries):
    # All soils together.
    mine = {e.exact: e for e in entries if e.name == OURS}
    compared_ = 0
    for peer in entries:
        if peer.name == OURS:
            continue
        for quantity in scores[peer].quantities:
            assert rms(scores, mine[peer.exact], quantity) < rms(scores, peer, quantity), (peer, quantity)
            compared_ += 1
    assert compared_ == 2 * 2 + 2 * 3 + 2 * 3


def test_ours_never_fails_and_covers_the_truth(scores, entries):
    plain = next(e for e in entries if e.name == OURS and not e.exact)
    assert scores[plain].failure_rate == 0.0
    covered = [scores[plain].coverage(q) for q in ("bearing", "phi", "n", "c", "K")]
    assert np.mean(covered) > 0.8  # 30 intervals of six windows


def answers_of(*values: float, std: float = np.nan) -> list:
    return [{"phi": Estimate(v * LOAM.phi, std * LOAM.phi)} for v in values]


LOAM = SOILS["loam"]


def score_of(answers: list, seconds: float) -> Score:
    return Score([LOAM] * len(answers), answers, [seconds] * len(answers))


def test_a_peer_that_is_closer_is_said_to_be():
    off_by = np.linspace(0.05, 0.10, 12)
    good, bad = score_of(answers_of(*(1.0 + off_by / 2.0)), 0.001), score_of(answers_of(*(1.0 - off_by)), 0.002)
    won = duel(good, bad, "phi")
    assert (won.closer, won.closer_in, won.windows) == ("peer", 12, 12)
    assert won.peer == pytest.approx(won.ours / 2.0)
    assert duel(bad, good, "phi").closer == "ours"
    one = duel(score_of([*answers_of(1.0), *[None] * 11], 0.001), bad, "phi")
    assert (one.closer_in, one.windows) == (1, 12)
    mine, peer = Entry(OURS, ours.estimate), Entry("a peer", ours.estimate, note="something")
    assert verdict({mine: bad, peer: good}).startswith("Of 1 comparisons ours is closer in 0, a peer in 1;")
    assert "3.8 / 3.7 peer" in comparison({mine: bad, peer: good})
    assert "7.7 / 7.5 ours" in comparison({mine: good, peer: bad})
    failing = score_of([*answers_of(*(1.0 + off_by[1:] / 2.0)), None], 0.001)
    ahead = [ours_is_ahead({mine: m, peer: p}) for m, p in ((bad, good), (good, bad), (failing, bad), (good, good))]
    assert ahead == [False, True, False, False]


@pytest.mark.parametrize(
    ("peer", "mine", "closer_in", "windows", "closer"),
    [
        (1.0, 1.01, 12, 12, "alike"), (1.0, 2.0, 6, 6, "peer"), (2.0, 1.0, 0, 6, "ours"),
        (1.0, 2.0, 5, 5, "open"), (1.0, 2.0, 10, 20, "open"), (1.0, 2.0, 0, 20, "open"),
    ],
)  # fmt: skip
def test_only_what_windows_confirm_is_decided(peer, mine, closer_in, windows, closer):
    assert Duel(peer, mine, closer_in, windows).closer == closer
