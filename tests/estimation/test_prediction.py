"""The share that the model predicts wrong, against wheel forces computed directly."""

import numpy as np
import pytest

from soilbus.estimation.prediction import prediction_shares
from soilbus.pipeline.model_gap import PredictionWatch
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import SOILS
from soilbus.terra.vehicle import GRAVITY
from soilbus.terra.wheel import WheelModel, state_on, wheel_forces

MODEL, SINCE = WheelModel(), 7.0


@pytest.mark.parametrize("predicting", ["loam", "wet_clay"])
def test_shares_are_those_of_forces_at_measured_loads_and_slips(predicting, simulated):
    case, soil = simulated(SOILS["loam"], 3), SOILS[predicting]
    problem = case.problem()
    none = np.zeros(len(problem.gain_std))
    at = problem.linearise(soil, none, problem.with_entry_angles(problem.start(soil), soil))
    shares = prediction_shares(problem, at, SINCE, 1.0)

    new = case.window.t > SINCE
    window, rig = case.window.rows(np.flatnonzero(new)), case.rig
    slip = 1.0 - window.ground_speed[:, None] / (rig.radius * window.speed)
    state = state_on(soil, np.full(window.load.shape, 0.2), slip, rig.radius, rig.width)
    state = state._replace(entry_angle=entry_angle_for_load(window.load, state, MODEL))
    _, pull, torque = wheel_forces(state, MODEL)
    demand = window.draft + rig.chassis.mass * (GRAVITY * np.sin(window.pitch) + window.acceleration)

    def of_seconds(values: np.ndarray) -> float:
        """Sum of squares of the means of each second."""
        second = np.floor(window.t)
        return sum(float((values[second == s].mean(axis=0) ** 2).sum()) for s in np.unique(second))

    def noise_of_seconds(values: np.ndarray) -> float:
        """Sum of the variances of the means of each second, by the scatter within it."""
        second = np.floor(window.t)
        parts = (values[second == s] for s in np.unique(second))
        return sum(float(part.var(axis=0, ddof=1).sum() / len(part)) for part in parts)

    thrust = np.abs(window.torque / rig.radius).sum(axis=1)
    off, missing = window.torque - torque, demand - pull.sum(axis=1)
    expected = {
        "torque": (of_seconds(off) - noise_of_seconds(off), of_seconds(window.torque)),
        "draft": (of_seconds(missing) - noise_of_seconds(missing), of_seconds(thrust)),
    }
    assert set(shares) == set(expected)
    for channel, (error, size) in expected.items():
        assert shares[channel].error == pytest.approx(max(error, 0.0), rel=0.02), channel
        assert shares[channel].size == pytest.approx(size, rel=0.02), channel


def test_nothing_new_is_no_prediction(simulated):
    case = simulated(SOILS["loam"], 3)
    problem = case.problem()
    at = problem.linearise(case.soil, np.zeros(len(problem.gain_std)), problem.start(case.soil))
    assert prediction_shares(problem, at, float(problem.t[-1]), 1.0) == {}


def test_a_watch_averages_squares_over_the_last_window_and_reports_gaps_of_minutes():
    watch = PredictionWatch(10.0)
    assert (watch.shares(), watch.error(), watch.gaps(0.25)) == ({}, 0.0, {})
    for end in np.arange(1.0, 101.0):
        wrong = 0.09 if end > 90.0 else 0.16
        watch.take(end, {"torque": (wrong * 4.0, 4.0), "draft": (0.01, 1.0)})
    assert watch.shares() == pytest.approx({"torque": 0.3, "draft": 0.1})
    assert watch.error() == pytest.approx(0.3)
    assert watch.gaps(0.25) == pytest.approx({"torque": np.sqrt(0.9 * 0.16 + 0.1 * 0.09)})
    assert watch.gaps(0.5) == {}
