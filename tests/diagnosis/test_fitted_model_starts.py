"""Fits from starts: where -2 log posterior is underestimated, at the edge of a range, with other effects."""

from dataclasses import replace

import numpy as np
import pytest

import records
from soilbus.diagnosis.diagnose import diagnose
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.options import DiagnosisOptions
from soilbus.diagnosis.score import scores
from soilbus.diagnosis.verdict import Verdict
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.multistart import fit_at
from soilbus.estimation.options import SolverOptions
from soilbus.estimation.solver import Objective, minimise
from soilbus.report.statement import doubt
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active

CONFIG = reference_configuration()
PRIOR = prior_of(CONFIG)


def recorded(soil="loam", hidden=()):
    return records.recorded(excited(soil, 60.0), 5, *hidden, options=DiagnosisOptions(instant=0.1))


SLIP_SINKAGE = CATALOGUE["slip_sinkage"]


@pytest.fixture(scope="module")
def narrow():
    """The effect with less slip-sinkage than the record has."""
    highest = {"softening": 1.0, "exponent": 0.05, "dug": 0.1}
    return replace(SLIP_SINKAGE, parameters=tuple(replace(p, high=highest[p.name]) for p in SLIP_SINKAGE.parameters))


@pytest.fixture(scope="module")
def record():
    """A drive on which wheels dig as they slip."""
    return recorded(hidden=(Active(SLIP_SINKAGE, {"exponent": 0.3, "softening": 0.0, "dug": 0.0}),))


def test_a_fit_from_the_optimum_with_the_latents_as_measured_ends_with_them_at_their_optimum():
    """With latents as measured -2 log posterior seems too low."""
    record = recorded("wet_clay")
    known = fit_model([record], PRIOR, ())
    problem, optimum = record.training, known.fits[0].mode
    objective = Objective(problem, PRIOR, Gaussian.of(PRIOR, problem.gain_std))
    start = objective.start(optimum.soil, gains=optimum.gains)
    assert objective.quadratic_model(start).neg2_log_posterior < known.neg2_log_posterior - 5.0
    end = minimise(objective, start, SolverOptions(step_tolerance=0.02))
    fit = fit_at(objective, end)
    here = end.iterate
    for _ in range(3):
        here = objective.stepped(here, objective.quadratic_model(here), np.zeros(len(end.model.gradient)))
    assert fit.converged
    assert fit.neg2_log_posterior == pytest.approx(objective.quadratic_model(here).neg2_log_posterior, abs=0.3)
    assert fit.neg2_log_posterior == pytest.approx(known.neg2_log_posterior, abs=0.6)


def test_fits_go_on_from_where_a_parameter_was_held_at_the_edge_of_its_range(record, narrow):
    held = fit_model([record], PRIOR, [narrow])
    i = [f.parameter.name for f in held.free].index("exponent")
    assert (held.free[i].std, held.free[i].value) == (0.0, 0.05)
    (start,) = held.as_starts()
    assert held.free_unheld[i].std > 0.0
    assert held.free_unheld[i].at(start.gains[record.training.n_sensors + i]) == pytest.approx(0.05)
    again = fit_model([record], PRIOR, [narrow], [start])
    assert again.fits[0].iterations == 1
    assert again.score == pytest.approx(held.score, abs=0.1)
    (score,) = scores([record], PRIOR, held, [CATALOGUE["lugs"]])
    assert held.free_unheld[i].at(score.starts[0].gains[record.training.n_sensors + i]) == pytest.approx(0.05, abs=1e-3)


def test_an_effect_that_explains_the_data_only_at_the_edge_of_its_range_is_doubted(record, narrow):
    """Within its range it is named, and nothing is doubted."""
    within, beyond = (diagnose([record], PRIOR, [candidate]) for candidate in (SLIP_SINKAGE, narrow))
    assert within.verdict is Verdict.NAMED
    assert doubt(within) is None
    assert beyond.verdict is not Verdict.NAMED
    assert "at the edge of what is possible" in (doubt(beyond) or "")
    assert "slip_sinkage (exponent 0.05)" in (doubt(beyond) or "")


def test_a_start_with_other_effects_has_those_that_are_new_absent(record):
    lugs = CATALOGUE["lugs"]
    one = fit_model([record], PRIOR, [SLIP_SINKAGE])
    (own,), (both,), (none,) = one.as_starts(), one.as_starts([lugs, SLIP_SINKAGE]), one.as_starts([])
    n_sensors, n_lugs = record.training.n_sensors, len(lugs.parameters)
    assert both.gains[n_sensors : n_sensors + n_lugs].tolist() == [0.0] * n_lugs
    assert both.gains[n_sensors + n_lugs :].tolist() == own.gains[n_sensors:].tolist()
    assert none.gains.tolist() == own.gains[:n_sensors].tolist()
