"""Why a descent ends, which steps it accepts, and steps and fits at bounds."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from soilbus.diagnosis.joint_fit import Start, fit_jointly
from soilbus.estimation.assembly import model_of, rig_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.nuisance_parameters import parameters_of
from soilbus.estimation.observation_with_effects import ObservationModelWithEffects
from soilbus.estimation.options import SolverOptions
from soilbus.estimation.parametrization import Coordinates, at_bounds, step_fraction_within
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.solver import Iterate, Objective, QuadraticModel, Termination, minimise
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.soils import SOILS
from soilbus.trials.windows import fit_from_soil

BOUND_SD = 4.0
"""Prior standard deviations to which a free parameter is confined."""

WET_CLAY = SOILS["wet_clay"]
C = PARAMETERS.index("c")


class OneResidual:
    """An objective r(x)^2 of one unknown, which counts its evaluations."""

    def __init__(self, residual, derivative):
        self.residual, self.derivative = residual, derivative
        self.tried, self.n_solved_angles = [], 0

    def quadratic_model(self, iterate):
        (x,) = iterate.soil
        self.tried.append(x)
        r, slope = self.residual(x), self.derivative(x)
        if not math.isfinite(r):
            return None
        none = np.zeros((1, 1))
        return QuadraticModel(np.array([[slope**2]]), none, np.array([slope * r]), r**2, np.zeros((0, 1)))

    def stepped(self, iterate, model, step):
        return replace(iterate, soil=iterate.soil + step)

    def with_entry_angles(self, iterate):
        self.n_solved_angles += 1
        return iterate


def begin(x):
    return Iterate(np.array([x]), np.zeros(0), None)


def exponential():
    """Least at log 3."""
    return OneResidual(lambda x: math.exp(x) - 3.0, math.exp)


def test_a_descent_converges_where_the_next_step_is_shorter_than_its_tolerance():
    end = minimise(exponential(), begin(0.5), SolverOptions(step_tolerance=1e-12), 0.0)
    assert end.termination is Termination.STEP
    assert end.iterate.soil[0] == pytest.approx(math.log(3.0), abs=1e-9)
    early = minimise(exponential(), begin(0.5), SolverOptions(step_tolerance=1e-3), 0.0)
    assert early.termination is Termination.STEP
    assert early.evaluations < end.evaluations
    assert early.predicted_decrease > 1e-3  # the next step is predicted from the last two
    assert early.iterate.soil[0] == pytest.approx(math.log(3.0), abs=1e-2)


def test_a_descent_does_not_end_at_a_start_that_may_be_underestimated():
    at_optimum = begin(math.log(3.0))
    assert minimise(exponential(), at_optimum, SolverOptions(), 0.0).evaluations == 1
    assert minimise(exponential(), at_optimum, SolverOptions()).evaluations == 2


def test_a_descent_whose_predicted_value_stays_too_high_is_given_up():
    curve = OneResidual(lambda x: 100.0 + 0.0 * x, lambda x: 1e-9)
    end = minimise(curve, begin(0.0), SolverOptions(step_tolerance=0.0, give_up_above=-1.0))
    assert end.termination is Termination.GIVEN_UP
    assert end.evaluations == len(curve.tried) == 1


def test_rejected_steps_are_shortened_and_end_a_descent_that_finds_none():
    """Every step leads up a cliff."""
    cliff = OneResidual(lambda x: 10.0 if x == 0.0 else 1e3, lambda x: -1.0)
    end = minimise(cliff, begin(0.0), SolverOptions(max_rejected=3))
    assert end.termination is Termination.REJECTED
    assert end.previous.soil[0] == 0.0
    steps = [x for x in cliff.tried if x != 0.0]
    assert len(steps) == 4
    assert all(later < 0.5 * step for step, later in pairwise(steps))
    assert cliff.n_solved_angles == 1


def test_a_descent_ends_at_its_least_value_where_evaluations_are_used_up_or_the_numbers_are_not_finite():
    values = [10.0, 9.0, 9.4, 9.1, 9.5, 9.3]
    waves = OneResidual(lambda x: math.sqrt(values[len(waves.tried) - 1]), lambda x: 1.0)
    end = minimise(waves, begin(0.5), SolverOptions(len(values)), 0.0)
    assert end.termination is Termination.LIMIT
    assert end.evaluations == len(waves.tried) == len(values)
    assert end.model.neg2_log_posterior == pytest.approx(9.0)
    nowhere = minimise(OneResidual(lambda x: math.nan, lambda x: 1.0), begin(0.0), SolverOptions())
    assert nowhere.termination is Termination.NOT_FINITE
    assert nowhere.model is None


@given(st.integers(0, 10_000), st.lists(st.sampled_from([-1.0, 0.0, 1.0]), min_size=4, max_size=4))
def test_a_step_never_crosses_active_bounds_and_with_one_it_is_the_constrained_optimum(seed, sides):
    rng = np.random.default_rng(seed)
    root, target = np.tril(rng.normal(size=(4, 4)), -1) + np.eye(4), rng.normal(size=4)
    none = np.zeros((4, 4))
    model = QuadraticModel(root.T @ root, none, root.T @ target, 0.0, np.diag(sides)[np.array(sides) != 0.0])
    step = model.step()
    assert np.all(step * np.array(sides) <= 1e-12)
    value = float(np.sum((root @ step + target) ** 2))
    assert value <= float(target @ target) + 1e-9
    if np.count_nonzero(sides) < 2:
        low, high = (np.where(np.array(sides) == side, 0.0, side * np.inf) for side in (-1.0, 1.0))
        best = lsq_linear(root, -target, (low, high), method="bvls").x
        assert step == pytest.approx(best, abs=1e-9)


def test_steps_end_at_the_bounds():
    assert step_fraction_within(np.array([0.5, np.inf, -0.2]), np.array([1.0, 9.0, -0.1])) == 0.5
    assert step_fraction_within(np.array([np.inf]), np.array([3.0])) == 1.0
    assert at_bounds(np.array([1.0, 2.0, 3.0]), np.ones(3), np.full(3, 3.0)).tolist() == [-1.0, 0.0, 1.0]
    prior = SoilPrior.from_value_std(dict(zip(PARAMETERS, [(v, 0.25 * v) for v in WET_CLAY], strict=True)))
    coordinates = Coordinates(prior, 0.3)
    soil = np.asarray(WET_CLAY, float)
    step = np.zeros(6)
    step[C] = 0.6
    soil = coordinates.stepped(soil, coordinates.step_fraction(soil, step) * step)
    assert not len(coordinates.active_bounds(soil))
    assert soil[C] == pytest.approx(WET_CLAY.c * np.exp(0.6))
    for _ in range(2):
        soil = coordinates.stepped(soil, coordinates.step_fraction(soil, step) * step)
    assert coordinates.active_bounds(soil).tolist() == [np.eye(6)[C].tolist()]
    assert soil[C] == pytest.approx(WET_CLAY.c * np.exp(BOUND_SD * prior.log_std[C]))


@pytest.mark.parametrize("seed", [5, 6, 7, 8])
def test_a_fit_converges_with_a_parameter_at_its_bound(seed, simulated):
    case = simulated(WET_CLAY, seed, overrides=[f"soil.c.value={0.4 * WET_CLAY.c}", f"soil.c.std={0.04 * WET_CLAY.c}"])
    fit = fit_window(case.problem(), case.prior)
    bound = case.prior.median[C] * np.exp(BOUND_SD * case.prior.log_std[C])
    assert bound < 0.6 * WET_CLAY.c
    assert fit.converged
    assert fit.mode.soil[C] == pytest.approx(bound)
    log_std = case.prior.log_std.copy()
    log_std[C] = 0.0  # the others are where they are with c held at the bound
    median = np.where(np.arange(6) == C, bound, case.prior.median)
    held = fit_from_soil(case.problem(), SoilPrior(median, log_std), WET_CLAY._replace(c=bound))
    std = np.sqrt(np.diag(held.posterior.log_covariance))
    free = std > 0.0
    assert np.abs(np.log(fit.mode.soil / held.mode.soil)[free] / std[free]).max() < 0.2  # each ends within 0.1 sd


@pytest.fixture(scope="module")
def bulldozed(simulated):
    """A drive without bulldozing, fitted with it: the best value is as likely below its range as in it."""
    case = simulated(SOILS["loam"], 11)
    rig, config = rig_of(case.config), case.config
    plain = ObservationModelWithEffects(case.window, rig, model_of(config), config.estimator.min_speed)
    effect = CATALOGUE["bulldozing"]
    return plain.with_effects([effect], parameters_of(effect, plain.n_wheels)), case.prior


def test_parameters_of_effects_stay_inside_their_ranges(bulldozed):
    problem, prior = bulldozed
    joint_prior = Gaussian.of(prior, problem.gain_std)
    gains = np.concatenate([np.zeros(problem.n_sensors), np.ones(len(problem.free))])
    start, own = Start(np.asarray(SOILS["loam"]), gains), np.zeros(len(gains), bool)
    (fit,) = fit_jointly([problem], prior, [joint_prior], own, [start], SolverOptions())
    assert fit.converged
    low, high = problem.gain_bounds
    assert np.all(fit.mode.gains >= low - 1e-9)
    assert np.all(fit.mode.gains <= high + 1e-9)
    assert np.isfinite(low[problem.n_sensors :]).all()
    assert np.isinf(low[: problem.n_sensors]).all()


def test_solved_entry_angles_carry_the_loads_with_effects(simulated):
    case = simulated(SOILS["loam"], 12)
    plain = ObservationModelWithEffects(case.window, rig_of(case.config), model_of(case.config), 0.2)
    effect = CATALOGUE["multipass"]
    problem = plain.with_effects([effect], parameters_of(effect, plain.n_wheels))
    gains = np.concatenate([np.zeros(problem.n_sensors), [1.0, 0.5, 0.3, -0.8]])
    objective = Objective(problem, case.prior, Gaussian.of(case.prior, problem.gain_std))
    iterate = objective.start(np.asarray(SOILS["loam"]), gains=gains)
    np.multiply(iterate.latents.entry_angle, 1.1, out=iterate.latents.entry_angle)
    model = objective.quadratic_model(objective.with_entry_angles(iterate))
    assert np.abs(model.linearisation.response.load_residual).max() < 1e-3 * problem.load.mean()
