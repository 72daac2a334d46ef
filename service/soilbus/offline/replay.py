"""Recorded logs through the daemon's own pipeline, as fast as it can.

    log -> frames -> intake -> window tasks -> estimator (in a process beside, where there are two cores) -> results

Each log is a recording of its own with its own clock; windows are numbered on over all logs. Reading and estimating
overlap in two processes, and the results are the same as in one.
"""

from __future__ import annotations

import math
import os
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing import get_all_start_methods
from pathlib import Path

import can

from soilbus.can.admission import LONGEST_GAP, Admission
from soilbus.can.candump import Frame
from soilbus.can.columns import mapped_columns
from soilbus.can.logs import Log, LogError, OtherBus, read_frames
from soilbus.config.model import Config
from soilbus.offline.columns import SignalTable
from soilbus.pipeline.estimator import Undecided, WindowEstimator
from soilbus.pipeline.intake import Intake, WindowTask
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.words import LONGEST_NAME, shown
from soilbus.workers import workers

__all__ = ["LogError", "OtherBus", "estimator_beside", "fed", "log_names", "read_frames", "read_log", "replay"]

SWITCH_INTERVAL = 0.0002
"""Time [s] after which the interpreter switches threads, so that the pool's thread can hand on tasks."""
MAX_PENDING_WINDOWS = 30
"""Windows that may wait for the estimator."""


def read_log(path: Path) -> Iterator[can.Message]:
    """Yield the frames of read_frames() as messages of python-can."""
    for t, identifier, extended, data, remote, error in read_frames(path):
        yield can.Message(
            timestamp=t, arbitration_id=identifier, is_extended_id=extended, data=data, is_remote_frame=remote,
            is_error_frame=error, is_fd=len(data) > 8,
        )  # fmt: skip


def log_names(logs: Sequence[Path]) -> list[str]:
    """Return a name for each log: the shortest end of its path that no other log has, as `shown`.

    Logs whose names are alike all the same, as one that is given twice, have a number too.
    """
    paths = [path.absolute().parts for path in logs]
    ends = Counter(parts[-n:] for parts in set(paths) for n in range(1, len(parts) + 1))
    seen: Counter[str] = Counter()
    names = []
    for parts in paths:
        n = next(n for n in range(1, len(parts) + 1) if ends[parts[-n:]] == 1)
        name = shown(Path(*parts[-n:]), LONGEST_NAME)
        seen[name] += 1
        names.append(name + (f" ({seen[name]})" if seen[name] > 1 else ""))
    return names


def replay(
    pipeline: Pipeline,
    logs: Sequence[Path],
    progress: Callable[[int, float], None] | None = None,
    workers: Executor | None = None,
    on_fault: Callable[[LogError], None] | None = None,
) -> Iterator[WindowResult]:
    """Yield the result of every window of the logs, one after the other, each with the name of its `log`.

    The pipeline counts frames and refusals of all logs, and numbers their windows on. With `workers`, an executor of
    `estimator_beside`, reading and estimating overlap, with the same results. `progress` is called now and then with
    the number of frames read and the time in the recording [s]; `on_fault` with the error of a log that is damaged or
    of another bus, after which the next log follows; where it is None the LogError comes after the windows before.
    """
    tasks = _tasks(pipeline, logs, progress, on_fault)
    if workers is None:
        for name, task in tasks:
            yield replace(pipeline.estimator.solve(task), log=name)
        return
    decide = pipeline.estimator.decide
    pending: deque[tuple[str, Future[Undecided]]] = deque()
    fault: LogError | None = None

    def decided() -> WindowResult:
        name, future = pending.popleft()
        return replace(decide(future.result()), log=name)

    try:
        for name, task in tasks:
            pending.append((name, workers.submit(_estimate, task)))
            while pending and (pending[0][1].done() or len(pending) > MAX_PENDING_WINDOWS):
                yield decided()
    except LogError as error:
        fault = error
    while pending:
        yield decided()
    if fault is not None:
        raise fault


