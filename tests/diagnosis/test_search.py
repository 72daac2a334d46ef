"""The stepwise search: predictions by scores, swaps, and fits that are not repeated or given up."""

from itertools import islice, product

import numpy as np
import pytest

from records import recorded
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.score import further_scores, normal_equations, scores
from soilbus.estimation import multistart
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.nuisance_parameters import parameters_of
from soilbus.estimation.options import SolverOptions
from soilbus.estimation.solver import minimise
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active
from tests.lab.blind.cases import cases
from tests.lab.blind.trial import record_of_case

CONFIG = reference_configuration()
PRIOR = prior_of(CONFIG)
SLIP_SINKAGE = CATALOGUE["slip_sinkage"]


@pytest.fixture(scope="module")
def record():
    hidden = Active(SLIP_SINKAGE, {"exponent": 0.3, "softening": 0.0, "dug": 0.0})
    return recorded(excited("loam", 60.0), 11, hidden)


@pytest.fixture(scope="module")
def base(record):
    return fit_model([record], PRIOR, ())


def fall_on_any_face(information, gradient, low, high):
    """Greatest fall of a parabola in a box: the best of the stationary points of all its faces that are inside."""
    best = 0.0
    for face in product((None, 0, 1), repeat=len(gradient)):
        free = np.array([edge is None for edge in face])
        u = np.array([0.0 if edge is None else (low, high)[edge][i] for i, edge in enumerate(face)])
        if free.any():
            u[free] = -np.linalg.solve(information[np.ix_(free, free)], (gradient + information @ u)[free])
        if np.all((u >= low) & (u <= high)):
            best = max(best, float(-2.0 * gradient @ u - u @ information @ u))
    return best


def test_the_predicted_fall_is_the_greatest_that_the_ranges_of_the_parameters_allow(record, base):
    candidates = [effect for effect in CATALOGUE.values() if not effect.of_record]
    at_edge = 0
    for effect in candidates:
        free = parameters_of(effect, len(record.training.rig.wheels))
        if len(free) > 4:  # three to this power are the faces
            continue
        equations = normal_equations([record], PRIOR, base, [effect], free).reduced(np.arange(len(free)))
        information = equations.information + np.eye(len(free))
        low, high = (
            np.array([(getattr(f.parameter, edge) - f.value) / f.std for f in free]) for edge in ("low", "high")
        )
        (score,) = scores([record], PRIOR, base, [effect])
        assert score.fall == pytest.approx(
            fall_on_any_face(information, equations.gradient, low, high), rel=1e-6, abs=1e-9
        )
        inside = -np.linalg.solve(information, equations.gradient)
        at_edge += bool(np.any((inside < low) | (inside > high)))
    assert at_edge >= 3


def test_scores_from_further_starts_are_the_same_together_as_alone(record, base):
    candidates = list(CATALOGUE.values())
    together = {score.effect.name: score for score in further_scores([record], PRIOR, base, candidates)}
    assert together.keys() == {e.name for e in candidates if any(p.starts for p in e.parameters)}
    for name, score in together.items():
        (alone,) = further_scores([record], PRIOR, base, [CATALOGUE[name]])
        assert score.effect is CATALOGUE[name]
        assert score.change == pytest.approx(alone.change, rel=1e-6, abs=1e-6)
        assert score.starts[0].gains == pytest.approx(alone.starts[0].gains, rel=1e-6, abs=1e-9)


def test_no_descent_of_a_window_begins_where_another_did(monkeypatch):
    """On this case a descent towards the optimum was taken for a second mode."""
    case = next(islice(cases("pair", 11), 14, None))
    problem, prior = record_of_case(case).training, prior_of(case.config)
    began = []

    def counted(fitting, near, *args, **kwargs):
        began.append((fitting.problem.n, near.soil.tobytes()))
        return minimise(fitting, near, *args, **kwargs)

    monkeypatch.setattr(multistart, "minimise", counted)
    assert fit_window(problem, prior) is not None
    assert len(began) == len(set(began))


def test_a_fit_that_will_stay_above_the_limit_is_given_up(record, base):
    (score,) = scores([record], PRIOR, base, [SLIP_SINKAGE])
    least = fit_model([record], PRIOR, [SLIP_SINKAGE], score.starts).neg2_log_posterior
    below, kept = (
        fit_model([record], PRIOR, [SLIP_SINKAGE], score.starts, SolverOptions(give_up_above=least + by))
        for by in (-5.0, 5.0)
    )
    assert below is None
    assert kept.neg2_log_posterior == pytest.approx(least, abs=0.1)
