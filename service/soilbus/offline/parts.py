"""One log of a batch -> its part: all of its windows and a summary, whole or not at all.

    log -> replay -> part = gzip(summary) + pieces, each gzip(a line of JSON for each of 5000 windows)

A part depends on the log, the configuration and the version of soilbus alone: the same log gives the same bytes on
every machine.  The replay yields one window at a time and its line goes to a temporary file; of a part no more than a
piece is in memory, here or where it is asked for.  So memory does not grow with the log.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import math
import os
import pickle
import stat
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from io import SEEK_END, BytesIO
from itertools import chain, islice, pairwise
from pathlib import Path
from shutil import copyfileobj
from tempfile import NamedTemporaryFile, TemporaryDirectory, TemporaryFile, gettempdir
from typing import IO, Any

from cantools.database.can import Database

from soilbus import __version__
from soilbus.can.dbc_files import checked_messages, load_databases
from soilbus.config.file import located
from soilbus.config.model import Config, ConfigError
from soilbus.decision.traversability import State, Status
from soilbus.export.columns import SCHEMA_VERSION
from soilbus.files import opened, plain_bytes, text_lines
from soilbus.offline.replay import LogError, OtherBus, log_names, replay
from soilbus.offline.tables import replay_tables
from soilbus.pipeline.outputs import flat_record, window_record
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult, is_date
from soilbus.words import one_line

MISSING = "no such file"
CPU_FREE = 600.0
"""Processor time [s] that any log may take."""
CPU_PER_BYTE = 300.0 / 2**20
"""Processor time [s] that it may take beside for each byte.  A drive on a full bus took 1.2 s a MiB as candump text,
7 s a MiB packed by xz; five frames a second with data that repeat, packed by xz, took 1500 s a MiB: 7 kB for 40 min."""
WINDOWS_OF_PIECE = 5_000
"""Windows of a log that are handed over at once; 1 kB each.  Of messages of 10 MB Dask warns; a log of an hour, with
a window every second, is one piece."""


@dataclass(frozen=True, slots=True)
class Setup:
    """A configuration with its databases, as it travels to a worker.

    Attributes
    ----------
    name
        File that it came from.
    content
        Pickled Config and Database (None for tables of a test rig).
    digest
        Of the settings and the DBC files.
    """

    name: str
    content: bytes
    digest: str


@dataclass(frozen=True, slots=True)
class Job:
    """A log to replay.

    Attributes
    ----------
    log
        Absolute path, or URL that fsspec opens.
    vehicle
        That recorded it.
    setup
        Configuration of the vehicle.
    start
        Time [s] of the first sample, for logs whose stamps are no dates; None: stamps count as they are.
    content
        The log itself, where workers do not see the file.
    not_sent
        Why it was not sent along, in one line, where workers do not see the file.
    """

    log: str
    vehicle: str
    setup: Setup
    start: float | None = None
    content: bytes | None = field(default=None, repr=False)
    not_sent: str | None = field(default=None, repr=False)

    @property
    def digest(self) -> str:
        """Name of the part: digest of log, vehicle, start, configuration, and versions."""
        of = (self.log, self.vehicle, self.start, self.setup.digest, __version__, SCHEMA_VERSION)
        return hashlib.sha256(json.dumps(of).encode()).hexdigest()[:24]


@dataclass(frozen=True, slots=True)
class Rest:
    """Part that a worker keeps until it is asked for: its address, the file, sizes of the pieces [bytes]."""

    worker: str
    path: str
    sizes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a log.

    Attributes
    ----------
    part
        Its summary and first piece; None where there is none.
    fault
        Why the log was not read, or not to its end, in one line; None where it was.
    windows
        Windows of the part.
    other_bus
        Whether no frame of the log is in the DBC.
    lasting
        Whether the fault is of what is in the log, so that the same file has it again; else of the place or machine.
    cpu_seconds, log_bytes
        Cost: processor time, size of the log.
    rest
        The other pieces; None where there are no others.
    """

    part: bytes | None
    fault: str | None
    windows: int = 0
    other_bus: bool = False
    lasting: bool = False
    cpu_seconds: float = 0.0
    log_bytes: int = 0
    rest: Rest | None = None


class OtherVersion(Exception):
    """Error of a worker with another version of soilbus than the command."""


