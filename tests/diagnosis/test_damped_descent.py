"""The damped descent: along curved valleys, where -2 log posterior is underestimated, at the edge of a range."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from soilbus.diagnosis.damped_descent import Expansion, GeodesicSteps, descend_damped
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.records import record_of
from soilbus.diagnosis.score import scores
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.multistart import DescentOptions, fit_at
from soilbus.estimation.solver import Descent, Iterate, Objective, QuadraticModel, StoppingRule, descend_jointly
from soilbus.sensors.bins import Bins
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active

MAX_STALLED = 2
"""Steps in a row that gain nothing, after which a descent ends."""

CONFIG = reference_configuration()
PRIOR = prior_of(CONFIG)
NOTHING = DescentOptions().stall_tolerance


class Banana:
    """Rosenbrock's valley (1960, Comput. J. 3:175) as residuals 10 STEEP (y - x^2) and 1 - x."""

    STEEP = 10.0
    second_derivative, geodesic_step = Objective.second_derivative, Objective.geodesic_step

    def __init__(self) -> None:
        self.asked = 0

    def directions(self, place):
        return np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])

    def step_fraction(self, place, step):
        return 1.0

    def stepped(self, place, point, step):
        return replace(place, soil=place.soil + step)

    def quadratic_model(self, place):
        self.asked += 1
        x, y = place.soil
        rows = np.array([[10.0 * self.STEEP * (y - x * x), -20.0 * self.STEEP * x, 10.0 * self.STEEP], [1 - x, -1, 0]])
        r, J = rows[:, 0], rows[:, 1:]
        none = np.zeros((2, 2))
        at = SimpleNamespace(rows=rows, weighed=rows)
        return QuadraticModel(J.T @ J, none, none, J.T @ r, float(r @ r), np.zeros((0, 2)), at)


def begun(banana):
    place = Iterate(np.array([-1.0, 1.0]), np.zeros(0), None, np.inf, 0)
    return Expansion(place, banana.quadratic_model(place))


def test_curved_steps_follow_a_curved_valley_in_half_the_steps_of_damped_ones():
    banana = Banana()
    here, geodesic = begun(banana), GeodesicSteps(banana)
    while here.quadratic.neg2_log_posterior > 1e-6 and banana.asked < 100:
        here, _ = geodesic.along(here, here.quadratic.step())
    damped, damping = Banana(), 1e-2
    there = begun(damped)
    while there.quadratic.neg2_log_posterior > 1e-6 and damped.asked < 1000:
        place = damped.stepped(*there, there.quadratic.step(damping))
        point = damped.quadratic_model(place)
        falls = point.neg2_log_posterior < there.quadratic.neg2_log_posterior
        damping *= 0.3 if falls else 10.0
        there = Expansion(place, point) if falls else there
    assert banana.asked <= 15
    assert damped.asked > 2 * banana.asked


def test_the_second_derivative_along_a_step_is_that_of_the_residuals():
    banana = Banana()
    place, point = begun(banana)
    step = np.array([0.3, -0.2])
    there = banana.quadratic_model(banana.stepped(place, point, step))
    found = banana.second_derivative(place, point, step, there)
    assert found == pytest.approx([-20.0 * banana.STEEP * 0.3**2, 0.0], abs=1e-9)


def test_a_quadratic_model_steps_by_the_gradient_that_it_is_given():
    _, point = begun(Banana())
    gradient = np.array([3.0, -1.0])
    assert point.information @ point.step(gradient=gradient) == pytest.approx(-gradient)
    assert point.step(gradient=point.gradient) == pytest.approx(point.step())


@pytest.fixture(scope="module")
def record():
    return recorded()


def recorded(soil="loam", hidden=()):
    rig = rig_of(CONFIG)
    store = Bins(rig, 0.1, 0.0)
    channels = simulate(CONFIG, excited(soil, 60.0), 5, hidden).channels
    store.add({name: (c.t, c.value) for name, c in channels.items() if name in rig.channels})
    return record_of("x", store.window(0.0, 60.0), rig, model_of(CONFIG), 0.2, 0.15)


