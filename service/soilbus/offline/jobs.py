"""What the user names -> jobs: logs, folders, globs, URLs, and manifests with the vehicle of each log.

LOG...  ->  rows of a manifest, or one row that names LOG itself  ->  logs of each row  ->  a job for each log
"""

from __future__ import annotations

import glob
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from functools import partial
from io import BytesIO
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from soilbus.can.log_formats import csv_of_frames
from soilbus.config.model import Config
from soilbus.files import opened, plain_bytes, read_all
from soilbus.offline import dataset
from soilbus.offline.cluster import BatchError
from soilbus.offline.columns import MISSING_CELLS, PACKED, check_cells, csv_rows, number, seconds_of_date
from soilbus.offline.parts import Job, Setup, file_name, kept_of, place_of, setup_of
from soilbus.pipeline.result import is_date
from soilbus.words import one_line

LOG_SUFFIXES = (".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc")
"""Of logs in a folder; what a log is, its content tells."""
TABLE_SUFFIXES = (".csv", ".parquet", ".pq")
MANIFEST_COLUMNS = ("log", "vehicle", "configuration", "start")


def jobs_of(
    config: Config, name: str, logs: Sequence[str], load: Callable[[Path], Config], parts: Path | None = None
) -> list[Job]:
    """Return a job for each log that the arguments of the command stand for, in the order of vehicle and log.

    An argument is a log, a folder, a glob, a URL, or a manifest: a table (CSV, Parquet) with a column `log`, and
    optionally `vehicle`, `configuration`, which `load` reads, and `start` (ISO 8601, or seconds since 1970). Without a
    vehicle there it is that of the folder in which the log lies. A log that was read before in a folder that is named
    here, of which `parts` holds the windows and that is no longer there, keeps its job.

    ConfigError where a configuration is wrong, BatchError where there is no log or a manifest cannot be read.
    """
    setups: dict[Path | None, Setup] = {}

    def setup(path: Path | None) -> Setup:
        if path not in setups:
            setups[path] = setup_of(config, name) if path is None else setup_of(load(path), path.name)
        return setups[path]

    suffixes: tuple[str, ...] = LOG_SUFFIXES
    if config.table is not None or config.columns is not None:
        suffixes = TABLE_SUFFIXES + (".mf4",) * (config.table is None)
    setup(None)
    jobs: dict[str, Job] = {}
    before = _logs_of_parts(parts)
    for argument in logs:
        for entry in _entries(argument, suffixes != LOG_SUFFIXES):
            own = entry.get("configuration")
            of_entry = partial(_job, entry, argument, setup(Path(own) if own else None))
            found = _files(entry["log"], suffixes)
            own_jobs = [of_entry(log) for log in found]
            if found != [_absolute(entry["log"])]:
                gone = {digest: log for digest, log in before.items() if _lies_in(log, entry["log"])}
                own_jobs += [job for digest, log in gone.items() if (job := of_entry(log)).digest == digest]
            if not own_jobs:
                raise BatchError(f"{entry['log']}: no log there")
            jobs |= {job.digest: job for job in own_jobs}
    return sorted(jobs.values(), key=lambda job: (job.vehicle, job.log, job.digest))


def _job(entry: Mapping[str, str], argument: str, setup: Setup, log: str) -> Job:
    vehicle = entry.get("vehicle") or place_of(log).rpartition("/")[0].rpartition("/")[2] or "unknown"
    if not dataset.can_be_folder(vehicle):
        raise BatchError(f"{argument}: vehicle {vehicle[:60]!r}: no name that a folder of results can have")
    return Job(log, vehicle, setup, _start(entry.get("start"), argument))


def _logs_of_parts(parts: Path | None) -> dict[str, str]:
    """Logs of which there are parts, by digest."""
    if parts is None:
        return {}
    all_kept = {path.stem: kept_of(parts, path.stem) for path in sorted(parts.glob("*.parquet"))}
    return {digest: kept.summary["log"] for digest, kept in all_kept.items() if kept and kept.summary}