def check_version(version: str) -> None:
    """Raise OtherVersion where the soilbus that asks is of another version than this one."""
    if version != __version__:
        raise OtherVersion(f"a worker has soilbus {__version__}, this is {version}: install the same everywhere")


def setup_of(config: Config, name: str) -> Setup:
    """Return the setup of a configuration.

    Raises
    ------
    ConfigError
        A DBC file is missing or does not fit the configuration.
    """
    digest = hashlib.sha256((config.model_dump_json() + (config.log_channel or "")).encode())
    database = None
    if config.table is None:
        with TemporaryDirectory(prefix="soilbus-") as folder:
            here = _with_dbcs_here(config, Path(folder))
            database = load_databases(here)
            for dbc in here.dbc.input:
                digest.update(hashlib.sha256(located(here.folder, dbc).read_bytes()).digest())
            # a worker has none of these files: what it needs of them is the database, and the names of what is checked
            config = _with_dbc(config, input=[], checked=sorted(checked_messages(here, database)))
        Pipeline(config, database)
    return Setup(name, pickle.dumps((config, database)), digest.hexdigest())


def _with_dbc(config: Config, **settings: list[str]) -> Config:
    return config.model_copy(update={"dbc": config.dbc.model_copy(update=settings)})


def _with_dbcs_here(config: Config, folder: Path) -> Config:
    """The configuration with copies, in the folder, of the DBC files that it names by URL."""
    paths = []
    for n, name in enumerate(config.dbc.input):
        paths.append(name)
        if "://" in name:
            try:
                paths[-1] = str(_fetched(name, folder / str(n)))
            except LogError as error:
                raise ConfigError([f"dbc.input: {error}"]) from None
    return _with_dbc(config, input=paths)


def place_of(log: str) -> str:
    """Return path or URL of a log without the archive that it lies in and a server's query."""
    place, _, archive = log.partition("::")
    if "://" not in place:
        return log
    return place.partition("?")[0] if place.startswith(("http://", "https://")) and not archive else place


def file_name(log: str) -> str:
    """Return the name of the file that a path or URL means."""
    return place_of(log).rpartition("/")[2]


def _fetched(url: str, folder: Path) -> Path:
    """Copy of the file at a URL, in a folder that is made; LogError where there is none."""
    from fsspec.core import url_to_fs

    path = folder / file_name(url)
    folder.mkdir(exist_ok=True)
    try:
        files, name = url_to_fs(url)
        files.get_file(name, str(path))
    except FileNotFoundError:
        raise LogError(f"{url}: {MISSING}") from None
    except Exception as error:  # each protocol has its own
        raise LogError(f"{url}: cannot be fetched ({one_line(error, 150)})") from None
    return path


@lru_cache(maxsize=16)
def unpacked(content: bytes) -> tuple[Config, Database | None]:
    config, database = pickle.loads(content)
    return config, database


def part_of(job: Job, version: str, of_piece: int = WINDOWS_OF_PIECE) -> Outcome:
    """Replay one log; a fault of the log is in the outcome.

    Parameters
    ----------
    job
        The log.
    version
        Of the soilbus that asks for it.
    of_piece
        Windows of a piece: no more are in memory at once.

    Raises
    ------
    OtherVersion
        This soilbus is of another version.
    """
    check_version(version)
    begin, size = time.thread_time(), 0
    try:
        with local_log(job) as path:
            _check_is_file(path)
            with path.open("rb") as log:
                size = log.seek(0, SEEK_END)
            with TemporaryFile() as lines:
                outcome = _replayed(lines, job, path, of_piece, begin + CPU_FREE + CPU_PER_BYTE * size)
    except LogError as error:
        return Outcome(None, str(error))
    except MemoryError:
        return Outcome(None, f"{job.log}: not enough memory")
    except OSError as error:
        why = MISSING if isinstance(error, FileNotFoundError) else error.strerror or one_line(error, 200)
        return Outcome(None, f"{job.log}: {why}")
    except Exception as error:  # a defect of ours, or of a library on a file that it never met
        return Outcome(
            None, f"{job.log}: {one_line(error, 200)} ({type(error).__name__})", lasting=True, log_bytes=size
        )
    return replace(outcome, cpu_seconds=time.thread_time() - begin, log_bytes=size)


