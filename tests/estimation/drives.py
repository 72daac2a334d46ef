"""Windows of simulated drives as the daemon's estimator gets them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from soilbus.assembly import rig_of
from soilbus.config import Config
from soilbus.daemon.intake import WindowTask
from soilbus.daemon.positions import PositionTrack
from soilbus.estimation.window import BinStore, Window
from soilbus.simulator.recording import simulate
from soilbus.simulator.scenario import Scenario


def task_of(window: Window, end: float, config: Config, index: int = 0) -> WindowTask:
    """What the intake says of a window of which nothing is missing; the first has index 0."""
    wheels = rig_of(config).wheels
    return WindowTask(
        index=index, start=end - config.estimator.window, end=end, window=window, slip=dict.fromkeys(wheels),
        missing=(), poor=(), torque_limit=np.full(len(wheels), np.nan), track=PositionTrack({}), rejected={},
        fresh=index == 0,
    )  # fmt: skip


def tasks(config: Config, scenario: Scenario, seed: int, without: str = "none") -> Iterator[WindowTask]:
    """The windows of a drive, hop by hop, but for the channels of one quantity."""
    rig, channels = rig_of(config), simulate(config, scenario, seed).channels
    wanted = [c for c in rig.channels if c in channels and c.partition(".")[0] != without]
    store = BinStore(rig, config.estimator.bin, 0.0)
    store.add({c: (channels[c].t, channels[c].value) for c in wanted})
    length = config.estimator.window
    for i, end in enumerate(np.arange(length, scenario.duration + 0.05, config.estimator.hop).tolist()):
        yield task_of(store.window(end - length, end), end, config, i)