def _lies_in(log: str, place: str) -> bool:
    """Whether a log, there or not, is one that a folder or a glob stands for."""
    pattern = _absolute(place).rstrip("/")
    if not glob.has_magic(pattern):
        return log.startswith(f"{pattern}/")
    places = PurePosixPath(log), *PurePosixPath(log).parents
    return any(fnmatchcase(str(each), pattern) if "**" in pattern else each.match(pattern) for each in places)


def _absolute(log: str) -> str:
    return log if "://" in log else os.path.abspath(log)


def _entries(argument: str, tables: bool) -> list[dict[str, str]]:
    """Rows of a manifest, or one row that names the argument itself, which may be a table of a test rig."""
    is_remote, suffix = "://" in argument, Path(file_name(argument)).suffix.lower()
    is_there = not glob.has_magic(place_of(argument)) if is_remote else os.path.isfile(argument)
    if suffix not in TABLE_SUFFIXES or not is_there:
        return [{"log": argument}]
    try:
        with _opened(argument) as file:
            header, rows = _csv_rows(file) if suffix == ".csv" else _parquet_rows(file)
    except Exception as error:  # each protocol has its own
        if is_remote:  # as a log it gets its line
            return [{"log": argument}]
        raise BatchError(f"{argument}: not a table that can be read ({one_line(error, 100)})") from None
    if "log" not in header:
        if tables or not header or csv_of_frames(",".join(header)):
            return [{"log": argument}]
        raise BatchError(f"{argument}: a manifest needs a column log; its columns are {', '.join(header) or 'none'}")
    if not rows:
        raise BatchError(f"{argument}: no row in it")
    return [_entry(argument, number, row) for number, row in rows]


@contextmanager
def _opened(argument: str) -> Iterator[BinaryIO]:
    """The plain bytes of the file at a path or URL."""
    if "://" not in argument:
        with opened(Path(argument)) as stream:
            yield stream
        return
    import fsspec

    with fsspec.open(argument, "rb") as file:
        yield plain_bytes(file)


def _entry(manifest: str, number: int, row: Mapping[str, Any]) -> dict[str, str]:
    """A row's texts; paths in it begin at the manifest's folder."""
    texts = {name: _cell(row[name]) for name in MANIFEST_COLUMNS if name in row}
    if not texts.get("log"):
        raise BatchError(f"{manifest}: row {number} has no log")
    place, _, archive = place_of(manifest).partition("::")
    folder, is_remote = place.rpartition("/")[0], "://" in manifest
    for name in ("log", "configuration"):
        text = texts.get(name)
        beside = Path(manifest).parent / (text or "")
        is_machine = name == "configuration" and not beside.suffix and not beside.exists()
        if not text or "://" in text or is_machine:
            continue
        if not is_remote:
            texts[name] = str(beside)
        elif name == "log":
            texts[name] = text if text.startswith("/") else f"{folder}/{text}" + (f"::{archive}" if archive else "")
        elif not text.startswith("/"):
            what = "in a manifest by URL it is a reference machine's name or an absolute path"
            raise BatchError(f"{manifest}: row {number}: configuration {text}: {what}")
    return texts


def _cell(value: Any) -> str:
    """Text of a cell, empty where it is missing; pandas makes 7.0 of a whole number where others are missing."""
    if value is None or value != value:
        return ""
    return str(int(value) if isinstance(value, float) and value.is_integer() else value).strip()


def _csv_rows(file: BinaryIO) -> tuple[list[str], list[tuple[int, dict[str, Any]]]]:
    """Names of columns, and the rows of a manifest that are not empty with their numbers."""
    rows, _ = csv_rows(file, MANIFEST_COLUMNS)
    header = [name.strip().lower() for name in (rows or [[]])[0]]
    numbered = ((n, row) for n, row in enumerate(rows[1:], 2) if any(map(str.strip, row)))
    return header, [(n, dict(zip(header, row, strict=False))) for n, row in numbered]


