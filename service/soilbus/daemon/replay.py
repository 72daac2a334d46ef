"""Recorded logs through the daemon's own pipeline, as fast as it can."""

from __future__ import annotations

import gzip
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from io import TextIOBase
from itertools import chain
from multiprocessing import get_all_start_methods
from pathlib import Path
from typing import Any, TypeVar

import can

from soilbus.can.candump import Frame, candump_batches, frame_of
from soilbus.can.log_lines import LogLines
from soilbus.config import Config
from soilbus.daemon.estimator import Undecided, WindowEstimator
from soilbus.daemon.intake import Intake, WindowTask
from soilbus.daemon.pipeline import Pipeline
from soilbus.daemon.result import WindowResult
from soilbus.workers import workers

_T = TypeVar("_T")

SWITCH_INTERVAL = 0.0002
MAX_AHEAD = 30
"""Windows that may wait for the estimator."""


class LogError(Exception):
    """A log cannot be read, or not to its end; the text says where and why."""


def read_log(path: Path) -> Iterator[can.Message]:
    """Messages of one log in any format that python-can reads (and MF4 with the extra `mf4`).

    Raises LogError for a file that is missing, of an unknown format, or damaged.
    """
    return chain.from_iterable(_read(path, lambda reader: ([message] for message in reader)))


def read_frames(path: Path) -> Iterator[Frame]:
    """The frames of read_log()'s messages, several times as fast for a candump log."""
    return chain.from_iterable(_read(path, _frames))


def _frames(reader: Any) -> Iterator[list[Frame]]:
    if isinstance(reader, can.CanutilsLogReader):
        return candump_batches(reader.file)
    return ([frame_of(message)] for message in reader)


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
        raise LogError(f"{path}: this format needs soilbus[mf4]") from None
    except Exception as error:  # python-can's readers raise all kinds on a damaged file
        what = "not a CAN log that can be read" if n == 0 else f"cut off or damaged after {n} frames"
        raise LogError(f"{path}: {what} ({_one_line(error)})") from None
    if n == 0:
        raise LogError(f"{path}: no frame in it")


def _reader(path: Path) -> Any:
    """python-can's reader; it cannot tell the format of a name such as a.b.log.gz, so that is done here."""
    if path.suffixes[-2:] == [".log", ".gz"]:
        return can.CanutilsLogReader(gzip.open(path, "rt"))
    return can.LogReader(path)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:100] or type(error).__name__


def replay(
    pipeline: Pipeline,
    logs: Sequence[Path],
    progress: Callable[[int, float], None] | None = None,
    workers: Executor | None = None,
) -> Iterator[WindowResult]:
    """Results of every window of the logs, one after the other; LogError as read_log().

    `progress` is called now and then with the number of frames read and the time in the
    recording [s].  With `workers` (of `estimator_beside`) reading and estimating go on at
    the same time; the results are the same.
    """
    tasks = _tasks(pipeline.intake, logs, progress)
    if workers is None:
        yield from map(pipeline.estimator.solve, tasks)
        return
    decide = pipeline.estimator.decide
    pending: deque[Future[Undecided]] = deque()
    cut_off: LogError | None = None
    try:
        for task in tasks:
            pending.append(workers.submit(_estimate, task))
            while pending and (pending[0].done() or len(pending) > MAX_AHEAD):
                yield decide(pending.popleft().result())
    except LogError as error:
        cut_off = error
    for future in pending:
        yield decide(future.result())
    if cut_off is not None:
        raise cut_off


def _tasks(intake: Intake, logs: Sequence[Path], progress: Callable[[int, float], None] | None) -> Iterator[WindowTask]:
    last = 0.0
    for last in fed(intake, logs, progress):
        yield from intake.due(last)
    yield from intake.finish(last)


def fed(intake: Intake, logs: Sequence[Path], progress: Callable[[int, float], None] | None = None) -> Iterator[float]:
    """Feeds the frames of the logs to an intake; LogError as read_log().

    Yields the time [s] when a window has ended (once, whether it is taken or not), every second of the recording, and
    at its end.
    """
    feed = intake.admission.feed
    last = 0.0
    n = 0
    for path in logs:
        due = -1.0
        for t, identifier, extended, data, remote, error in read_frames(path):
            n += 1
            if error:
                intake.admission.counts.error_frames += 1
                continue
            last = t
            if last >= due or last < due - 2.0:
                yield last
                due = min(intake.next_end, last + 1.0) if intake.next_end > last else last + 1.0
                if progress is not None:
                    progress(n, last)
            feed(t, identifier, extended, data, remote)
    yield last


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


def check_heard(listener: Pipeline | Intake, logs: Iterable[Path]) -> None:
    """Raises LogError where not one frame of a mapped message was in the logs."""
    counts = listener.admission.counts
    if not sum(counts.received.values()):
        names = ", ".join(str(p) for p in logs)
        raise LogError(f"{names}: none of its {counts.unknown} frames is in the DBC: a log of another bus?")
