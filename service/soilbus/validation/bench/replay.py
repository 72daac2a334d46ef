"""Bench of replay: a recorded log through the daemon's pipeline, beside python-can reading it without any pipeline.

real-time factor = length of the recording / time of its replay

The time is what passes with reading and estimating in two processes; for one core it is the processor time of one
process, as each worker of `soilbus batch` is one.  Neither has the start in it.
"""

from __future__ import annotations

from pathlib import Path

import can

from soilbus.can.dbc_files import load_databases
from soilbus.offline.replay import estimator_beside, replay
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.reference import reference_configuration
from soilbus.validation.bench.figure import Figure, in_turn, wall_time


def replay_realtime_factor(log: Path, seconds: float) -> Figure:
    """Replay of a log of `seconds` [s] with a hop of 1 s, beside reading it with python-can."""
    config = reference_configuration()

    def whole() -> None:
        with estimator_beside(config) as workers:
            for _ in replay(Pipeline(config, load_databases(config)), [log], workers=workers):
                pass

    def only_read() -> None:
        with can.LogReader(log) as reader:
            for _ in reader:
                pass

    ours, peer = wall_time(whole, 3), wall_time(only_read, 3)
    return Figure(
        seconds / ours, 150.0, f"reading alone {peer:.2f} s, whole replay {ours:.2f} s",
        f"{seconds:.0f} s, four wheels, 1 s hop",
    )  # fmt: skip


def replay_one_core_factor(log: Path, seconds: float) -> Figure:
    """As `replay_realtime_factor`, by processor time of one process."""
    config = reference_configuration()

    def whole() -> None:
        for _ in replay(Pipeline(config, load_databases(config)), [log]):
            pass

    def only_read() -> None:
        with can.LogReader(log) as reader:
            for _ in reader:
                pass

    ours, peer = in_turn((whole, only_read), 3)
    return Figure(
        float(seconds / ours), 300.0, f"processor time: reading alone {peer:.2f} s, whole replay {ours:.2f} s",
        f"{seconds:.0f} s, four wheels, 1 s hop, one process",
    )  # fmt: skip