def _check_is_file(path: Path) -> None:
    """LogError where it is a folder, or a pipe or device, which may have no end."""
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise LogError(f"{path}: a folder" + ("" if os.access(path, os.R_OK | os.X_OK) else " that cannot be read"))
    if not stat.S_ISREG(mode):
        raise LogError(f"{path}: not a regular file")


@contextmanager
def local_log(job: Job) -> Iterator[Path]:
    """Give the path of the log on this machine, for as long as the context lasts.

    Raises
    ------
    LogError
        The URL cannot be read, or the log is neither here nor was it sent along.
    """
    if job.content is None and "://" not in job.log:
        if job.not_sent is not None and not Path(job.log).exists():
            raise LogError(job.not_sent)
        yield Path(job.log)
        return
    with TemporaryDirectory(prefix="soilbus-") as folder:
        if job.content is None:
            yield _fetched(job.log, Path(folder))
            return
        path = Path(folder, job.log.rpartition("/")[2])
        path.write_bytes(job.content)
        yield path


def _replayed(lines: IO[bytes], job: Job, path: Path, of_piece: int, latest: float) -> Outcome:
    """The outcome; `lines` is an empty file that holds the pieces until the summary, which goes before, is known.

    When the thread's clock says `latest` [s] the log is given up.
    """
    config, database = unpacked(job.setup.content)
    summary = _Summary(job, config)
    fault: LogError | None = None
    pipeline = None if database is None else Pipeline(config, database)

    (label,) = log_names([path])

    def written() -> Iterator[bytes]:
        nonlocal fault
        try:
            for result in replay_tables(config, [path]) if pipeline is None else replay(pipeline, [path]):
                run = (result.log or "").removeprefix(label) if pipeline is None else ""  # of a table: its soil bed
                if time.thread_time() > latest:
                    raise LogError(f"{path}: given up: it takes more processor time than a log of its size may")
                row = summary.row(replace(result, log=job.log + run))
                yield json.dumps(row, allow_nan=False).encode() + b"\n"
        except LogError as error:
            fault = error

    windows, ends = written(), [0]
    while (first := next(windows, None)) is not None:
        with gzip.GzipFile(filename="", fileobj=lines, mode="wb", mtime=0) as piece:
            piece.writelines(chain([first], islice(windows, of_piece - 1)))
        ends.append(lines.tell())
    text = None if fault is None else str(fault).replace(str(path), job.log)
    if fault is not None and not summary.windows:
        return Outcome(None, text, other_bus=isinstance(fault, OtherBus), lasting=fault.lasting)
    if not summary.windows:
        text = f"{job.log}: no recording in it lasts the {config.estimator.window:g} s of a window"
        return Outcome(None, text, lasting=True)
    sizes = tuple(end - begin for begin, end in pairwise(ends))
    record = {**summary.record(pipeline, text), "pieces": sizes}
    lines.seek(0)
    part = gzip.compress(json.dumps(record, allow_nan=False).encode() + b"\n", mtime=0) + lines.read(sizes[0])
    rest = _left_here(lines, sizes[1:]) if sizes[1:] else None
    return Outcome(part, text, summary.windows, lasting=fault is not None, rest=rest)


def _left_here(lines: IO[bytes], sizes: tuple[int, ...]) -> Rest:
    """The rest of a file, in the folder of the worker that this runs on; it goes with the worker."""
    address, folder = _worker()
    with NamedTemporaryFile(dir=folder, delete=False) as file:
        copyfileobj(lines, file)
    return Rest(address, file.name, sizes)


def _worker() -> tuple[str, str]:
    """Address and folder of the Dask worker that this runs on; of a process of a batch here its temporary folder."""
    if (distributed := sys.modules.get("distributed")) is not None:
        with suppress(ValueError):  # no worker
            worker = distributed.get_worker()
            return worker.address, worker.local_directory
    return "", gettempdir()


def piece_left(path: str, begin: int, size: int) -> bytes:
    """Return a piece of a part that was left on a worker; with the last one its file goes."""
    with open(path, "rb") as file:
        file.seek(begin)
        piece = file.read(size)
        is_last = file.tell() == file.seek(0, SEEK_END)
    if is_last:
        os.unlink(path)
    return piece


