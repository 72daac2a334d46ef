"""Windows in, results out: noise configured wrong, new ground that is not valid yet, and the watch on gaps."""

from dataclasses import replace

import numpy as np
import pytest

from driven_windows import task_of, tasks, windows
from soilbus.decision.traversability import Status
from soilbus.estimation.assembly import effects_of, with_effects
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing, excited

FORMLESS = [f"model.form.{name}=0" for name in ("peak", "peak_by_slip", "exit", "shear")]


@pytest.mark.parametrize("share", [0.25, 4.0])
def test_noise_configured_otherwise_than_it_is_leaves_values_and_stds(share):
    config = reference_configuration(FORMLESS)
    task = next(tasks(config, excited("dry_sand", 10.5), seed=2))
    variance = {name: share * values for name, values in task.window.variance.items()}
    right, wrong = WindowEstimator(config), WindowEstimator(config)
    one, other = right.solve(task), wrong.solve(replace(task, window=replace(task.window, variance=variance)))
    assert (one.status, other.status) == (Status.VALID, Status.VALID)
    for known, found in ((one.bearing, other.bearing), (one.posterior.tan_phi(), other.posterior.tan_phi())):
        assert found.value == pytest.approx(known.value, abs=0.3 * known.std)
        assert found.std == pytest.approx(known.std, rel=0.2)


@pytest.mark.parametrize(("first", "second"), [("wet_clay", "loam"), ("dry_sand", "loam")])
def test_ground_that_has_just_begun_is_not_valid(first, second):
    config = reference_configuration(["estimator.hop=0.25"])
    border, swing = 18.0, Swing(1.4, 1.8)
    soils = (Patch(0.0, first), Patch(border, second))
    scenario = Scenario(13.5, soils, swing, slip=Swing(0.05, 0.4), transition=0.2)
    truth = simulate(config, scenario, seed=2).truth
    begun = float(np.interp(border, truth["distance"], truth["t"]))
    estimator, seen = WindowEstimator(config), 0
    for task in tasks(config, scenario, seed=2):
        result = estimator.solve(task)
        if begun + 0.4 < task.end < begun + 1.4:
            seen += 1
            assert result.status is not Status.VALID
            assert result.traversability.state.value != "go"
    assert seen >= 3


# --- the watch on what the model predicts wrong ---

SECONDS = 75.0
LIMIT = 0.02
"""Share [1] of the pull above which its error is a gap: the driven slope is missing."""
MINUTE = 60.0


def results(effects):
    """Window results of a drive with effects that the configuration does not know of."""
    config = reference_configuration([f"estimator.max_prediction_error={LIMIT}", "estimator.hop=2.0"])
    hidden = effects_of(with_effects(config, effects))
    recording = simulate(config, excited("loam", SECONDS), 4, hidden)
    estimator = WindowEstimator(config)
    for i, (window, end) in enumerate(windows(config, recording)):
        yield estimator.solve(task_of(window, end, config, i))


def test_a_missing_effect_is_told_after_a_minute_by_its_channels():
    told = list(results(["grade=0.1"]))
    first = next(r for r in told if r.gaps)
    assert MINUTE <= first.t - told[0].t < MINUTE + 3.0
    assert next(iter(told[-1].gaps)) == "draft"
    assert told[-1].gaps["draft"] > LIMIT
    assert told[-1].gaps.keys() <= told[-1].prediction_error.keys()


def test_where_nothing_is_missing_no_gap_is_reported():
    assert not any(r.gaps for r in results([]))
