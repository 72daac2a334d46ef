"""The daemon's watch on chi-square by channel."""

from __future__ import annotations

import numpy as np
import pytest

from soilbus.estimation.assembly import effects_of, rig_of, with_effects
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.intake import WindowTask
from soilbus.pipeline.model_gap import GapWatch, Square
from soilbus.pipeline.positions import PositionTrack
from soilbus.sensors.bins import Bins
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited

SECONDS = 90.0
MINUTE = 60.0


def results(effects):
    """Window results of a drive with effects that the configuration does not know of."""
    config = reference_configuration()
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
    told = list(results(["inertia=0.5"]))
    first = next(r for r in told if r.gaps)
    assert MINUTE <= first.t - told[0].t < MINUTE + 3.0
    assert next(iter(told[-1].gaps)) == "draft"
    assert told[-1].gaps["draft"] > 1.5


def test_where_nothing_is_missing_no_gap_is_reported():
    assert not any(r.gaps for r in results([]))


def test_a_channel_counts_by_its_own_residuals_and_is_forgotten():
    watch = GapWatch(window=10.0, hop=1.0)
    for t in range(100):
        watch.take(float(t), {"torque": Square(400.0, 400), "draft": Square(150.0, 100)})
    assert watch.gaps() == {"draft": pytest.approx(1.5)}
    assert watch.chi2() == {"torque": pytest.approx(1.0), "draft": pytest.approx(1.5)}
    for t in range(100, 300):
        watch.take(float(t), {"torque": Square(400.0, 400), "draft": Square(100.0, 100)})
    assert watch.gaps() == {}
    watch.forget()
    assert watch.gaps() == {}


def test_noise_alone_is_no_gap_however_few_residuals_there_are():
    """One residual a second, in windows of ten seconds each second: each counts ten times and is still one."""
    window, gaps = 10, []
    for seed in range(100):
        square = np.random.default_rng(seed).standard_normal(300) ** 2
        watch = GapWatch(window=float(window), hop=1.0)
        for end in range(window, len(square)):
            watch.take(float(end), {"draft": Square(float(square[end - window : end].sum()), window)})
            gaps += watch.gaps().values()
    assert gaps == []


def test_a_gap_beyond_noise_is_reported_of_few_residuals_too():
    square = 2.5 * np.random.default_rng(1).standard_normal(300) ** 2
    watch = GapWatch(window=10.0, hop=1.0)
    for end in range(10, len(square)):
        watch.take(float(end), {"draft": Square(float(square[end - 10 : end].sum()), 10)})
    assert watch.gaps()["draft"] == pytest.approx(2.5, rel=0.3)
