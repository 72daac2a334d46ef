"""Failed fits are reported, counted by kind and become no prior; ambiguous windows are reported as such."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Publisher
from soilbus.decision.traversability import State, Status
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.posterior import Posterior
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.states import ServiceState, state_after
from soilbus.report.windows import summary
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario
from soilbus.terra.soils import SOILS
from tests.lab import driven_windows
from tests.lab.driven_windows import tasks

CONFIG = reference_configuration()
BAD = 10
"""Which window of the drive is spoilt: the first that builds on an earlier one."""
QUANTITIES = ("torque", "load", "speed", "sinkage", "ground_speed", "draft")


@pytest.fixture(scope="module")
def drive():
    scenario = Scenario(22.0, (Patch(0.0, "loam"),), slip=driven_windows.EXCITED)
    return list(tasks(CONFIG, scenario, 3))


@pytest.fixture(scope="module")
def undisturbed(drive):
    estimator = WindowEstimator(CONFIG)
    return [estimator.solve(task) for task in drive]


def spoilt(window, kind):
    rng = np.random.default_rng(7)

    def changed(column):
        match kind:
            case "all nan":
                return np.full_like(column, np.nan)
            case "all inf":
                return np.full_like(column, np.inf)
            case "spikes":
                return column * np.where(rng.random(column.shape) < 0.2, 1e3, 1.0)
            case "signs":
                return column * rng.choice([-1.0, 1.0], column.shape)
            case "noise":
                return np.abs(column) * 10.0 ** rng.normal(0.0, 1.0, column.shape)
            case _:
                return np.full_like(column, 1e-12)

    return replace(window, **{q: changed(getattr(window, q)) for q in QUANTITIES})


@pytest.fixture(scope="module")
def without_it(drive):
    """What the other windows say where one never came."""
    estimator = WindowEstimator(CONFIG)
    return [estimator.solve(task) if task.index != BAD else None for task in drive]


@pytest.mark.parametrize("kind", ["all nan", "all inf", "spikes", "signs", "noise", "all alike"])
def test_garbage_between_good_windows_changes_nothing_after_it(kind, drive, without_it):
    estimator = WindowEstimator(CONFIG)
    for task, expected in zip(drive, without_it, strict=True):
        if task.index == BAD:
            bad = estimator.solve(replace(task, window=spoilt(task.window, kind)))
            assert bad.status in (Status.INVALID, Status.DEGRADED, Status.NOT_EXCITED)
            assert bad.traversability.state is not State.GO
            assert bad.reason != "none"
            continue
        got = estimator.solve(task)
        assert (got.status, got.reason) == (expected.status, expected.reason)
        pairs = [(got.bearing, expected.bearing), (got.posterior.tan_phi(), expected.posterior.tan_phi())]
        for one, other in pairs:
            assert abs(one.value - other.value) < 0.05 * other.std
            assert one.std == pytest.approx(other.std, rel=0.02)


def test_failures_have_their_kind(drive, undisturbed):
    assert {r.failure for r in undisturbed} == {None}

    def failure(**columns):
        task = drive[0]
        return WindowEstimator(CONFIG).solve(replace(task, window=replace(task.window, **columns)))

    window = drive[0].window
    opposed = failure(torque=-window.torque)
    assert (opposed.failure, opposed.reason) == ("model_mismatch", "model_mismatch")
    immense = failure(torque=np.full_like(window.torque, 1e300))
    assert (immense.failure, immense.status, immense.reason) == ("not_finite", Status.INVALID, "no_convergence")
    assert immense.posterior is None
    standing = failure(ground_speed=np.zeros_like(window.ground_speed))
    assert (standing.failure, standing.reason) == (None, "standstill")


def test_a_replay_counts_failed_solves(drive, undisturbed):
    pipeline = Pipeline(CONFIG, load_databases(CONFIG))
    assert "failed solves none\n" in summary(undisturbed, pipeline)
    some = [
        replace(r, failure=kind) for r, kind in zip(undisturbed, ["no_convergence", "not_finite"] * 2, strict=False)
    ]
    assert "failed solves no_convergence 2, not_finite 1\n" in summary(some[:3], pipeline)


# --- two soils explain a window equally well ---

TWO = driven_windows.two_wheels(CONFIG)


def results_on(config, soil, seed, seconds=11.0):
    scenario = Scenario(seconds, (Patch(0.0, soil),), slip=driven_windows.EXCITED)
    estimator = WindowEstimator(config)
    return [estimator.solve(task) for task in tasks(config, scenario, seed)]


def test_an_ambiguous_window_says_so_and_never_go():
    config = TWO
    problem = driven_windows.observed_window(config, "wet_clay", seed=3)
    fit = fit_window(problem, prior_of(config))
    one, other = (
        fit.mode.posterior.bearing_pressure(0.02, 0.3),
        fit.second_mode.gaussian.posterior.bearing_pressure(0.02, 0.3),
    )
    assert abs(one.value - other.value) > 2.0 * one.std
    scenario = Scenario(10.0, (Patch(0.0, "wet_clay"),), slip=driven_windows.EXCITED)
    result = WindowEstimator(config).solve(next(tasks(config, scenario, 3)))
    assert (result.status, result.reason) == (Status.NOT_EXCITED, "ambiguous")
    assert result.traversability.state is not State.GO
    assert result.failure is None
    assert state_after(result) is ServiceState.LISTENING
    true = Posterior(SOILS["wet_clay"], np.zeros((6, 6))).bearing_pressure(0.02, 0.3).value
    assert abs(result.bearing.value - true) < 2.0 * result.bearing.std  # it still reports, wider than either optimum
    assert result.bearing.std > 2.0 * one.std
    database = output_database(config)
    status = {"State": "listening", "Reason": "ambiguous", "RejectedShare": 0.0, "DeadlineMisses": 0, "Window": 0}
    frame = Publisher(database).frame("SoilbusStatus", status)
    assert database.decode_message(frame.arbitration_id, bytes(frame.data))["Reason"] == "ambiguous"


def test_excited_windows_of_four_wheels_are_not_ambiguous():
    for soil in driven_windows.NAMES:
        for seed in range(2):
            reasons = Counter(r.reason for r in results_on(CONFIG, soil, seed, 10.0))
            assert "ambiguous" not in reasons


def test_one_of_two_optima_becomes_no_prior():
    scenario = Scenario(12.0, (Patch(0.0, "wet_clay"),), slip=driven_windows.EXCITED)
    estimator = WindowEstimator(TWO)
    n_ambiguous = 0
    for task in tasks(TWO, scenario, 3):
        result = estimator.solve(task)
        if result.reason == "ambiguous":
            n_ambiguous += 1
            assert not estimator._tracker._posteriors
    assert n_ambiguous > 0
