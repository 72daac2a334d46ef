"""One optimum from every start, or a second mode that is reported; no soil outside its physical range."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.sensors.bins import Bins
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil
from soilbus.trials.windows import fit_from_soil
from tests.lab import local_optima

BOUND_SD = 4.0
"""Prior standard deviations to which a free parameter is confined."""
MAX_PHI = 1.2
"""Friction angle [rad] beyond any soil's."""

STARTS = 20
K_C = np.array(PARAMETERS) == "k_c"
KINDS = [
    ("loam", 10.0, local_optima.EXCITED, False), ("wet_clay", 2.0, local_optima.EXCITED, True),
    ("dry_sand", 2.0, local_optima.EXCITED, False), ("wet_clay", 10.0, local_optima.constant(0.15), True),
    ("loam", 2.0, local_optima.constant(0.15), False),
]  # fmt: skip


@pytest.mark.parametrize(("soil", "seconds", "slip", "sinkage"), KINDS)
def test_descents_from_random_soils_of_the_prior_end_at_the_fit(soil, seconds, slip, sinkage):
    config = reference_configuration()
    case = local_optima.Case("", local_optima.window(config, soil, seconds, slip, sinkage), prior_of(config))
    ends = local_optima.ends_of(case, STARTS, 3)
    assert ends.above < local_optima.SAME_VALUE
    assert ends.off < local_optima.SAME_SOIL
    assert ends.other == 0
    assert not ends.worse
    assert ends.failed <= 0.1 * STARTS
    assert ends.fit.second_mode is None


@pytest.fixture(scope="module")
def bimodal():
    """Two wheels of different widths on wet clay: k_c may have its value, or be close to zero."""
    config = local_optima.two_wheels(reference_configuration())
    return local_optima.window(config, "wet_clay", seed=3), prior_of(config)


def test_two_optima_of_similar_evidence_are_a_fit_with_a_second_mode(bimodal):
    problem, prior = bimodal
    fit = fit_window(problem, prior)
    assert fit.converged
    second = fit.second_mode
    assert 0.05 < second.share <= 0.5
    again = fit_from_soil(problem, prior, second.gaussian.posterior.soil)  # it is an optimum
    assert again.converged
    assert local_optima.apart(again, fit) > 2.0
    assert again.mode.posterior.distance(second.gaussian.posterior.soil) < 0.1
    assert second.share == pytest.approx(
        1.0 / (1.0 + math.exp(0.5 * (again.neg2_log_evidence - fit.neg2_log_evidence))), abs=0.01
    )


def test_what_is_reported_covers_both_optima(bimodal):
    fit = fit_window(*bimodal)
    one, other, whole = fit.mode, fit.second_mode.gaussian, fit.reported
    both = one.mixture(other, fit.second_mode.share)
    off = np.log(other.soil / one.soil)
    share = fit.second_mode.share
    for k in range(6):
        expected = (1.0 - share) * one.covariance[k, k] + share * (other.covariance[k, k] + off[k] ** 2)
        assert both.covariance[k, k] == pytest.approx(expected)
        assert whole.covariance[k, k] >= expected * (1.0 - 1e-9)
    assert whole.posterior.distance(Soil(*other.soil)) < 3.0 < one.posterior.distance(Soil(*other.soil))
    truth = SOILS["wet_clay"].bearing_pressure(0.02, 0.3)
    bearing = whole.posterior.bearing_pressure(0.02, 0.3)
    assert abs(bearing.value - truth) < 2.0 * bearing.std


def test_without_two_separable_moduli_there_is_no_second_mode(bimodal):
    problem, prior = bimodal
    held = SoilPrior(prior.median, np.where(np.arange(6) == PARAMETERS.index("k_c"), 0.0, prior.log_std))
    assert fit_window(problem, held).second_mode is None
    config = reference_configuration([f"wheel.{w}.width=0.3" for w in ("FL", "FR", "RL", "RR")])
    assert fit_window(local_optima.window(config, "wet_clay", 2.0, seed=3), prior).second_mode is None


@pytest.fixture(scope="module")
def short():
    config = reference_configuration()
    scenario = Scenario(2.0, (Patch(0.0, "loam"),), slip=local_optima.EXCITED)
    rig, channels = rig_of(config), simulate(config, scenario, 1).channels
    store = Bins(rig, config.estimator.bin, 0.0)
    store.add({c: (channels[c].t, channels[c].value) for c in rig.channels if c in channels})
    return store.window(0.0, 2.0), rig, model_of(config), prior_of(config)


CHANNELS = ("torque", "load", "speed", "sinkage", "ground_speed", "draft")
HARM = st.tuples(
    st.sampled_from(CHANNELS),
    st.sampled_from(["spiked", "constant", "scaled", "shuffled", "nan", "inf", "negative", "zero"]),
    st.floats(-8.0, 8.0),
)


def harmed(window, harms, seed):
    rng = np.random.default_rng(seed)
    values = {}
    for name, harm, size in harms:
        column = values.get(name, getattr(window, name)).copy()
        some = rng.random(column.shape) < 0.3
        with np.errstate(over="ignore", invalid="ignore"):
            match harm:
                case "spiked":
                    column[some] *= 10.0**size
                case "constant":
                    column[...] = 10.0**size
                case "scaled":
                    column *= 10.0 ** (size / 8.0)
                case "shuffled":
                    rng.shuffle(column)
                case "nan":
                    column[some] = np.nan
                case "inf":
                    column[some] = np.inf
                case "negative":
                    column *= -1.0
                case "zero":
                    column[...] = 0.0
        values[name] = column
    return replace(window, **values)


@settings(derandomize=True, deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(harms=st.lists(HARM, max_size=3), rows=st.integers(1, 20), seed=st.integers(0, 9))
def test_every_fit_is_physical_for_all_data(harms, rows, seed, short):
    window, rig, model, prior = short
    problem = ObservationModel(harmed(window, harms, seed).rows(np.arange(rows)), rig, model, 0.2)
    fit = fit_window(problem, prior)
    if fit is None:
        return
    soil = np.asarray(fit.posterior.soil)
    assert np.isfinite(soil).all()
    assert (soil > 0.0).all()
    assert fit.posterior.soil.phi <= MAX_PHI < 0.5 * math.pi
    away = np.abs(np.log(soil / prior.median)) / prior.log_std
    assert away.max() < BOUND_SD * (1.0 + 1e-9)
    for gaussian in (fit.mode, fit.reported):
        assert np.isfinite(gaussian.gains).all()
        spread = np.sqrt(np.diag(gaussian.covariance))
        assert np.isfinite(spread).all()
        scaled = gaussian.covariance[spread > 0.0][:, spread > 0.0] / np.outer(*[spread[spread > 0.0]] * 2)
        assert np.linalg.eigvalsh(scaled).min() > -1e-9
        assert (spread[:6] <= prior.log_std * (1.0 + 1e-6)).all() or (
            fit.second_mode is not None and gaussian is fit.reported
        )
    assert math.isfinite(fit.neg2_log_posterior) or not fit.converged
    assert math.isfinite(fit.neg2_log_evidence) or not fit.converged
