"""One log of a batch -> its part: a Parquet file of all of its windows, and a summary.

    log -> replay -> rows -> columns of 2000 windows -> one table -> Parquet

A part depends on the log, the configuration and the version of soilbus alone: the same log gives the same bytes on
every machine.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import pickle
import stat
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from io import SEEK_END
from itertools import compress, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cantools.database.can import Database

from soilbus import __version__
from soilbus.can.dbc_files import checked_messages, load_databases
from soilbus.config.file import located
from soilbus.config.model import Config
from soilbus.decision.traversability import State, Status
from soilbus.export.columns import SCHEMA_VERSION
from soilbus.export.table import arrow_table, joined, parquet_bytes
from soilbus.files import LIMITS, read_bounded
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
ROW_GROUP = 2000
"""Windows that are converted at once: 2 MB of columns."""
COUNTED = ("t", "status", "traversability.state", "bearing_pressure.value")
"""Columns of the windows that a summary is made of."""
NO_DAY = "unknown"
"""Day of windows whose log has no dates."""


@dataclass(frozen=True, slots=True)
class Setup:
    """A configuration with its databases, as it travels to a worker.

    The content is pickled: Config and Database (None for tables of a test rig). The digest is of settings and DBC
    files.
    """

    name: str
    content: bytes
    digest: str


@dataclass(frozen=True, slots=True)
class Job:
    """A log to replay: absolute path or URL, the vehicle that recorded it, and this one's configuration.

    `start` is the time [s] of the first sample, for logs whose stamps are no dates.
    """

    log: str
    vehicle: str
    setup: Setup
    start: float | None = None

    @property
    def digest(self) -> str:
        """Name of the part: digest of log, vehicle, start, configuration, and versions."""
        of = (self.log, self.vehicle, self.start, self.setup.digest, __version__, SCHEMA_VERSION)
        return hashlib.sha256(json.dumps(of).encode()).hexdigest()[:24]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a log: why it was not read, or not to its end, in one line; summary and bytes of its part.

    `other_bus`: no frame of it is in the DBC. `lasting`: the fault is of what is in the log, so that the same file has
    it again; else of the place or machine. The log has this `size` in bytes and, where that is known, was `changed` at
    this time [ns].
    """

    fault: str | None
    summary: dict[str, Any] | None = None
    part_bytes: int = 0
    other_bus: bool = False
    lasting: bool = False
    size: int = 0
    changed: int | None = None

    def is_of(self, size: int | None, changed: int | None) -> bool:
        """Return whether a file in this state is still the same, as far as its state is known."""
        return size in (self.size, None) and (changed == self.changed or None in (changed, self.changed))


def setup_of(config: Config, name: str) -> Setup:
    """Return the setup of a configuration; ConfigError where a DBC file is missing or does not fit."""
    digest = hashlib.sha256((config.model_dump_json() + (config.log_channel or "")).encode())
    database = None
    if config.table is None:
        database = load_databases(config)
        for dbc in config.dbc.input:
            digest.update(hashlib.sha256(located(config.folder, dbc).read_bytes()).digest())
        # a worker has none of these files: what it needs of them is the database, and the names of what is checked
        of_dbc = {"input": [], "checked": sorted(checked_messages(config, database))}
        config = config.model_copy(update={"dbc": config.dbc.model_copy(update=of_dbc)})
        Pipeline(config, database)
    return Setup(name, pickle.dumps((config, database)), digest.hexdigest())


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
    """Copy of the file at a URL; LogError where there is none."""
    from fsspec.core import url_to_fs

    path = folder / file_name(url)
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


def part_of(job: Job) -> tuple[Outcome, bytes]:
    """Replay one log and return its outcome, which says its faults, and its part."""
    size, part = 0, b""
    try:
        with local_log(job.log) as path:
            mode = path.stat().st_mode
            if stat.S_ISDIR(mode):
                unread = "" if os.access(path, os.R_OK | os.X_OK) else " that cannot be read"
                raise LogError(f"{path}: a folder{unread}")
            if not stat.S_ISREG(mode):  # a pipe or device may have no end
                raise LogError(f"{path}: not a regular file")
            with path.open("rb") as log:
                size = log.seek(0, SEEK_END)
            outcome, part = _replayed(job, path, time.thread_time() + CPU_FREE + CPU_PER_BYTE * size)
    except LogError as error:
        outcome = Outcome(str(error))
    except MemoryError:
        outcome = Outcome(f"{job.log}: not enough memory")
    except OSError as error:
        why = MISSING if isinstance(error, FileNotFoundError) else error.strerror or one_line(error, 200)
        outcome = Outcome(f"{job.log}: {why}")
    except Exception as error:  # a defect of ours, or of a library on a file that it never met
        outcome = Outcome(f"{job.log}: {one_line(error, 200)} ({type(error).__name__})", lasting=True)
    return replace(outcome, part_bytes=len(part), size=size), part