def test_a_damped_descent_ends_at_the_posterior_with_the_latents_at_their_optimum():
    """With latents as measured it seems too low, and then no step lowers it."""
    record = recorded("wet_clay")
    known = fit_model([record], PRIOR, ())
    problem, optimum = record.training, known.fits[0].mode
    fitting = Objective(problem, PRIOR, Gaussian.of(PRIOR, problem.gain_std))
    place = fitting.start(optimum.soil, gains=optimum.gains)
    point = fitting.quadratic_model(place)
    assert point.neg2_log_posterior < known.neg2_log_posterior - 5.0
    fast = fit_at(fitting, Descent(place, place, point, np.inf, 1, converged=False))
    slow = descend_damped(fitting, fast, DescentOptions())
    here = Iterate(slow.optimum.soil, slow.optimum.gains, slow.optimum.latents, slow.neg2_log_posterior, 0)
    for _ in range(3):
        here = fitting.stepped(here, fitting.quadratic_model(here), np.zeros(len(point.gradient)))
    assert slow.converged
    assert slow.neg2_log_posterior == pytest.approx(fitting.quadratic_model(here).neg2_log_posterior, abs=NOTHING)
    assert slow.neg2_log_posterior == pytest.approx(known.neg2_log_posterior, abs=2.0 * NOTHING)


def test_fits_go_on_from_where_a_parameter_was_held_at_the_edge_of_its_range():
    """Slip-sinkage greater than it may be."""
    effect = CATALOGUE["slip_sinkage"]
    highest = {"softening": 1.0, "exponent": 0.05, "dug": 0.1}
    narrow = replace(effect, parameters=tuple(replace(p, high=highest[p.name]) for p in effect.parameters))
    record = recorded(hidden=(Active(effect, {"exponent": 0.3, "softening": 0.0, "dug": 0.0}),))
    held = fit_model([record], PRIOR, [narrow])
    i = [f.parameter.name for f in held.free].index("exponent")
    assert (held.free[i].std, held.free[i].value) == (0.0, 0.05)
    (start,) = held.as_starts()
    assert held.free_unheld[i].std > 0.0
    assert held.free_unheld[i].at(start.gains[record.training.n_sensors + i]) == pytest.approx(0.05)
    again = fit_model([record], PRIOR, [narrow], [start])
    assert again.fits[0].iterations == 1
    assert again.neg2_log_evidence == pytest.approx(held.neg2_log_evidence, abs=0.1)
    (score,) = scores([record], PRIOR, held, [CATALOGUE["lugs"]])
    assert held.free_unheld[i].at(score.starts[0].gains[record.training.n_sensors + i]) == pytest.approx(0.05, abs=1e-3)


def test_a_start_with_other_effects_has_those_that_are_new_absent(record):
    slip, lugs = CATALOGUE["slip_sinkage"], CATALOGUE["lugs"]
    one = fit_model([record], PRIOR, [slip])
    (own,), (both,), (none,) = one.as_starts(), one.as_starts([lugs, slip]), one.as_starts([])
    n_sensors, n_lugs = record.training.n_sensors, len(lugs.parameters)
    assert both.gains[n_sensors : n_sensors + n_lugs].tolist() == [0.0] * n_lugs
    assert both.gains[n_sensors + n_lugs :].tolist() == own.gains[n_sensors:].tolist()
    assert none.gains.tolist() == own.gains[:n_sensors].tolist()


class Flat:
    """Iterates whose -2 log posterior goes up and down by less than is predicted at each."""

    def __init__(self, costs):
        self.costs, self.asked = costs, 0

    def quadratic_model(self, place):
        self.asked += 1
        cost = self.costs[min(self.asked, len(self.costs)) - 1]
        return SimpleNamespace(
            neg2_log_posterior=cost, step=lambda: np.ones(1), squared_length=lambda step: 0.5, information=np.eye(1)
        )

    def stepped(self, place, point, step):
        return place + 1


def test_a_fit_whose_cost_no_longer_falls_ends_where_it_was_least():
    costs = [10.0, 9.0, 9.4, 9.1, 8.9, 8.8]
    flat = Flat(costs)
    end = descend_jointly(flat, Trial(0), StoppingRule(30, max_rejected=0, stall_tolerance=0.3))
    assert end.converged
    assert flat.asked == 2 + MAX_STALLED
    assert (end.previous, end.iterate, end.model.neg2_log_posterior) == (1, 2, 9.0)
    unending = Flat(costs)
    assert not descend_jointly(unending, Trial(0), StoppingRule(30, max_rejected=0)).converged
    assert unending.asked == 30


class Trial(int):
    """An iterate by its number."""

    evaluations = 0

    def __add__(self, other):
        return Trial(int(self) + other)
