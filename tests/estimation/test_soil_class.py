"""Soil classes: probabilities against Bayes by sampling, on exact Gaussians and on simulated windows."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reliability import WIDE_COHESION, Said, driven, shortfall, windows

from soilbus.estimation.assembly import prior_of
from soilbus.estimation.multistart import clip_to_prior, fit_window
from soilbus.estimation.parametrization import Coordinates
from soilbus.estimation.posterior import PARAMETERS, Posterior, SoilPrior
from soilbus.estimation.soil_classes import PRIOR_UNKNOWN, WITHIN_CLASS_SD, SoilClasses, guessed, ranked_by_likelihood
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.soils import KINDS, SOILS, UNKNOWN
from soilbus.terra.wheel import Soil

WIDTH = 0.32
CLASSES = SoilClasses.of_table(WIDTH)
CONFIG = reference_configuration(WIDE_COHESION)
PRIOR = prior_of(CONFIG)
ALL = Coordinates(SoilPrior(np.ones(6), np.ones(6)), WIDTH)
NO_GUESS = SoilPrior(np.ones(6), np.full(6, 1e3))


def soil_at(position: np.ndarray) -> Soil:
    """The soil with these coordinates, without bounds."""
    n = math.exp(position[2])
    k_c = math.exp(position[0])
    return Soil(k_c, math.exp(position[1]) / 0.03**n - k_c / WIDTH, *np.exp(position[2:]).tolist())


def posterior_about(position: np.ndarray, covariance: np.ndarray) -> Posterior:
    """The posterior with this mean (6,) and covariance (6, 6) in the coordinates."""
    soil = soil_at(position)
    directions = ALL.log_directions(np.asarray(soil))
    return Posterior(soil, directions @ covariance @ directions.T)


def readings(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of a posterior whose data told the origin 0 with unequal, correlated errors."""
    root = rng.standard_normal((6, 6)) * rng.uniform(0.02, 0.5, 6)
    covariance = root @ root.T + 1e-4 * np.eye(6)
    return np.linalg.cholesky(covariance) @ rng.standard_normal(6), covariance


def test_a_posterior_without_a_guess_is_weighed_as_bayes_does():
    """Each class's density averaged over soils drawn from what the data say, against the closed form."""
    rng = np.random.default_rng(3)
    about = CLASSES.centre[KINDS.index("rubicon_sandy_loam_43")] + 0.05
    covariance = np.diag([1.0, 0.3, 0.2, 0.1, 0.5, 0.3]) ** 2
    covariance[1, 2] = covariance[2, 1] = 0.5 * 0.3 * 0.2
    measured = rng.multivariate_normal(about[1:], covariance[1:, 1:], 40_000)
    likelihood = [
        np.mean(np.exp(-0.5 * (((measured - centre[1:]) / spread[1:]) ** 2).sum(1)) / np.prod(spread[1:]))
        for centre, spread in zip(CLASSES.centre, CLASSES.spread, strict=True)
    ]
    prior = np.append(np.full(len(KINDS), (1.0 - PRIOR_UNKNOWN) / len(KINDS)), PRIOR_UNKNOWN)
    expected = dict(zip(CLASSES.names, prior * likelihood / (prior @ likelihood), strict=True))
    said = CLASSES.probabilities(posterior_about(about, covariance), NO_GUESS)
    assert next(iter(said)) == max(expected, key=expected.__getitem__)
    assert sum(p > 0.02 for p in expected.values()) >= 4  # a case with something to weigh
    for name, p in expected.items():
        assert said[name] == pytest.approx(p, rel=0.05, abs=1e-3), name