@contextmanager
def local_log(log: str) -> Iterator[Path]:
    """Give the path of a log on this machine, for as long as the context lasts; LogError for a URL without one."""
    with TemporaryDirectory(prefix="soilbus-") as folder:
        yield _fetched(log, Path(folder)) if "://" in log else Path(log)


def _replayed(job: Job, path: Path, latest: float) -> tuple[Outcome, bytes]:
    """Outcome and part; when the thread's clock says `latest` [s] the log is given up."""
    config, database = unpacked(job.setup.content)
    fault, shift, window = None, 0.0, config.estimator.window
    pipeline = None if database is None else Pipeline(config, database)
    (label,) = log_names([path])
    tables: list[Any] = []
    rows: list[dict[str, Any]] = []
    try:
        for n, result in enumerate(replay_tables(config, [path]) if pipeline is None else replay(pipeline, [path])):
            run = (result.log or "").removeprefix(label) if pipeline is None else ""  # of a table: its soil bed
            if time.thread_time() > latest:
                raise LogError(f"{path}: given up: it takes more processor time than a log of its size may")
            if n == 0 and job.start is not None:
                shift = job.start - (result.t - window)
            rows.append(_row(replace(result, log=job.log + run), job, config, shift))
            if len(rows) == ROW_GROUP:
                tables.append(arrow_table(rows))
                rows.clear()
    except LogError as error:
        fault = error
    text = None if fault is None else str(fault).replace(str(path), job.log)
    if tables or rows:
        table = joined([*tables, arrow_table(rows)])
        summary = _summary(table, job, config, pipeline, text)
        return Outcome(text, summary, lasting=bool(fault)), parquet_bytes(table)
    if fault is not None:
        return Outcome(text, other_bus=isinstance(fault, OtherBus), lasting=fault.lasting), b""
    return Outcome(f"{job.log}: no recording in it lasts the {window:g} s of a window", lasting=True), b""


def _row(result: WindowResult, job: Job, config: Config, shift: float) -> dict[str, Any]:
    """A window as a row; its time is in milliseconds since 1970, None where the stamp is no date."""
    longitude, latitude = (None, None) if result.position is None else map(math.degrees, reversed(result.position))
    when = round((result.t + shift) * 1e3) if is_date(result.t + shift) else None
    day = NO_DAY if when is None else datetime.fromtimestamp(when / 1e3, UTC).date().isoformat()
    place = {"vehicle": job.vehicle, "day": day, "time": when, "longitude": longitude, "latitude": latitude}
    return place | flat_record(window_record(result, config))


def _summary(table: Any, job: Job, config: Config, pipeline: Pipeline | None, fault: str | None) -> dict[str, Any]:
    """A log's windows, a pyarrow table, in one row."""
    columns = {name: table[name].to_pylist() for name in table.column_names if name in COUNTED}
    counts = Counter((*columns["status"], *columns["traversability.state"]))
    valid = [s == Status.VALID for s in columns["status"]]
    pressures = [p for p in compress(columns.get("bearing_pressure.value", ()), valid) if p is not None]
    times = [when.value for when in table["time"] if when.is_valid]  # the clock may be set back
    settings = config.estimator
    steps = (now - before for before, now in pairwise([-math.inf, *columns["t"]]))
    frames: dict[str, int | None] = {}
    if pipeline is None:
        names = [name for name in table.column_names if name.startswith("rejected.")]
        rejected = {name: sum(filter(None, table[name].to_pylist())) for name in names}
    else:
        heard, refusals = pipeline.admission.counts, pipeline.intake.refusals
        rejected = {f"rejected.{reason}": n for reason, n in refusals.total.items()}
        frames = {"mapped": sum(heard.received.values()), "unknown": heard.unknown, "error": heard.error_frames}
        frames |= {"lost": pipeline.admission.missed, "other_channel": heard.elsewhere}
    return {
        "vehicle": job.vehicle,
        "log": job.log,
        "configuration": job.setup.name,
        "begin": min(times, default=None),
        "end": max(times, default=None),
        "duration": sum(settings.hop if 0.0 < step < 1.5 * settings.hop else settings.window for step in steps),
        "windows.all": table.num_rows,
        **{f"windows.{each}": counts[each] for each in (*Status, *State)},
        "bearing_pressure.mean": sum(pressures) / len(pressures) if pressures else None,
        **{f"frames.{which}": n for which, n in frames.items()},
        "samples": None if pipeline is None else refusals.used,
        **dict(sorted(rejected.items())),
        "fault": fault,
    }


def part_path(parts: Path, digest: str) -> Path:
    """Return where the windows of a log are."""
    return parts / f"{digest}.parquet"


def kept_of(parts: Path, digest: str) -> Outcome | None:
    """Return what is kept of a log; None where it is not whole."""
    try:
        kept = Outcome(**json.loads(read_bounded(parts / f"{digest}.json", LIMITS.whole)))
        is_whole = not kept.part_bytes or part_path(parts, digest).stat().st_size == kept.part_bytes
    except (OSError, ValueError, TypeError):
        return None
    return kept if is_whole else None
