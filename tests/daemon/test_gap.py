"""The daemon's watch on chi-square by channel."""

from __future__ import annotations

import numpy as np
import pytest

from soilbus.estimation.assembly import effects_of, rig_of, with_effects
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.intake import WindowTask
from soilbus.pipeline.model_gap import Square, Sums
from soilbus.pipeline.positions import PositionTrack
from soilbus.sensors.bins import Bins
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
    rig, length = rig_of(config), config.estimator.window
    store = Bins(rig, config.estimator.bin, 0.0)
    store.add({n: (c.t, c.value) for n, c in recording.channels.items() if n in rig.channels})
    estimator = WindowEstimator(config)
    for i, end in enumerate(np.arange(length, SECONDS + 0.05, config.estimator.hop).tolist()):
        yield estimator.solve(
            WindowTask(
                index=i, start=end - length, end=end, window=store.window(end - length, end),
                slip=dict.fromkeys(rig.wheels), missing=(), poor=(), torque_limit=np.full(len(rig.wheels), np.nan),
                track=PositionTrack({}), rejected={}, fresh=i == 0,
            )
        )  # fmt: skip


def test_a_missing_effect_is_told_after_a_minute_by_its_channels():
    told = list(results(["grade=0.1"]))
    first = next(r for r in told if r.gaps)
    assert MINUTE <= first.t - told[0].t < MINUTE + 3.0
    assert next(iter(told[-1].gaps)) == "draft"
    assert told[-1].gaps["draft"] > LIMIT
    assert told[-1].gaps.keys() <= told[-1].prediction_error.keys()


def test_where_nothing_is_missing_no_gap_is_reported():
    assert not any(r.gaps for r in results([]))


def test_a_channel_counts_by_its_own_residuals_and_is_forgotten():
    watch = Sums(120.0)
    for t in range(100):
        watch.take(float(t), {"torque": Square(400.0, 400), "draft": Square(150.0, 100)})
    assert watch.ratios() == {"torque": pytest.approx(1.0), "draft": pytest.approx(1.5)}
    for t in range(100, 300):
        watch.take(float(t), {"torque": Square(400.0, 400), "draft": Square(100.0, 100)})
    assert watch.ratios() == {"torque": pytest.approx(1.0), "draft": pytest.approx(1.0)}
