"""Evidence of effects of any size, probabilities from evidences, and scores where the effect's absence is blind."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from soilbus.diagnosis.evidence import OwnParameters, mixture_correction, mixture_neg2_log_evidence
from soilbus.diagnosis.verdict import dominated_deficit, is_unexplained, probabilities, required_fall, temperature
from soilbus.estimation.nuisance_parameters import Free, parameters_of
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Parameter

SCALES = tuple(2.0**k for k in range(-4, 3))
"""Of the prior std, all as likely."""
SET_PROBABILITY = 0.02
SIZE = Free("x", Parameter("size", "1", 0.0, 1.0, -9.0, 9.0), None, 0.0, 1.0)
PLACE = Free("x", Parameter("place", "1", 0.5, 1.0, -9.0, 9.0), None, 0.5, 1.0)


@settings(deadline=None, max_examples=25)
@given(st.floats(0.1, 1e4), st.floats(-30.0, 30.0))
def test_the_evidence_is_that_of_a_mixture_of_prior_scales(information, best):
    """Against adaptive integration of the likelihood over each of the priors."""
    pull = information * best / 10.0

    def of(scale: float) -> float:
        sd = (information + 1.0 / scale**2) ** -0.5
        top = sd**2 * pull
        height = pull * top - information * top**2 / 2.0

        def density(u: float) -> float:
            return float(np.exp(pull * u - information * u**2 / 2.0 - height) * norm.pdf(u, 0.0, scale))

        return quad(density, top - 12.0 * sd, top + 12.0 * sd, epsabs=0.0, limit=200)[0] * np.exp(height)

    with np.errstate(over="ignore", invalid="ignore"):
        expected = np.array([of(scale) for scale in SCALES])
    if not np.isfinite(expected).all():
        return
    reported = mixture_neg2_log_evidence(np.array([[information]]), np.array([pull]), [SIZE])
    assert reported == pytest.approx(-2.0 * np.log(expected.mean()), abs=1e-6)


def test_only_parameters_that_say_how_great_an_effect_is_are_scaled():
    information, pull = np.diag([50.0, 50.0]), np.array([5.0, 200.0])
    one = mixture_neg2_log_evidence(information[:1, :1], pull[:1], [SIZE])
    other = np.log(51.0) - 200.0**2 / 51.0
    assert mixture_neg2_log_evidence(information, pull, [SIZE, PLACE]) == pytest.approx(one + other)


def test_a_small_effect_of_many_parameters_pays_less_for_them():
    free = [SIZE] * 8
    covariance = np.eye(8) * 0.02**2
    small, usual = (mixture_correction(np.full(8, size), covariance, free) for size in (0.08, 1.0))
    assert small < -10.0 < usual < 2.0 * np.log(len(SCALES) * (1 + len(free)))  # scales, and cases: all or one alone


@pytest.mark.parametrize("name", ["grade", "soil_drift", "wheel_load_offset", "inertia"])
def test_simpler_cases_of_an_effect_have_their_share_of_the_evidence(name):
    """Against the marginal likelihood of every case of it, with matrices of its own for curves of fewer knots."""
    rng = np.random.default_rng(31)
    free = parameters_of(CATALOGUE[name], 4)
    design = rng.normal(size=(60, len(free)))
    y = rng.normal(size=60) + design @ rng.normal(0.0, 0.3, len(free))

    def marginal(columns: np.ndarray, sized: np.ndarray) -> list[float]:
        cases = [columns * np.where(sized, scale, 1.0) for scale in SCALES]
        return [multivariate_normal.logpdf(y, np.zeros(60), np.eye(60) + c @ c.T) for c in cases]

    likelihoods = [marginal(design @ rows.T, sized) for rows, sized in simpler_by_hand(name)]
    found = logsumexp([logsumexp(each) - np.log(len(SCALES)) for each in likelihoods]) - np.log(len(likelihoods))
    absent = multivariate_normal.logpdf(y, np.zeros(60), np.eye(60))
    reported = mixture_neg2_log_evidence(design.T @ design, design.T @ y, free)
    assert reported == pytest.approx(-2.0 * (found - absent), abs=1e-6)


def simpler_by_hand(name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rows of each case's parameters in all of the effect's, and which have a size."""
    if name == "inertia":
        return [(np.eye(2)[rows], np.ones(len(rows), bool)) for rows in ([0, 1], [0], [1])]
    if name == "wheel_load_offset":  # offsets of four wheels, their drifts, how fast these settle
        wheels = [list(range(12)), *([w, w + 4, w + 8] for w in range(4))]
        return [(np.eye(12)[rows], np.array([i < 8 for i in rows])) for rows in wheels]
    if name == "grade":
        curves = [through(np.arange(0, 16, every), np.arange(1, 16), [0]) for every in (1, 3, 5, 15)]
        return [(block_diag([[1.0]], c), np.ones(1 + len(c), bool)) for c in curves]
    curves = [through(np.arange(0, 9, every), np.arange(1, 8), [0, 8]) for every in (1, 2, 4, 8)]
    return [(block_diag([[1.0]], c, [[1.0]], c), np.ones(2 + 2 * len(c), bool)) for c in curves]


