"""Recorded logs through the daemon's own pipeline, as fast as it can.

    log -> frames -> intake -> window tasks -> estimator (in a process beside, where there are two cores) -> results

Each log is a recording of its own with its own clock; windows are numbered on over all logs. Reading and estimating
overlap in two processes, and the results are the same as in one.
"""

from __future__ import annotations

import gc
import gzip
import math
import os
import sys
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from dataclasses import replace
from io import TextIOBase
from itertools import chain, islice
from multiprocessing import get_all_start_methods
from pathlib import Path
from typing import Any, TypeVar

import can

from soilbus.can.admission import LONGEST_GAP, Admission
from soilbus.can.candump import Frame, candump_batches, frame_of, whole
from soilbus.can.log_lines import LogLines
from soilbus.config.model import Config
from soilbus.pipeline.estimator import Undecided, WindowEstimator
from soilbus.pipeline.intake import Intake, WindowTask
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.words import LONGEST_NAME, one_line, shown
from soilbus.workers import workers

__all__ = ["LogError", "OtherBus", "estimator_beside", "fed", "log_names", "read_frames", "read_log", "replay"]

_T = TypeVar("_T")

SWITCH_INTERVAL = 0.0002
"""Time [s] after which the interpreter switches threads, so that the pool's thread can hand on tasks."""
CHANNEL_SCAN_LINES = 2000
"""Lines of a log in which its channels are looked for: several seconds of a bus."""
MAX_PENDING_WINDOWS = 30
"""Windows that may wait for the estimator."""


class LogError(Exception):
    """A log cannot be read, or not to its end; the text says where and why; `windows` ended before that place.

    `lasting` is False where the fault is of the machine that reads it, not of what is in the log.
    """

    windows = 0
    lasting = True


class OtherBus(LogError):
    """No frame of a log is in the DBC: of another bus, or of another vehicle than the configuration's."""


def read_log(path: Path) -> Iterator[can.Message]:
    """Messages of one log, in any format that python-can reads (and MF4 with the extra `mf4`).

    Raises
    ------
    LogError
        The file is missing, of an unknown format, or damaged.
    """
    return chain.from_iterable(_read(path, lambda reader: ([whole(message)] for message in _timed(reader))))


def read_frames(path: Path) -> Iterator[Frame]:
    """The frames of read_log()'s messages, several times as fast for a candump log."""
    return chain.from_iterable(_read(path, _frames))


def _frames(reader: Any) -> Iterator[list[Frame]]:
    if isinstance(reader, can.CanutilsLogReader):
        return candump_batches(reader.file)
    return ([frame_of(whole(message))] for message in _timed(reader))


def _timed(reader: Any) -> Iterator[can.Message]:
    """The messages of a reader; ValueError where an ASC log's stamps only say how long after the last event each came.

    Events between them that are no frames do not come from the reader, so the times cannot be summed up.
    """
    last = -math.inf
    for message in reader:
        if message.timestamp < last and getattr(reader, "timestamps_format", None) == "relative":
            raise ValueError("its stamps are relative to the event before: save it with absolute ones")
        last = message.timestamp
        yield message


def _read(path: Path, batches: Callable[[Any], Iterator[list[_T]]]) -> Iterator[list[_T]]:
    """What `batches` makes of python-can's reader of a log; LogError as read_log()."""
    n = 0
    try:
        with _reader(path) as reader:
            if isinstance(getattr(reader, "file", None), TextIOBase):
                reader.file = LogLines(reader.file)
            for batch in batches(reader):
                n += len(batch)
                yield batch
    except FileNotFoundError:
        raise LogError(f"{path}: no such file") from None
    except NotImplementedError:
        fault = LogError(f"{path}: this format needs soilbus[mf4]")
        fault.lasting = False
        raise fault from None
    except Exception as error:  # python-can's readers raise all kinds on a damaged file
        what = "not a CAN log that can be read" if n == 0 else f"cut off or damaged after {n} frames"
        why = "a line that is no frame" if "to unpack" in str(error) else one_line(error, 100)
        raise LogError(f"{path}: {what} ({why})") from None
    if n == 0:
        raise LogError(f"{path}: no frame in it")