def test_what_the_data_owe_to_a_guess_is_taken_out():
    """The same data with two guesses, one of them far off, lead to the same probabilities."""
    rng = np.random.default_rng(5)
    about = CLASSES.centre[KINDS.index("clayey_soil_38")] + 0.1
    error = np.array([0.5, 0.2, 0.2, 0.1, 0.6, 0.3]) ** 2
    said = []
    for shift in (0.0, 0.7):
        guess = SoilPrior(np.exp(rng.normal(0.0, shift, 6)) * np.asarray(soil_at(about)), np.full(6, 0.8))
        # Bayes for Gaussians, linear about the soil that the data tell
        by_log = np.linalg.inv(ALL.log_directions(np.asarray(soil_at(about))))
        owed = np.linalg.inv(by_log @ np.diag(guess.log_std**2) @ by_log.T)
        centre = about + by_log @ np.log(guess.median / np.asarray(soil_at(about)))
        covariance = np.linalg.inv(np.diag(1.0 / error) + owed)
        mean = covariance @ (about / error + owed @ centre)
        directions = ALL.log_directions(np.asarray(soil_at(mean)))
        said.append(CLASSES.probabilities(Posterior(soil_at(mean), directions @ covariance @ directions.T), guess))
    one, other = said
    assert one["clayey_soil_38"] > 0.5
    for name in one:  # the coordinates bend a little between the two means
        assert other[name] == pytest.approx(one[name], abs=0.03)


def test_on_exact_gaussians_probabilities_come_true():
    """Soils drawn from the classes, measured with known errors: every bin of said probabilities holds."""
    rng = np.random.default_rng(11)
    prior = np.append(np.full(len(KINDS), (1.0 - PRIOR_UNKNOWN) / len(KINDS)), PRIOR_UNKNOWN)
    said = []
    for i in rng.choice(len(prior), 2000, p=prior):
        truth = CLASSES.centre[i] + CLASSES.spread[i] * rng.standard_normal(6)
        error, covariance = readings(rng)
        if soil_at(truth + error).k_phi > 0.0:
            posterior = posterior_about(truth + error, covariance)
            said.append(Said(CLASSES.probabilities(posterior, NO_GUESS), CLASSES.names[i]))
    assert abs(shortfall(said)) < 3.0
    p, true = np.array([(v, name == s.truth) for s in said for name, v in s.probability.items()]).T
    for low, high in ((0.02, 0.1), (0.1, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 0.9), (0.9, 0.98), (0.98, 1.01)):
        part = (p >= low) & (p < high)
        assert part.sum() > 100
        scatter = math.sqrt((p[part] * (1.0 - p[part])).sum()) / part.sum()
        assert true[part].mean() == pytest.approx(p[part].mean(), abs=3.5 * scatter), (low, high)


def test_on_simulated_windows_probabilities_come_true():
    """A small version of the run in reliability.py."""
    said = list(windows(18, seed=2, seconds=10.0, slip=0.15))
    assert len(said) >= 10
    assert abs(shortfall(said)) < 3.0
    p = np.array([s.probability[UNKNOWN] for s in said])
    unknown = sum(s.truth == UNKNOWN for s in said)
    assert unknown == pytest.approx(p.sum(), abs=3.0 * math.sqrt((p * (1.0 - p)).sum()))
    assert np.mean([next(iter(s.probability)) == s.truth for s in said]) > 0.6


