"""Failed fits are reported, counted by kind and become no prior."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

import driven_windows
from driven_windows import tasks
from soilbus.can.dbc_files import load_databases
from soilbus.decision.traversability import State, Status
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.pipeline import Pipeline
from soilbus.report.windows import summary
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario

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
def before(drive):
    """The estimator after the good windows before."""
    estimator = WindowEstimator(CONFIG)
    for task in drive[:BAD]:
        estimator.solve(task)
    return estimator


@pytest.fixture(scope="module")
def without_it(drive, before):
    """What the windows after it say where it never came."""
    estimator = deepcopy(before)
    return [estimator.solve(task) for task in drive[BAD + 1 :]]


@pytest.mark.parametrize("kind", ["all nan", "all inf", "spikes", "signs", "noise", "all alike"])
def test_garbage_between_good_windows_changes_nothing_after_it(kind, drive, before, without_it):
    estimator = deepcopy(before)
    bad = estimator.solve(replace(drive[BAD], window=spoilt(drive[BAD].window, kind)))
    assert bad.status in (Status.INVALID, Status.DEGRADED, Status.NOT_EXCITED)
    assert bad.traversability.state is not State.GO
    assert bad.reason != "none"
    for task, expected in zip(drive[BAD + 1 :], without_it, strict=True):
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
    assert (opposed.failure, opposed.status, opposed.reason) == (None, Status.INVALID, "model_mismatch")
    assert opposed.posterior is None  # where a descent ended without an optimum there is nothing to say
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