def _parquet_rows(file: BinaryIO) -> tuple[list[str], list[tuple[int, dict[str, Any]]]]:
    """Names of columns, and the numbered rows of a manifest."""
    import pyarrow.parquet as pq

    content = BytesIO(read_all(file))
    columns = pq.read_schema(content).names
    header = [name.strip().lower() for name in columns]
    if "log" not in header:
        return header, []
    wanted = [name for name, plain in zip(columns, header, strict=True) if plain in MANIFEST_COLUMNS]
    check_cells(pq.read_metadata(content).num_rows * len(wanted))
    table = pq.read_table(content, columns=wanted)
    rows = table.rename_columns([name.strip().lower() for name in table.column_names]).to_pylist()
    return header, list(enumerate(rows, 1))


def _start(text: str | None, manifest: str) -> float | None:
    if not text or text.lower() in MISSING_CELLS:
        return None
    seconds = number(text)  # a day may look so, too: 20240501
    date = None if is_date(seconds) else seconds_of_date(text)
    if date is None and not math.isfinite(seconds):
        raise BatchError(f"{manifest}: start {text} is neither ISO 8601 nor seconds since 1970")
    return seconds if date is None else date


def _files(log: str, suffixes: Sequence[str]) -> list[str]:
    """The logs that a path, a folder, a glob or a URL stands for; of a folder all below it that can be logs."""
    if "://" in log:
        return _remote_files(log, suffixes)
    found = [log]
    if glob.has_magic(log) and not os.path.lexists(log):
        found = glob.glob(log, recursive=True)
    below = (_below(each, suffixes) if os.path.isdir(each) else [_absolute(each)] for each in found)
    return sorted(set(chain.from_iterable(below)))


def _below(folder: str, suffixes: Sequence[str]) -> list[str]:
    """What is named as a log below a folder, behind links to elsewhere too, and each folder that cannot be read."""
    found: list[str] = []
    root, seen = os.path.realpath(folder), set[str]()
    walk = os.walk(os.path.abspath(folder), followlinks=True, onerror=lambda error: found.append(error.filename))
    for place, folders, names in walk:
        paths = {name: os.path.join(place, name) for name in (*folders, *names)}
        found += [path for name, path in paths.items() if _is_log(name, suffixes)]
        real = {name: os.path.realpath(paths[name]) for name in folders if os.path.islink(paths[name])}
        known = {name for name, path in real.items() if path in seen or Path(path).is_relative_to(root)}
        folders[:] = [name for name in folders if name not in known]
        seen |= {os.path.realpath(place), *real.values()}
    own = {path for path in found if not os.path.islink(path)}
    return [path for path in found if path in own or os.path.realpath(path) not in own]


def _remote_files(url: str, suffixes: Sequence[str]) -> list[str]:
    from fsspec.core import url_to_fs

    place, _, archive = url.partition("::")
    archive = f"::{archive}" if archive and "://" in place else ""
    try:
        files, name = url_to_fs(url)
        if glob.has_magic(place_of(url)):
            return sorted(str(files.unstrip_protocol(each)) + archive for each in files.glob(name))
        # over HTTP a file that is asked whether it is a folder is read as a page of links
        if not _is_log(file_name(url), suffixes) and files.isdir(name):
            found = [each for each in files.find(name) if _is_log(each, suffixes)]
            return sorted(str(files.unstrip_protocol(each)) + archive for each in found)
    except Exception as error:  # each protocol has its own
        raise BatchError(f"{url}: {one_line(error, 150)}") from None
    return [url]


def _is_log(name: str, suffixes: Sequence[str]) -> bool:
    path = Path(name.lower())
    return (path.with_suffix("") if path.suffix in PACKED else path).suffix in suffixes
