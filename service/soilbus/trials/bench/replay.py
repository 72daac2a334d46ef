"""Bench of replay: a recorded log through the daemon's pipeline, beside python-can reading it without any pipeline.

real-time factor = length of the recording / time of its replay

The time is what passes with reading and estimating in two processes; for one core it is the processor time of one
process, as each worker of `soilbus batch` is one.  Neither has the start in it.
"""

from __future__ import annotations

from pathlib import Path

from soilbus.can.dbc_files import load_databases
from soilbus.offline.replay import estimator_beside, read_log, replay
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.reference import reference_configuration
from soilbus.trials.bench.figure import Figure, in_turn, wall_time


def replay_factors(log: Path, seconds: float) -> dict[str, Figure]:
    """Replay of a log of `seconds` [s] with a hop of 1 s, beside reading it with python-can."""
    config = reference_configuration()

    def beside() -> None:
        with estimator_beside(config) as workers:
            for _ in replay(Pipeline(config, load_databases(config)), [log], workers=workers):
                pass

    def alone() -> None:
        for _ in replay(Pipeline(config, load_databases(config)), [log]):
            pass

    def only_read() -> None:
        for _ in read_log(log):
            pass

    what = f"{seconds:.0f} s, four wheels, 1 s hop"
    wall, (one_core, reading) = wall_time(beside, 3), in_turn((alone, only_read), 3).tolist()
    return {
        "replay_realtime_factor": Figure(
            seconds / wall, 150.0, f"reading alone {wall_time(only_read, 3):.2f} s, whole replay {wall:.2f} s", what
        ),
        "replay_one_core_factor": Figure(
            seconds / one_core, 300.0,
            f"processor time: reading alone {reading:.2f} s, whole replay {one_core:.2f} s", f"{what}, one process",
        ),
    }  # fmt: skip
