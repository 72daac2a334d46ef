"""Bench on a recorded log: decoding beside cantools, replay beside python-can alone, and the time of each window.

real-time factor = length of the recording / time of its replay

The time is what passes with reading and estimating in two processes; for one core it is the processor time of one
process, as each worker of `soilbus batch` is one.  Neither has the start in it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from soilbus.can.dbc_files import load_databases
from soilbus.can.decode import ColumnDecoder
from soilbus.can.mapping import channels_of
from soilbus.config.model import Config
from soilbus.grouping import grouped
from soilbus.offline.replay import estimator_beside, read_frames, read_log, replay
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.reference import reference_configuration
from soilbus.trials.bench.figure import Figure, in_turn, wall_time

WINDOW_FRAMES = 500
"""Frames of a message in 10 s at 50 Hz."""
ROUNDS = 4
"""Runs over the log, of which the least time of each window counts."""
MAX_WINDOW_MS = 10.0
"""Target of a window's median processor time [ms]."""


def decode_speedup(log: Path) -> Figure:
    """Compare decoding of all mapped signals, 500 frames at a time, with cantools frame by frame."""
    config = reference_configuration()
    database = load_databases(config)
    wanted = grouped(channels_of(config, database), lambda channel: channel.message)
    payloads: dict[str, list[bytes]] = {name: [] for name in wanted}
    names = {m.frame_id: m.name for m in database.messages}
    for message in read_log(log):
        if (name := names.get(message.arbitration_id)) in payloads:
            payloads[name].append(bytes(message.data))
    decoders = {n: ColumnDecoder(database.get_message_by_name(n), [c.signal for c in of]) for n, of in wanted.items()}
    cut = range(0, max(map(len, payloads.values())), WINDOW_FRAMES)
    windows = [(n, w) for n, f in payloads.items() for i in cut if (w := f[i : i + WINDOW_FRAMES])]

    def columns() -> None:
        for name, window in windows:
            raw = np.frombuffer(b"".join(window), np.uint8).reshape(len(window), -1)
            decoders[name].columns(raw)

    def one_by_one() -> None:
        for name, window in windows:
            decode = database.get_message_by_name(name).decode
            for data in window:
                decode(data, decode_choices=False)

    ours, peer = wall_time(columns, 5), wall_time(one_by_one, 2)
    return Figure(
        peer / ours, 20.0, f"cantools {peer:.3f} s, ours {ours:.4f} s",
        f"{sum(map(len, payloads.values()))} frames, windows of {WINDOW_FRAMES}",
    )  # fmt: skip


def replay_factors(log: Path, seconds: float) -> dict[str, Figure]:
    """Compare the replay of a log of `seconds` [s] with reading it by python-can."""
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
            seconds / one_core, 100.0,
            f"processor time: reading alone {reading:.2f} s, whole replay {one_core:.2f} s", f"{what}, one process",
        ),
    }  # fmt: skip


def window_times(log: Path) -> dict[str, Figure]:
    """Return the least processor time [ms] of a window: its estimate alone, and with intake and decision."""
    config = reference_configuration()
    intake, estimate, decision = 1e3 * np.min([list(seconds_of_windows(log, config)) for _ in range(ROUNDS)], axis=0).T
    whole = intake + estimate + decision
    count = f"{len(whole)} windows of 10 s, 1 s hop, four wheels"
    parts = f"intake {np.median(intake):.1f}, decision {np.median(decision):.1f}"
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
    """Yield the processor seconds (3,) of intake, estimate and decision of each window of a log."""
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
