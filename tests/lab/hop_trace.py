"""How much code one hop of the estimator enters: files, functions and calls of this package.

    files      distinct source files of soilbus with at least one call
    functions  distinct code objects (functions, methods, generators, nested functions) called
    calls      entries into them; each resumption of a generator is one

The reference tractor's simulated drive on loam goes through the service's own pipeline. The windows before the last
are solved without a trace, so that caches are filled and the tracker follows its soil; the last one is solved under
`sys.setprofile`, which reports every call of a Python function. The counts are a measure of how much a reader must
follow, not of time. They are of estimate and decision; the watch for immobilisation runs at 10 Hz beside.

    python -m tests.lab.hop_trace
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, NamedTuple

import soilbus
from soilbus.can.dbc_files import load_databases
from soilbus.pipeline.intake import WindowTask
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited

PACKAGE = str(Path(soilbus.__file__).parent)
WARM_HOPS = 10
"""Windows solved before the traced one: one window's length of hops, after which no datum of the first is left."""
SEED = 1
"""Picks the simulated drive."""


class HopTrace(NamedTuple):
    """Distinct files and functions of soilbus that one hop enters, and its calls."""

    files: int
    functions: int
    calls: int


def hop_trace(warm_hops: int = WARM_HOPS) -> HopTrace:
    """Counts of the hop after `warm_hops` of the reference tractor's drive.

    Raises RuntimeError where the drive is too short for that many windows.
    """
    config = reference_configuration()
    settings = config.estimator
    duration = settings.window + (warm_hops + 1) * settings.hop
    database = load_databases(config)
    pipeline = Pipeline(config, database)
    solve = pipeline.estimator.solve_unwatched
    solved, due = 0, 0.0
    for message in frames(simulate(config, excited("loam", duration), SEED), config, database):
        pipeline.feed(
            message.timestamp, message.arbitration_id, message.is_extended_id, message.data, message.is_remote_frame
        )  # fmt: skip
        if message.timestamp < due:
            continue
        for task in pipeline.intake.due(message.timestamp):
            if solved == warm_hops:
                return traced(solve, task)
            solve(task)
            solved += 1
        due = min(pipeline.intake.next_end, message.timestamp + settings.hop)
    raise RuntimeError(f"the drive of {duration:g} s holds {solved} windows, not {warm_hops + 1}")


def traced(solve: Callable[[WindowTask], object], task: WindowTask) -> HopTrace:
    """Counts of one call of a method of `WindowEstimator` with a task."""
    calls: Counter[CodeType] = Counter()

    def enter(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            calls[frame.f_code] += 1

    usual = sys.getprofile()
    sys.setprofile(enter)
    try:
        solve(task)
    finally:
        sys.setprofile(usual)
    return HopTrace(len({code.co_filename for code in calls}), len(calls), calls.total())


def main() -> None:
    """Print the counts."""
    found = hop_trace()
    print(f"one hop enters {found.files} files, {found.functions} functions, {found.calls} calls of soilbus")


if __name__ == "__main__":
    main()