def _tasks(
    pipeline: Pipeline,
    logs: Sequence[Path],
    progress: Callable[[int, float], None] | None,
    on_fault: Callable[[LogError], None] | None,
) -> Iterator[tuple[str, WindowTask]]:
    """The windows of every log with its name."""
    for path, name in zip(logs, log_names(logs), strict=True):
        pipeline.begin_recording()
        intake, before = pipeline.intake, pipeline.intake.ended
        fault: LogError | None = None
        try:
            for now in fed(intake, path, progress):
                yield from ((name, task) for task in intake.due(now))
        except LogError as error:
            fault = error
        yield from ((name, task) for task in intake.finish(intake.admission.newest))
        if fault is not None:
            fault.windows = intake.ended - before
            if on_fault is None:
                raise fault
            on_fault(fault)


def fed(intake: Intake, log: Path, progress: Callable[[int, float], None] | None = None) -> Iterator[float]:
    """Feed the frames of a log to an intake, and yield the time [s] as windows end, every second, and at the end.

    LogError as `Log.frames`; where the last frame is not whole; where no frame is of a mapped message.
    """
    admission, counts = intake.admission, intake.admission.counts
    feed = admission.feed
    unheard = counts.unknown + counts.error_frames
    first = due = math.nan
    n = 0
    frame: Frame = (math.nan, 0, False, b"", False, True)
    recording = log_of(intake.config, log)
    for n, frame in enumerate(recording.frames(), 1):
        t, identifier, extended, data, remote, error = frame
        if error:
            counts.error_frames += 1
            continue
        feed(t, identifier, extended, data, remote)
        if not due - 2.0 <= t < due:
            yield _plausible_time(admission, t)
            due = min(intake.next_end, t + 1.0) if intake.next_end > t else t + 1.0
            if progress is not None:
                first = t if math.isnan(first) else first
                progress(n, t - first)
    counts.elsewhere += recording.left_out
    t, identifier, extended, data, remote, error = frame
    yield _plausible_time(admission, t)
    if counts.unknown + counts.error_frames == unheard + n:
        raise OtherBus(f"{log}: none of its {n} frames is in the DBC: a log of another bus?")
    message = None if remote or error else admission.cut_short(identifier, extended, data)
    if message is not None:
        raise LogError(f"{log}: cut off in its last frame ({len(data)} of {message.length} bytes of {message.name})")


def _plausible_time(admission: Admission, t: float) -> float:
    """A frame's stamp [s]; the stamp of the latest mapped frame where the two are more than LONGEST_GAP apart."""
    newest = admission.newest
    return t if newest <= t <= newest + LONGEST_GAP else newest


@contextmanager
def estimator_beside(config: Config) -> Iterator[Executor | None]:
    """Give a process that estimates while this one reads and decides; None on a machine with one core."""
    if (os.cpu_count() or 1) < 2 or "fork" not in get_all_start_methods():
        yield None
        return
    with workers(1, "fork", _begin, config) as beside:
        beside.submit(os.getpid).result()  # forked now, before there are threads
        usual = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_INTERVAL)  # the pool's thread must get its turn to hand on tasks
        try:
            yield beside
        finally:
            sys.setswitchinterval(usual)


_estimator: WindowEstimator | None = None


def _begin(config: Config) -> None:
    global _estimator
    _estimator = WindowEstimator(config)


def _estimate(task: WindowTask) -> Undecided:
    if _estimator is None:
        raise RuntimeError("estimator_beside() was not entered")
    return _estimator.estimate(task)


def channel_notes(config: Config, logs: Iterable[Path]) -> list[str]:
    """Return a line for each log whose first frames are not all of the configured channel."""
    notes = []
    for path in logs:
        if str(path) != "-" and config.columns is None:
            log = log_of(config, path)
            with suppress(LogError):
                next(log.frames())
            notes.append(log.note)
    return [note for note in notes if note]


def log_of(config: Config, path: Path) -> Log | SignalTable:
    """Return the log of the configured channel, or with [columns] the table of signals."""
    if config.columns is not None:
        return SignalTable(path, config.columns, list(mapped_columns(config)))
    return Log(path, config.log_channel or config.bus.channel, demanded=config.log_channel is not None)
