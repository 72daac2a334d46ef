"""Bench of the service: processor time of each window of a log, split into intake, estimate and decision."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from soilbus.can.dbc_files import load_databases
from soilbus.config.model import Config
from soilbus.offline.replay import read_frames
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.reference import reference_configuration
from soilbus.trials.bench.figure import Figure

ROUNDS = 4
"""Runs over the log, of which the least time of each window counts."""
MAX_WINDOW_MS = 10.0
"""Target of a window's median processor time [ms]."""


def window_times(log: Path) -> dict[str, Figure]:
    """Processor time [ms] of a window: its estimate, and all that the service does for it.

    Notes
    -----
    A window's time is the least of several rounds. window_ms is the estimate from bins to posterior and status (the
    tracker's); service_window_ms has decoding, binning and outlier test of the last hop and the decision besides.
    """
    config = reference_configuration()
    intake, estimate, decision = 1e3 * np.min([list(seconds_of_windows(log, config)) for _ in range(ROUNDS)], axis=0).T
    whole = intake + estimate + decision
    count = f"{len(whole)} windows of 10 s, 1 s hop, four wheels"
    parts = ", ".join(
        f"{name} {np.median(part):.1f}" for name, part in (("intake", intake), ("decision", decision))
    )  # fmt: skip
    return {
        "window_ms": Figure(
            float(np.median(estimate)), MAX_WINDOW_MS,
            f"90 %: {np.quantile(estimate, 0.9):.1f} ms, the first (cold): {estimate[0]:.1f} ms",
            f"median of {count}", at_most=True,
        ),
        "service_window_ms": Figure(
            float(np.median(whole)), MAX_WINDOW_MS, f"90 %: {np.quantile(whole, 0.9):.1f} ms",
            f"the same with {parts} ms", at_most=True,
        ),
    }  # fmt: skip


def seconds_of_windows(log: Path, config: Config) -> Iterator[NDArray[np.float64]]:
    """Processor seconds (3,) of intake, estimate and decision of each window of a log under a configuration."""
    pipeline = Pipeline(config, load_databases(config))
    intake, estimator = pipeline.intake, pipeline.estimator
    due = -np.inf
    for t, identifier, extended, data, remote, _ in read_frames(log):
        if t >= due:
            marks = [time.process_time()]
            for task in intake.due(t):
                marks.append(time.process_time())
                undecided = estimator.estimate(task)
                marks.append(time.process_time())
                estimator.decide(undecided)
                marks.append(time.process_time())
                yield np.diff(marks)
                marks = marks[-1:]
            due = min(intake.next_end, t + config.estimator.hop)
        intake.admission.feed(t, identifier, extended, data, remote)