def _reader(path: Path) -> Any:
    """python-can's reader; it does not recognise a name such as a.b.log.gz, which is done here."""
    if path.suffixes[-2:] == [".log", ".gz"]:
        return can.CanutilsLogReader(gzip.open(path, "rt"))
    usual = sys.unraisablehook
    try:
        return can.LogReader(path)
    except Exception as error:
        sys.unraisablehook = lambda _: None  # asammdf's destructor fails on what its constructor has left unmade
        traceback.clear_frames(error.__traceback__)
        gc.collect()
        raise
    finally:
        sys.unraisablehook = usual


def log_names(logs: Sequence[Path]) -> list[str]:
    """A name for each log: the shortest end of its path that no other log has, as `shown`.

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
    """Results of every window of the logs.

    Parameters
    ----------
    pipeline
        Intake and estimator; it counts frames and refusals of all logs.
    logs
        Files, replayed one after the other.
    progress
        Called now and then with the number of frames read and the time in the recording [s].
    workers
        Executor of `estimator_beside`: reading and estimating then overlap, with the same results.
    on_fault
        Called with the error of a log that is damaged or of another bus; the next log follows.

    Yields
    ------
    Results in order, each named by the `log` of its results; window numbers go on from log to log.

    Raises
    ------
    LogError
        A log is damaged or of another bus and `on_fault` is None; after the windows before that place.
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
        n = 0
        try:
            for task in _windows(pipeline.intake, path, progress):
                n += 1
                yield name, task
        except LogError as error:
            error.windows = n
            if on_fault is None:
                raise
            on_fault(error)


def _windows(intake: Intake, log: Path, progress: Callable[[int, float], None] | None) -> Iterator[WindowTask]:
    """The windows of one log; LogError after those before the place where it is damaged."""
    fault: LogError | None = None
    try:
        for now in fed(intake, log, progress):
            yield from intake.due(now)
    except LogError as error:
        fault = error
    yield from intake.finish(intake.admission.newest)
    if fault is not None:
        raise fault


def fed(intake: Intake, log: Path, progress: Callable[[int, float], None] | None = None) -> Iterator[float]:
    """Feed the frames of a log to an intake.

    Parameters
    ----------
    intake
        Takes the frames.
    log
        The file.
    progress
        Called with the number of frames read and the time in the recording [s].

    Yields
    ------
    The time [s] when a window has ended (once, taken or not), every second of the recording, and at its end.

    Raises
    ------
    LogError
        As read_log(); where the last frame is not whole; where no frame is of a mapped message.
    """
    admission, counts = intake.admission, intake.admission.counts
    feed = admission.feed
    unheard = counts.unknown + counts.error_frames
    first = due = math.nan
    n = 0
    frame: Frame = (math.nan, 0, False, b"", False, True)
    for n, frame in enumerate(read_frames(log), 1):
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
    """A process that estimates while this one reads and decides; None on a machine with one core."""
    if (os.cpu_count() or 1) < 2 or "fork" not in get_all_start_methods():
        yield None
        return
    with workers(1, "fork", _begin, config) as beside:
        beside.submit(_begun).result()  # forked now, before there are threads
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


def _begun() -> bool:
    return _estimator is not None


def _estimate(task: WindowTask) -> Undecided:
    if _estimator is None:
        raise RuntimeError("estimator_beside() was not entered")
    return _estimator.estimate(task)


def other_channel(config: Config, logs: Iterable[Path]) -> list[str]:
    """A line for each log whose first frames are of several channels, or a candump log's of another than configured."""
    lines = []
    for path in logs:
        names = _channels(path)
        if names and names != {config.bus.channel}:
            of = " and ".join(sorted(names))
            lines.append(f"{path}: frames of {of}, where bus.channel = {config.bus.channel}; all of them count")
    return lines


def _channels(path: Path) -> set[str]:
    """Channels of the first frames of a log; none for what cannot be read, and for one channel under another format."""
    if ".log" not in path.suffixes[-2:]:
        with suppress(LogError):
            found = {f"channel {message.channel}" for message in islice(read_log(path), CHANNEL_SCAN_LINES)}
            return found if len(found) > 1 else set()
        return set()
    try:
        with gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as text:
            words = [line.split(maxsplit=2) for line in islice(text, CHANNEL_SCAN_LINES)]
    except (OSError, EOFError, ValueError):
        return set()
    return {word[1] for word in words if len(word) == 3 and word[0].startswith("(")}
