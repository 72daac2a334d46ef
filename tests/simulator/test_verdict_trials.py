"""Calls beside the truth: the figures against independent formulas."""

import math

import numpy as np
import pytest

from soilbus.decision.traversability import State
from soilbus.estimation.assembly import rig_of
from soilbus.estimation.posterior import NORMAL_95
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import SOILS
from soilbus.terra.vehicle import axle_loads
from soilbus.terra.wheel import WheelModel, sinkage, state_on
from soilbus.trials.draft_trials import true_largest_draft
from soilbus.trials.verdict_trials import Call, reliability, trial, wilson

CONFIG = reference_configuration()


def calls_of(p, true):
    return [
        Call("x", float(q), State.GO if q >= 0.95 else State.CAUTION, "slip", bool(t))
        for q, t in zip(p, true, strict=True)
    ]


@pytest.mark.parametrize(("hits", "n"), [(0, 1), (3, 3), (5, 17), (40, 100)])
def test_the_interval_is_wilson_s(hits, n):
    """Both ends p are NORMAL_95 standard deviations of a frequency with this p from what was found (Wilson 1927)."""
    for p in wilson(hits, n):
        assert (hits / n - p) ** 2 == pytest.approx(NORMAL_95**2 * p * (1.0 - p) / n, rel=1e-6, abs=1e-12)
    assert wilson(hits, n)[0] <= hits / n <= wilson(hits, n)[1]
    assert wilson(0, 0) == (0.0, 1.0)


def test_calibrated_calls_look_calibrated_and_bold_ones_do_not():
    rng = np.random.default_rng(1)
    p = rng.uniform(size=4000)
    true = rng.random(4000) < p
    found = reliability(calls_of(p, true))
    assert found.brier == pytest.approx(np.mean((p - true) ** 2))
    assert found.brier_expected == pytest.approx(1.0 / 6.0, abs=0.005)  # of uniform p
    scores = [np.mean((p - (rng.random(4000) < p)) ** 2) for _ in range(400)]
    assert found.brier_std == pytest.approx(np.std(scores), rel=0.15)  # sampling: 3.5 %
    assert abs(found.brier - found.brier_expected) < 3.0 * found.brier_std
    assert abs(found.excess) < 3.0
    assert len(found.bins) >= 8
    assert sum(b.least <= b.mean <= b.most for b in found.bins) >= len(found.bins) - 2
    assert sum(b.calls for b in found.bins) == 4000
    assert found.go == np.sum(p >= 0.95)
    assert found.wrong_go == np.sum((p >= 0.95) & ~true)
    assert found.wrong_go_expected == pytest.approx(np.sum(1.0 - p[p >= 0.95]))
    bold = reliability(calls_of(np.sqrt(p), true))
    assert bold.excess < -10.0
    assert bold.brier > bold.brier_expected + 3.0 * bold.brier_std


def test_drives_without_a_call_are_counted():
    found = reliability([Call("x", math.nan, State.UNKNOWN, None, True), *calls_of([1.0], [True])])
    assert (found.drives, found.failed, found.brier, found.bins[-1].calls) == (2, 1, 0.0, 1)
    assert math.isnan(reliability([]).brier)


def test_a_sinkage_limit_binds_the_truth():
    rig, soil, model = rig_of(CONFIG), SOILS["loam"], WheelModel()

    def most(limit: float) -> float:
        return true_largest_draft(soil, rig, np.full(4, np.nan), 0.6, model, limit)

    axles = axle_loads(rig.chassis, most(math.inf), 0.0, 0.0)
    load = np.where(rig.front, axles[0], axles[1]) / 2.0
    state = state_on(soil, np.full(4, np.nan), np.full(4, 0.6), rig.radius, rig.width)
    deepest = sinkage(entry_angle_for_load(load, state, model), rig.radius).max()
    assert most(1.0001 * deepest) == most(math.inf)
    assert not most(0.9999 * deepest) >= most(math.inf)


def test_what_the_service_does_not_call_valid_is_never_called_go():
    strict = CONFIG.estimator.model_copy(update={"max_bearing_std": 1e-6})
    sure, unsure = (trial(c, 5) for c in (CONFIG, CONFIG.model_copy(update={"estimator": strict})))
    assert (sure.state, unsure.state) == (State.GO, State.CAUTION)
    assert sure.probability == unsure.probability > 0.95
