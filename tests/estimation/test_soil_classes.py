"""Probabilities of soil classes against Bayes' rule by sampling, on Gaussians and on simulated windows."""

import math

import numpy as np
import pytest

from soilbus.estimation.assembly import prior_of
from soilbus.estimation.multistart import clip_to_prior, fit_window
from soilbus.estimation.parametrization import Coordinates
from soilbus.estimation.posterior import PARAMETERS, Posterior, SoilPrior
from soilbus.estimation.soil_classes import WITHIN_CLASS_SD, SoilClasses, guessed, ranked_by_likelihood
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import KINDS, SOILS, UNKNOWN
from soilbus.terra.wheel import Soil
from soilbus.trials.windows import observed

PRIOR_UNKNOWN = 0.5
"""Prior probability that a soil is none of the table."""

WIDTH = 0.32
CLASSES = SoilClasses.of_table(WIDTH)
CONFIG = reference_configuration(["soil.c.value=5000", "soil.c.std=8000"])
"""The table has cohesions up to 69 kPa, 23 times the default prior's median."""
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


def measurements(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of a posterior of data at the origin with unequal, correlated errors."""
    root = rng.standard_normal((6, 6)) * rng.uniform(0.02, 0.5, 6)
    covariance = root @ root.T + 1e-4 * np.eye(6)
    return np.linalg.cholesky(covariance) @ rng.standard_normal(6), covariance


def test_probabilities_without_a_guess_are_those_of_bayes_rule():
    """Each class's density averaged over soils drawn from the likelihood, against the closed form."""
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
    found = CLASSES.probabilities(posterior_about(about, covariance), NO_GUESS)
    assert next(iter(found)) == max(expected, key=expected.__getitem__)
    assert sum(p > 0.02 for p in expected.values()) >= 4  # several classes are likely
    for name, p in expected.items():
        assert found[name] == pytest.approx(p, rel=0.05, abs=1e-3), name


def test_a_guess_is_divided_out():
    """The same data with two guesses, one of them far off, lead to the same probabilities."""
    rng = np.random.default_rng(5)
    about = CLASSES.centre[KINDS.index("clayey_soil_38")] + 0.1
    error = np.array([0.5, 0.2, 0.2, 0.1, 0.6, 0.3]) ** 2
    found = []
    for shift in (0.0, 0.7):
        guess = SoilPrior(np.exp(rng.normal(0.0, shift, 6)) * np.asarray(soil_at(about)), np.full(6, 0.8))
        # Bayes' rule for Gaussians, linear about the soil of the data
        by_log = np.linalg.inv(ALL.log_directions(np.asarray(soil_at(about))))
        of_guess = np.linalg.inv(by_log @ np.diag(guess.log_std**2) @ by_log.T)
        centre = about + by_log @ np.log(guess.median / np.asarray(soil_at(about)))
        covariance = np.linalg.inv(np.diag(1.0 / error) + of_guess)
        mean = covariance @ (about / error + of_guess @ centre)
        directions = ALL.log_directions(np.asarray(soil_at(mean)))
        found.append(CLASSES.probabilities(Posterior(soil_at(mean), directions @ covariance @ directions.T), guess))
    one, other = found
    assert one["clayey_soil_38"] > 0.5
    for name in one:  # the coordinates are slightly curved between the two means
        assert other[name] == pytest.approx(one[name], abs=0.03)


def test_probabilities_are_calibrated_on_gaussians():
    """Soils drawn from the classes, measured with known errors: relative frequencies in bins of probability."""
    rng = np.random.default_rng(11)
    prior = np.append(np.full(len(KINDS), (1.0 - PRIOR_UNKNOWN) / len(KINDS)), PRIOR_UNKNOWN)
    found = []
    for i in rng.choice(len(prior), 2000, p=prior):
        truth = CLASSES.centre[i] + CLASSES.spread[i] * rng.standard_normal(6)
        error, covariance = measurements(rng)
        if soil_at(truth + error).k_phi > 0.0:
            posterior = posterior_about(truth + error, covariance)
            found += [(p, name == CLASSES.names[i]) for name, p in CLASSES.probabilities(posterior, NO_GUESS).items()]
    p, true = np.array(found).T
    for low, high in ((0.02, 0.1), (0.1, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 0.9), (0.9, 0.98), (0.98, 1.01)):
        part = (p >= low) & (p < high)
        assert part.sum() > 100
        scatter = math.sqrt((p[part] * (1.0 - p[part])).sum()) / part.sum()
        assert true[part].mean() == pytest.approx(p[part].mean(), abs=3.5 * scatter), (low, high)


@pytest.mark.parametrize(
    ("soil", "kind"),
    [(SOILS[name], name) for name in ("dry_sand", "clayey_soil_38", "heavy_clay_40", "lean_clay_22")]
    + [(SOILS["loam"], "sandy_loam_15"), (SOILS["wet_clay"], "xi_wet_clay")]
    + [(Soil(5e3, 6e6, 1.1, 0.85, 400.0, 0.02), UNKNOWN), (Soil(5e3, 9e5, 1.0, 0.12, 2e3, 0.02), UNKNOWN)],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_soil_of_the_table_is_named_and_one_far_from_all_is_unknown(soil, kind):
    seed = int(np.random.SeedSequence([4]).generate_state(1)[0])
    scenario = Scenario(10.0, (Patch(0.0, "this", soil),), slip=Swing(0.05, 0.4))
    problem = observed(CONFIG, simulate(CONFIG, scenario, seed).channels, 10.0)
    found = CLASSES.probabilities(fit_window(problem, PRIOR).posterior, PRIOR)
    assert next(iter(found)) == kind
    assert found[kind] > 0.7
    assert sum(found.values()) == pytest.approx(1.0)
    assert list(found.values()) == sorted(found.values(), reverse=True)


def test_without_data_the_prior_probabilities_stay():
    soil = SOILS["loam"]
    guess = SoilPrior(np.asarray(soil), np.full(6, 0.6))
    only_k_c = np.diag([0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    for covariance in (np.diag(guess.log_std**2), np.zeros((6, 6)), only_k_c, 4.0 * np.diag(guess.log_std**2)):
        found = CLASSES.probabilities(Posterior(soil, covariance), guess)
        assert found[UNKNOWN] == pytest.approx(PRIOR_UNKNOWN)
        assert found["snow_us"] == pytest.approx((1.0 - PRIOR_UNKNOWN) / len(KINDS))


def test_held_parameters_do_not_count():
    sharp = np.diag([0.0, 0.02, 0.02, 0.02, 0.1, 0.1]) ** 2
    guess = SoilPrior(np.ones(6), np.append(0.0, np.full(5, 1e3)))
    loam = SOILS["loam"]
    # all of the stiffness in k_phi, with k_c held at 0: the same pressure under the tyre
    lumped = loam._replace(k_c=0.0, k_phi=loam.k_phi + loam.k_c / WIDTH)
    found = CLASSES.probabilities(Posterior(lumped, sharp), guess)
    assert next(iter(found)) == "sandy_loam_15"
    wrong_c = sharp.copy()
    wrong_c[4, 4] = 0.0
    held = CLASSES.probabilities(Posterior(loam._replace(c=50e3), wrong_c), guess)
    assert next(iter(held)) == "sandy_loam_15"
    free = CLASSES.probabilities(Posterior(loam._replace(c=50e3), sharp), guess)
    assert next(iter(free)) == UNKNOWN


def test_a_configured_prior_is_evidence_and_a_default_is_not():
    default = prior_of(reference_configuration())
    configured = prior_of(reference_configuration(["soil.c.value=1700", "soil.c.std=200", "soil.K.std=0"]))
    guess = guessed(configured, default)
    changed = dict(zip(PARAMETERS, guess.log_std != default.log_std, strict=True))
    assert changed == {"k_c": False, "k_phi": False, "n": False, "phi": False, "c": True, "K": True}
    # without data the configured prior of c still favours soils of that cohesion
    found = CLASSES.probabilities(Posterior(Soil(*configured.median.tolist()), np.diag(configured.log_std**2)), guess)
    assert found["sandy_loam_15"] > 5.0 * found["heavy_clay_25"]
    plain = CLASSES.probabilities(Posterior(Soil(*default.median.tolist()), np.diag(default.log_std**2)), default)
    assert plain["sandy_loam_15"] == pytest.approx(plain["heavy_clay_25"])


def test_the_classes_are_those_of_the_table_with_a_smaller_spread_than_the_table():
    assert CLASSES.names == (*KINDS, UNKNOWN)
    assert len({tuple(SOILS[name]) for name in KINDS}) == len(KINDS)
    assert {tuple(SOILS[name][:2]) for name in SOILS} - {tuple(SOILS[name][:2]) for name in KINDS} == {(5300.0, 1515e3)}
    within, among = CLASSES.spread[0], CLASSES.spread[-1]
    assert within == pytest.approx([*WITHIN_CLASS_SD.values()])
    assert np.all(among > 1.5 * within - (within == WITHIN_CLASS_SD["K"]))  # K in the table is a planning figure
    depth = soil_at(CLASSES.centre[KINDS.index("dry_sand")])
    assert depth == pytest.approx(SOILS["dry_sand"])


@pytest.mark.parametrize("sensors", ["all", "no sinkage", "no draft", "only torque"])
def test_the_true_soil_has_the_greatest_likelihood_of_the_table(simulated, sensors):
    without = {"all": (), "no sinkage": ("sinkage",), "no draft": ("draft",), "only torque": ("sinkage", "draft")}
    problem = simulated(SOILS["upland_sandy_loam_51"], 6, without=without[sensors]).problem()
    soils = [clip_to_prior(PRIOR, SOILS[name]) for name in KINDS]
    order = [KINDS[soils.index(soil)] for soil in ranked_by_likelihood(problem, soils)]
    assert order[0] == "upland_sandy_loam_51"
    assert sorted(order) == sorted(KINDS)
    assert set(order[-3:]) & {"snow_us", "snow_sweden"}  # which cannot carry it