@pytest.mark.parametrize(
    ("soil", "kind"),
    [(SOILS[name], name) for name in ("dry_sand", "clayey_soil_38", "heavy_clay_40", "lean_clay_22")]
    + [(SOILS["loam"], "sandy_loam_15"), (SOILS["wet_clay"], "xi_wet_clay")]
    + [(Soil(5e3, 6e6, 1.1, 0.85, 400.0, 0.02), UNKNOWN), (Soil(5e3, 9e5, 1.0, 0.12, 2e3, 0.02), UNKNOWN)],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_soil_of_the_table_is_named_and_one_far_from_all_is_not(soil, kind):
    problem = driven(CONFIG, soil, [4], 10.0)
    said = CLASSES.probabilities(fit_window(problem, PRIOR).posterior, PRIOR)
    assert next(iter(said)) == kind
    assert said[kind] > 0.7
    assert sum(said.values()) == pytest.approx(1.0)
    assert list(said.values()) == sorted(said.values(), reverse=True)


def test_nothing_measured_leaves_what_was_likely_beforehand():
    soil = SOILS["loam"]
    guess = SoilPrior(np.asarray(soil), np.full(6, 0.6))
    only_k_c = np.diag([0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    for covariance in (np.diag(guess.log_std**2), np.zeros((6, 6)), only_k_c, 4.0 * np.diag(guess.log_std**2)):
        said = CLASSES.probabilities(Posterior(soil, covariance), guess)
        assert said[UNKNOWN] == pytest.approx(PRIOR_UNKNOWN)
        assert said["snow_us"] == pytest.approx((1.0 - PRIOR_UNKNOWN) / len(KINDS))


def test_held_parameters_count_neither_way():
    sharp = np.diag([0.0, 0.02, 0.02, 0.02, 0.1, 0.1]) ** 2
    guess = SoilPrior(np.ones(6), np.append(0.0, np.full(5, 1e3)))
    loam = SOILS["loam"]
    # all of the stiffness in k_phi, as somebody does who holds k_c at 0: the same pressure under the tyre
    lumped = loam._replace(k_c=0.0, k_phi=loam.k_phi + loam.k_c / WIDTH)
    said = CLASSES.probabilities(Posterior(lumped, sharp), guess)
    assert next(iter(said)) == "sandy_loam_15"
    wrong_c = sharp.copy()
    wrong_c[4, 4] = 0.0
    held = CLASSES.probabilities(Posterior(loam._replace(c=50e3), wrong_c), guess)
    assert next(iter(held)) == "sandy_loam_15"
    free = CLASSES.probabilities(Posterior(loam._replace(c=50e3), sharp), guess)
    assert next(iter(free)) == UNKNOWN


def test_what_somebody_told_counts_and_defaults_do_not():
    default = prior_of(reference_configuration())
    told = prior_of(reference_configuration(["soil.c.value=1700", "soil.c.std=200", "soil.K.std=0"]))
    guess = guessed(told, default)
    changed = dict(zip(PARAMETERS, guess.log_std != default.log_std, strict=True))
    assert changed == {"k_c": False, "k_phi": False, "n": False, "phi": False, "c": True, "K": True}
    # a window that tells nothing: what was told of c still speaks for soils of that cohesion
    said = CLASSES.probabilities(Posterior(Soil(*told.median.tolist()), np.diag(told.log_std**2)), guess)
    assert said["sandy_loam_15"] > 5.0 * said["heavy_clay_25"]
    plain = CLASSES.probabilities(Posterior(Soil(*default.median.tolist()), np.diag(default.log_std**2)), default)
    assert plain["sandy_loam_15"] == pytest.approx(plain["heavy_clay_25"])


def test_the_classes_are_those_of_the_table_with_a_spread_below_that_of_the_table():
    assert CLASSES.names == (*KINDS, UNKNOWN)
    assert len({tuple(SOILS[name]) for name in KINDS}) == len(KINDS)
    assert {tuple(SOILS[name][:2]) for name in SOILS} - {tuple(SOILS[name][:2]) for name in KINDS} == {(5300.0, 1515e3)}
    within, among = CLASSES.spread[0], CLASSES.spread[-1]
    assert within == pytest.approx([*WITHIN_CLASS_SD.values()])
    assert np.all(among > 1.5 * within - (within == WITHIN_CLASS_SD["K"]))  # K in the table is a planning figure
    depth = soil_at(CLASSES.centre[KINDS.index("dry_sand")])
    assert depth == pytest.approx(SOILS["dry_sand"])


@pytest.mark.parametrize("sensors", ["all", "no sinkage", "no draft", "only torque"])
def test_start_values_are_the_soils_that_foretell_the_window(simulated, sensors):
    without = {"all": (), "no sinkage": ("sinkage",), "no draft": ("draft",), "only torque": ("sinkage", "draft")}
    problem = simulated(SOILS["upland_sandy_loam_51"], 6, without=without[sensors]).problem()
    soils = [clip_to_prior(PRIOR, SOILS[name]) for name in KINDS]
    order = [KINDS[soils.index(soil)] for soil in ranked_by_likelihood(problem, soils)]
    assert order[0] == "upland_sandy_loam_51"
    assert sorted(order) == sorted(KINDS)
    assert set(order[-3:]) & {"snow_us", "snow_sweden"}  # which do not carry it
