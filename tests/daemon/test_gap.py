"""The daemon's watch on chi-square by channel."""

from __future__ import annotations

from driven_windows import task_of, windows
from soilbus.estimation.assembly import effects_of, with_effects
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited

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