def through(few: np.ndarray, many: np.ndarray, zero: list[int]) -> np.ndarray:
    """Heights at many knots of natural splines that are one at one of a few and zero at the others (free, many)."""
    heights = [np.eye(len(few))[i] for i, knot in enumerate(few.tolist()) if knot not in zero]
    if len(few) == 2:
        return np.array([np.interp(many, few, h) for h in heights]).reshape(-1, len(many))
    return np.array([CubicSpline(few, h, bc_type="natural")(many) for h in heights])


def test_probabilities_are_those_of_the_coarsened_posterior():
    """Against likelihoods to the power zeta; a priori the model is as likely complete as to lack one effect of all."""
    falls, divisor = {"a": 50.0, "b": 44.0, "c": 3.0}, 5.0
    weights = {name: np.exp(fall / (2.0 * divisor)) / len(CATALOGUE) for name, fall in falls.items()}
    expected = {name: weight / (1.0 + sum(weights.values())) for name, weight in weights.items()}
    assert probabilities(falls, divisor) == pytest.approx(expected)
    assert probabilities({"a": required_fall(divisor, 1.0, 3000, 10000)}, divisor)["a"] == pytest.approx(0.5)


def test_the_same_falls_say_less_of_a_model_that_misses_more():
    falls = {"a": 100.0, "b": 70.0}
    little, much = (probabilities(falls, temperature(excess))["a"] for excess in (-50.0, 1e4))
    assert little > 0.99
    assert much < 0.5
    assert required_fall(temperature(0.0), 1.0, 3000, 10000) < 20.0
    assert required_fall(temperature(1e4), 1.0, 3000, 10000) > 60.0


def test_a_candidate_is_dominated_that_cannot_get_into_the_set():
    """Half the deficit may be a penalty for parameters, which the posterior lacks."""
    deficit = dominated_deficit(5.0)
    assert probabilities({"a": 1000.0, "b": 1000.0 - deficit / 2.0}, 5.0)["b"] == pytest.approx(
        SET_PROBABILITY, rel=0.05
    )


def test_every_further_start_is_of_the_catalogue():
    assert {e.name for e in CATALOGUE.values() for p in e.parameters if p.starts} == {
        "draft_offset",
        "drivetrain_loss",
        "wheel_load_offset",
        "hardpan",
        "lugs",
        "stress_peak_shift",
        "tyre_deflection",
    }


def test_a_great_gap_that_is_left_is_not_explained():
    assert is_unexplained(30.0, 8.0, 3000)
    assert not is_unexplained(30.0, 3.0, 3000)
    assert not is_unexplained(1.6, 1.08, 3000)
    assert is_unexplained(1.6, 1.3, 3000)
    assert not is_unexplained(1.2, 1.03, 3000)


def test_values_that_recordings_have_for_themselves_are_charged_but_those_of_one():
    """Against the formula of one Gaussian parameter; a recording has the value or not, each with probability 1/2."""
    divisor, falls = 5.0, {"a": 60.0, "b": 45.0}

    def neg2_log_evidence(h: float, b: float) -> float:
        return float(np.log1p(h) - b**2 / (1.0 + h))

    def charge(h: float, b: float) -> float:
        present = np.exp(-0.5 * neg2_log_evidence(h / divisor, b / divisor))
        return float(-2.0 * np.log(0.5 + 0.5 * present) - neg2_log_evidence(h, b) / divisor)

    readings = [(400.0, 0.0), (400.0, 60.0), (400.0, 150.0)]
    own = [OwnParameters(np.array([[h]]), np.array([b]), (PLACE,)) for h, b in readings]
    charges = sorted(charge(h, b) for h, b in readings)
    charged = {"a": falls["a"] - divisor * sum(charges[:-1]), "b": falls["b"]}
    wanted = probabilities(charged, divisor)
    assert probabilities(falls, divisor, {"a": own}) == pytest.approx(wanted)
    assert probabilities(falls, divisor, {"a": own[::-1]}) == pytest.approx(wanted)
    assert probabilities(falls, divisor, {"a": own[:1]}) == probabilities(falls, divisor)