class _Summary:
    """Counts of one log, window by window."""

    def __init__(self, job: Job, config: Config) -> None:
        self.job, self.config = job, config
        self.windows = 0
        self._shift: float | None = None
        self._columns: dict[str, None] = {}
        self._counts: Counter[str] = Counter()
        self._bearing_sum, self._bearing_n = 0.0, 0
        self._rejected: Counter[str] = Counter()
        self._times: list[int] = []
        self._newest = -math.inf
        self._duration = 0.0

    def row(self, result: WindowResult) -> dict[str, Any]:
        """The window as a row, counted."""
        record = flat_record(window_record(result, self.config))
        longitude, latitude = (None, None) if result.position is None else map(math.degrees, reversed(result.position))
        when = self._time(result.t)
        row = {"vehicle": self.job.vehicle, "time": when, "longitude": longitude, "latitude": latitude} | record
        self._columns.update(dict.fromkeys(row))
        self.windows += 1
        settings = self.config.estimator
        follows = 0.0 < result.t - self._newest < 1.5 * settings.hop
        self._duration += settings.hop if follows else settings.window
        self._newest = result.t
        self._counts[f"windows.{result.status}"] += 1
        self._counts[f"windows.{result.traversability.state}"] += 1
        if result.bearing is not None and result.status is Status.VALID:
            self._bearing_sum += result.bearing.value
            self._bearing_n += 1
        if self.config.table is not None:
            self._rejected += Counter(result.rejected)
        if when is not None:  # the clock may be set back
            self._times = [min([when, *self._times[:1]]), max([when, *self._times[1:]])]
        return row

    def _time(self, t: float) -> int | None:
        """Milliseconds since 1970; None where the stamp is no date."""
        if self._shift is None:
            self._shift = 0.0 if self.job.start is None else self.job.start - (t - self.config.estimator.window)
        t += self._shift
        return round(t * 1e3) if is_date(t) else None

    def record(self, pipeline: Pipeline | None, fault: str | None) -> dict[str, Any]:
        """The whole log in one row, with the names of its windows' columns."""
        frames: dict[str, int | None] = {}
        used, rejected = None, self._rejected
        if pipeline is not None:
            counts, refusals = pipeline.admission.counts, pipeline.intake.refusals
            frames = {
                "frames.mapped": sum(counts.received.values()),
                "frames.unknown": counts.unknown,
                "frames.error": counts.error_frames,
                "frames.lost": pipeline.admission.missed,
                "frames.other_channel": counts.elsewhere,
            }
            used, rejected = refusals.used, refusals.total
        return {
            "vehicle": self.job.vehicle,
            "log": self.job.log,
            "configuration": self.job.setup.name,
            "begin": self._times[0] if self._times else None,
            "end": self._times[-1] if self._times else None,
            "duration": self._duration,
            "windows.all": self.windows,
            **{f"windows.{each}": self._counts[f"windows.{each}"] for each in (*Status, *State)},
            "bearing_pressure.mean": self._bearing_sum / self._bearing_n if self._bearing_n else None,
            **frames,
            "samples": used,
            **{f"rejected.{reason}": n for reason, n in sorted(rejected.items())},
            "fault": fault,
            "columns": list(self._columns),
        }


def summary_of_part(path: Path) -> dict[str, Any] | None:
    """Return the summary in a part; None where there is no part."""
    try:
        with opened(path) as part:
            summary: dict[str, Any] = json.loads(next(text_lines(part)))
        is_whole = path.stat().st_size > sum(summary["pieces"])
    except (OSError, EOFError, StopIteration, ValueError, KeyError):
        return None
    summary["columns"] = _shared(tuple(summary["columns"]))
    return summary if is_whole else None


@lru_cache(maxsize=256)
def _shared(columns: tuple[str, ...]) -> tuple[str, ...]:
    """The same columns as one object: a fleet's summaries are in memory at once, and most have the same."""
    return columns


def pieces_of_part(path: Path, sizes: Sequence[int]) -> Iterator[bytes]:
    """Yield the windows of a part, as pieces of the sizes that its summary says."""
    with path.open("rb") as file:
        file.seek(-sum(sizes), SEEK_END)
        for size in sizes:
            yield file.read(size)


def rows_of_piece(piece: bytes, at_once: int) -> Iterator[list[dict[str, Any]]]:
    """Yield the windows of a piece as rows of a table, `at_once` or fewer at a time."""
    lines = text_lines(plain_bytes(BytesIO(piece)))
    while rows := [json.loads(line) for line in islice(lines, at_once)]:
        yield rows
