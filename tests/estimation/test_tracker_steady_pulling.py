"""Steady pulling determines little and is no error: an estimate, a decision and no gap in every window."""

import numpy as np
import pytest

from driven_windows import tasks
from soilbus.decision.traversability import State, Status
from soilbus.estimation.assembly import model_of, rig_of
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Profile, Scenario, Swing
from soilbus.terra.soils import soil_named
from soilbus.trials.draft_trials import true_largest_draft

CONFIG = reference_configuration()
STEADY = {"speed": Profile([0, 90], [1.4, 1.4])}


def drive(constant, seconds, spread, shift, border):
    soils = (Patch(0.0, "loam"), Patch(border, "wet_clay"))
    return Scenario(seconds, soils, draft=constant, slip_spread=spread, side_shift=Swing(-shift, shift), **STEADY)


BEFORE = Profile([0, 10, 20, 30, 36, 42, 48, 50, 90], [2000, 3500, 2200, 3800, 300, 800, 200, 500, 500])
CASES = [
    (drive(BEFORE, 90.0, 0.001, 0.01, 42.0), 1),
    (drive(Profile([0, 90], [600, 600]), 90.0, 0.003, 0.02, 42.0), 3),
]
END = 62.0
"""Time [s] to which the drives are looked at."""


@pytest.mark.parametrize(("scenario", "seed"), CASES)
def test_constant_draft_after_a_border_leaves_no_gap(scenario, seed):
    estimator, clay = WindowEstimator(CONFIG), soil_named("wet_clay")
    results = [estimator.solve(task) for task in tasks(CONFIG, scenario, seed) if task.end < END]
    for result in results:
        assert result.status in (Status.VALID, Status.NOT_EXCITED)
        assert result.posterior is not None
        assert result.traversability.max_draft is not None or result.reason == "not_excited new_soil"
        assert result.traversability.state is not State.GO or result.status is Status.VALID
    assert sum(result.traversability.max_draft is None for result in results) <= 4  # the border
    rig, largest = rig_of(CONFIG), CONFIG.traversability.max_slip
    truth = true_largest_draft(clay, rig, np.full(len(rig.wheels), np.inf), largest, model_of(CONFIG))
    for result in results[-10:]:  # the pressure at 2 cm slides along n, which nothing excites; the draft does not
        assert result.reason.split()[0] in ("none", "not_excited")
        most = result.traversability.max_draft
        assert abs(most.value - truth) < 3.0 * most.std
