"""The share that the model predicts wrong, against wheel forces computed directly."""

from __future__ import annotations

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

    def forces(load, speed, ground):
        """Pull and torque of each wheel."""
        slip = 1.0 - ground[:, None] / (rig.radius * speed)
        state = state_on(soil, np.full(load.shape, 0.2), slip, rig.radius, rig.width)
        return wheel_forces(state._replace(entry_angle=entry_angle_for_load(load, state, MODEL)), MODEL)[1:]

    measured = window.load, window.speed, window.ground_speed
    pull, torque = forces(*measured)
    demand = window.draft + rig.chassis.mass * (GRAVITY * np.sin(window.pitch) + window.acceleration)

    def of_seconds(values: np.ndarray) -> float:
        """Sum of squares of the means of each second."""
        second = np.floor(window.t)
        return sum(float((values[second == s].mean(axis=0) ** 2).sum()) for s in np.unique(second))

    def noise_of_seconds(variance: np.ndarray) -> float:
        """Sum of the variances of the means of each second."""
        second = np.floor(window.t)
        return sum(float(variance[second == s].mean(axis=0).sum() / (second == s).sum()) for s in np.unique(second))

    var = window.variance
    of_torque = np.broadcast_to(var["torque"], torque.shape).copy()
    weight = rig.chassis.mass * GRAVITY
    of_pull = var["draft"] + (weight * np.cos(window.pitch)) ** 2 * var["pitch"]
    of_pull = of_pull + rig.chassis.mass**2 * var["acceleration"]
    for i, quantity in enumerate(("load", "speed", "ground_speed")):
        sd = np.sqrt(var[quantity])
        more = [x + 0.1 * sd if k == i else x for k, x in enumerate(measured)]
        by_pull, by_torque = (
            10.0 * (after - before) for after, before in zip(forces(*more), (pull, torque), strict=True)
        )
        of_torque += by_torque**2
        by_pull = by_pull.sum(axis=1) ** 2 if quantity == "ground_speed" else (by_pull**2).sum(axis=1)
        of_pull = of_pull + by_pull
    thrust = np.abs(window.torque / rig.radius).sum(axis=1)
    expected = {
        "torque": (of_seconds(window.torque - torque) - noise_of_seconds(of_torque), of_seconds(window.torque)),
        "draft": (of_seconds(demand - pull.sum(axis=1)) - noise_of_seconds(of_pull), of_seconds(thrust)),
    }
    assert set(shares) == set(expected)
    for channel, (error, size) in expected.items():
        assert shares[channel].error == pytest.approx(max(error, 0.0), rel=0.02), channel
        assert shares[channel].size == pytest.approx(size, rel=0.02), channel


def test_the_true_soil_predicts_within_a_few_per_cent_and_another_does_not(simulated):
    case = simulated(SOILS["loam"], 3)
    problem, found = case.problem(), {}
    for name in ("loam", "wet_clay"):
        soil, watch = SOILS[name], PredictionWatch(10.0)
        latents = problem.with_entry_angles(problem.start(soil), soil)
        at = problem.linearise(soil, np.zeros(len(problem.gain_std)), latents)
        watch.take(10.0, prediction_shares(problem, at, SINCE, 1.0))
        found[name] = watch.error()
    assert found["loam"] < 0.05
    assert found["wet_clay"] > 0.25


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
