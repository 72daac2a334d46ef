"""Many logs on Dask: each log its own task, its result on disk at once, what is done never done again.

    LOG...  ->  jobs  ->  parts/DIGEST.gz (one a log)  ->  windows, summaries, errors, map

Only logs that have no part yet are replayed, so a run that was stopped, whatever stopped it, loses the logs in work
and no more.  What is wrong with a log is kept as well, and beside both the state of its file (parts/DIGEST.kept): a
log whose file changed is read again.  Workers need neither the configuration nor the DBC files nor the output folder:
settings travel with a job, and parts come back.  Workers open a log by its path or URL; where they do not see the path,
it is sent along.
"""

from __future__ import annotations

import csv
import fcntl
import glob
import hashlib
import json
import logging
import math
import os
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import chain, islice
from pathlib import Path
from typing import Any

from soilbus import __version__
from soilbus.config.model import Config, ConfigError
from soilbus.offline import dataset
from soilbus.offline.fleet import (
    Given,
    chosen,
    effect_rows,
    findings_of,
    findings_of_type,
    judged,
    no_findings,
)
from soilbus.offline.parts import (
    Job,
    OtherVersion,
    Outcome,
    Setup,
    file_name,
    part_of,
    place_of,
    setup_of,
    summary_of_part,
)
from soilbus.offline.tables import MISSING_CELLS
from soilbus.pipeline.outputs import known
from soilbus.words import one_line

__all__ = ["Batch", "BatchError", "check_out", "cluster", "jobs_of", "results_in", "run_batch"]

LOG_SUFFIXES = (".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc")
"""Of logs that python-can reads; each may have .gz behind it."""
TABLE_SUFFIXES = (".csv", ".parquet", ".pq")
MANIFEST_COLUMNS = ("log", "vehicle", "configuration", "start")
SEPARATORS = ",;\t"
"""Between the cells of a manifest; a spreadsheet writes semicolons where the comma is in numbers."""
CAN_CSV_COLUMNS = 7
"""Of a log in the CSV of python-can."""
CONNECT_TIMEOUT = 10.0
"""Seconds in which a scheduler must answer."""
TASKS_PER_THREAD = 3
"""Tasks that are handed out for each thread: one in work, one to follow, one on its way."""
WORKER_ENVIRONMENT = {"OMP_NUM_THREADS": 1}
"""Of the processes started here.  Dask's own has MALLOC_TRIM_THRESHOLD_ = 64 KiB too: glibc then gives memory back to
the kernel all the time and has it zeroed again."""
COMPARED = ("python", "dask", "distributed", "numpy")
"""Packages of which other versions may fail, or compute other last digits."""
STATES_AT_ONCE = 32
"""Files that are asked for their state at once: of 80 000 logs on a server that answers in 50 ms in two minutes."""
MAX_SENT_BYTES = 256 * 2**20
"""Bytes of a log that is sent along; it is in memory on its way."""


class BatchError(Exception):
    """The batch cannot be done, or not to its end; the text is one line."""


@dataclass(frozen=True, slots=True)
class Batch:
    """What came of a batch.

    Attributes
    ----------
    vehicles
        Rows of vehicles.parquet.
    errors
        Rows of errors.parquet.
    windows
        Windows of all logs.
    resumed, failed_before
        Logs that were done before this run, and those of them whose fault was kept.
    fleet
        Content of diagnosis.json; None where it was not asked for.
    cpu_seconds, log_bytes, duration
        Cost of the logs of this run: processor time [s] and bytes, for recordings of `duration` [s].
    """

    vehicles: list[dict[str, Any]]
    errors: list[dict[str, Any]]
    windows: int
    resumed: int
    failed_before: int
    fleet: dict[str, Any] | None
    cpu_seconds: float
    log_bytes: int
    duration: float


# --- from what the user names to jobs


def jobs_of(
    config: Config, name: str, logs: Sequence[str], load: Callable[[Path], Config], parts: Path | None = None
) -> list[Job]:
    """The jobs that the arguments of the command stand for, in the order of vehicle and log.

    Parameters
    ----------
    config, name
        The configuration for logs that have none of their own, and its file's name.
    logs
        Logs, folders, globs, URLs, or manifests: tables (CSV, Parquet) with a column `log`, and optionally `vehicle`,
        `configuration` and `start` (ISO 8601, or seconds since 1970).
    load
        Reads another configuration.
    parts
        Folder of parts to go on with: a log that was read before in a folder that is named here, and that is no longer
        there, keeps its job.

    Returns
    -------
    One job for each log.  Where no manifest names the vehicle, it is that of the folder in which the log lies.

    Raises
    ------
    ConfigError
        A configuration is wrong.
    BatchError
        There is no log, or a manifest cannot be read.
    """
    setups: dict[Path | None, Setup] = {}

    def setup(path: Path | None) -> Setup:
        if path not in setups:
            setups[path] = setup_of(config, name) if path is None else setup_of(load(path), path.name)
        return setups[path]

    suffixes = TABLE_SUFFIXES if config.table is not None else LOG_SUFFIXES
    setup(None)
    jobs: dict[str, Job] = {}
    before = _logs_of_parts(parts)
    for argument in logs:
        for entry in _entries(argument, config.table is not None):
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
    paths = [] if parts is None else sorted(parts.glob("*.gz"))
    return {path.stem: summary["log"] for path in paths if (summary := summary_of_part(path)) is not None}


def _lies_in(log: str, place: str) -> bool:
    """Whether a log, there or not, is one that a folder or a glob stands for."""
    pattern = _absolute(place).rstrip("/")
    if not glob.has_magic(pattern):
        return log.startswith(f"{pattern}/")
    return fnmatchcase(log, pattern) or fnmatchcase(log, f"{pattern}/*")


def _absolute(log: str) -> str:
    return log if "://" in log else os.path.abspath(log)


def _entries(argument: str, tables: bool) -> list[dict[str, str]]:
    """Rows of a manifest, or one row that names the argument itself, which may be a table of a test rig."""
    path = Path(argument)
    if path.suffix.lower() not in TABLE_SUFFIXES or not path.is_file():
        return [{"log": argument}]
    try:
        header, rows = _csv_rows(path) if path.suffix.lower() == ".csv" else _parquet_rows(path)
    except (OSError, ValueError, csv.Error) as error:
        raise BatchError(f"{argument}: not a table that can be read ({one_line(error, 100)})") from None
    if "log" not in header:
        if tables or len(header) in (0, CAN_CSV_COLUMNS):
            return [{"log": argument}]
        raise BatchError(f"{argument}: a manifest needs a column log; its columns are {', '.join(header) or 'none'}")
    if not rows:
        raise BatchError(f"{argument}: no row in it")
    return [_entry(path, number, row) for number, row in rows]


def _entry(manifest: Path, number: int, row: Mapping[str, Any]) -> dict[str, str]:
    """A row's texts; paths in it begin at the manifest's folder."""
    texts = {name: _cell(row[name]) for name in MANIFEST_COLUMNS if name in row}
    if not texts["log"]:
        raise BatchError(f"{manifest}: row {number} has no log")
    for name in ("log", "configuration"):
        text = texts.get(name)
        if text and "://" not in text and not (name == "configuration" and _is_machine(manifest.parent / text)):
            texts[name] = str(manifest.parent / text)
    return texts


def _cell(value: Any) -> str:
    """Text of a cell, empty where it is missing; pandas makes 7.0 of a whole number where others are missing."""
    if value is None or value != value:
        return ""
    return str(int(value) if isinstance(value, float) and value.is_integer() else value).strip()


def _is_machine(configuration: Path) -> bool:
    """Whether this can only be the name of a reference machine."""
    return not configuration.suffix and not configuration.exists()


def _csv_rows(path: Path) -> tuple[list[str], list[tuple[int, dict[str, Any]]]]:
    """Names of columns, and the rows of a manifest that are not empty with their lines' numbers."""
    with path.open(newline="", encoding="utf-8-sig") as text:
        first = text.readline()
        text.seek(0)
        table = csv.reader(text, delimiter=max(SEPARATORS, key=first.count), strict=True)
        header = [name.strip().lower() for name in next(table, [])]
        if "log" not in header:
            return header, []
        return header, [
            (table.line_num, dict(zip(header, row, strict=False))) for row in table if any(map(str.strip, row))
        ]


def _parquet_rows(path: Path) -> tuple[list[str], list[tuple[int, dict[str, Any]]]]:
    """Names of columns, and the numbered rows of a manifest."""
    import pyarrow.parquet as pq

    columns = pq.read_schema(path).names
    header = [name.strip().lower() for name in columns]
    if "log" not in header:
        return header, []
    wanted = [name for name, plain in zip(columns, header, strict=True) if plain in MANIFEST_COLUMNS]
    table = pq.read_table(path, columns=wanted)
    rows = table.rename_columns([name.strip().lower() for name in table.column_names]).to_pylist()
    return header, list(enumerate(rows, 1))


def _start(text: str | None, manifest: str) -> float | None:
    if not text or text.lower() in MISSING_CELLS:
        return None
    with suppress(ValueError):
        if math.isfinite(seconds := float(text)):
            return seconds
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        raise BatchError(f"{manifest}: start {text} is neither ISO 8601 nor seconds since 1970") from None
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()


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
    """What is named as logs are below a folder, behind links too, and each folder that cannot be read."""
    found: list[str] = []
    root = os.path.abspath(folder)
    walk = os.walk(root, followlinks=True, onerror=lambda error: found.append(error.filename))
    for place, folders, names in walk:
        folders[:] = [name for name in folders if not _is_double(Path(place, name), Path(root))]
        logs = [Path(place, name) for name in (*folders, *names) if _is_log(name, suffixes)]
        found += [
            str(log) for log in logs if not (_is_double(log, Path(root)) and _is_log(log.resolve().name, suffixes))
        ]
    return found


def _is_double(path: Path, root: Path) -> bool:
    """Whether this is a link to what is found below `root` anyway, or to a folder that it lies in itself."""
    if not path.is_symlink():
        return False
    target, ends = Path(os.path.realpath(path)), len(root.parents)
    above = [each for each in path.parents if len(each.parents) >= ends]
    return target.is_relative_to(os.path.realpath(root)) or any(
        Path(os.path.realpath(each)).is_relative_to(target) for each in above
    )


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
    return Path(name.lower().removesuffix(".gz")).suffix in suffixes


# --- Dask


@contextmanager
def cluster(address: str | None, say: Callable[[str], None], processes: int | None = None) -> Iterator[Any]:
    """A Dask client: of the scheduler at an address, or of one process for each core of this machine.

    Parameters
    ----------
    address
        Such as tcp://10.0.0.1:8786; None for this machine.
    say
        Called with a line for the user.
    processes
        Of this machine; one for each core by default.

    Raises
    ------
    BatchError
        There is no scheduler, it has no workers, or these have another soilbus.
    """
    dask: Any = import_module("dask")
    distributed: Any = import_module("distributed")  # typed only in part
    # Dask speaks of every worker that is lost; what it means for a log we say ourselves
    for name in list(logging.root.manager.loggerDict):  # Dask sets a level for some of them
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)
    settings = {
        "distributed.comm.timeouts.connect": CONNECT_TIMEOUT,
        "distributed.client.scheduler-info-interval": 2000,
        "distributed.worker.profile.enabled": False,  # it looks at the worker's threads a hundred times a second
        "distributed.nanny.pre-spawn-environ": WORKER_ENVIRONMENT,
    }
    with dask.config.set(settings):
        if address is None:
            options = {"threads_per_worker": 1, "processes": True, "silence_logs": logging.CRITICAL}
            here = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
            with (
                distributed.LocalCluster(processes, **options, **here) as local,
                distributed.Client(local) as client,
            ):
                _announce(client, say)
                yield client
            return
        try:
            with warnings.catch_warnings(category=distributed.versions.VersionMismatchWarning, action="ignore"):
                client = distributed.Client(address, timeout=CONNECT_TIMEOUT)
        except (OSError, TimeoutError, TypeError, ValueError) as error:  # TypeError: TLS without a certificate
            raise BatchError(f"{address}: no Dask scheduler there ({one_line(error, 100)})") from None
        with client:
            _check_workers(client, address)
            if others := _other_versions(client):
                say(f"{address}: other versions of {', '.join(others)} there than here: install the same everywhere")
            _announce(client, say)
            yield client


def _announce(client: Any, say: Callable[[str], None]) -> None:
    """Where Dask's own dashboard is, if there is one."""
    if find_spec("bokeh") and client.scheduler_info().get("services", {}).get("dashboard"):
        say(f"Dask's dashboard: {client.dashboard_link}")


def worker_version() -> str:
    """Version of soilbus on a worker."""
    return __version__


def _check_workers(client: Any, address: str) -> None:
    try:
        versions = set(client.run(worker_version).values())
    except Exception as error:  # of Dask, which cannot find this function there
        if "No module named 'soilbus'" in str(error):
            raise BatchError(f"{address}: its workers have no soilbus: install soilbus {__version__} there") from None
        what = f"its workers have another soilbus than {__version__}: install the same everywhere"
        raise BatchError(f"{address}: {what} ({one_line(error, 100)})") from None
    if not versions:
        raise BatchError(f"{address}: the scheduler has no workers")
    if others := sorted(versions - {__version__}):
        raise BatchError(
            f"{address}: workers have soilbus {', '.join(others)}, this is {__version__}: install the same everywhere"
        )


def _other_versions(client: Any) -> list[str]:
    """Packages whose version differs between this process, the scheduler and its workers."""
    found = client.get_versions()
    here, there = found["client"]["packages"], [found["scheduler"], *found["workers"].values()]
    return [name for name in COMPARED if any(each["packages"].get(name) != here.get(name) for each in there)]


def done_in_turn(
    client: Any, function: Callable[..., Any], tasks: Iterable[tuple[str, tuple[Any, ...]]]
) -> Iterator[tuple[str, Any]]:
    """Results as they come, by key; the exception itself where a task failed.

    Tasks are drawn one by one as others end, so that what travels with them is never in memory all at once.

    Raises
    ------
    BatchError
        The scheduler is lost.
    """
    as_completed: Any = import_module("distributed").as_completed
    waiting = iter(tasks)
    threads = sum(client.nthreads().values()) or 1
    name = function.__name__

    def submit(key: str, arguments: tuple[Any, ...]) -> Any:
        return client.submit(function, *arguments, key=f"{name}-{key}", pure=False)

    first = [submit(*task) for task in islice(waiting, TASKS_PER_THREAD * threads)]
    running = as_completed(first)
    del first  # Dask keeps the result of a task for as long as somebody holds its future
    for future in running:
        key = future.key.removeprefix(f"{name}-")
        if future.status == "cancelled":
            raise BatchError("the Dask scheduler is lost; --resume goes on from here")
        try:
            result = future.result() if future.status == "finished" else future.exception()
        except (CancelledError, OSError, TimeoutError):
            raise BatchError("the Dask scheduler is lost; --resume goes on from here") from None
        yield key, result
        future.release()
        for task in islice(waiting, 1):
            running.add(submit(*task))


# --- the batch


def check_out(out: Path, resume: bool) -> None:
    """Raises ConfigError where a folder holds results and no run is resumed, or other files that would be replaced."""
    if not resume and any((out / "parts").glob("*")):
        raise ConfigError([f"--out {out}: it holds results: go on with --resume, or take another folder"])
    if out.exists() and not out.is_dir():
        raise ConfigError([f"--out {out}: a file, no folder"])
    taken = [name for name in dataset.RESULTS if (out / name).exists()]
    if taken and not (resume and (out / "parts").is_dir()):
        what = f"it has no parts of a batch, but {taken[0]}, which would be replaced: take another folder"
        raise ConfigError([f"--out {out}: {what}"])


@contextmanager
def results_in(out: Path) -> Iterator[None]:
    """A folder for results that no other process writes to meanwhile; BatchError where one does, OSError."""
    (out / "parts").mkdir(parents=True, exist_ok=True)
    descriptor = os.open(out, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise BatchError(f"{out}: another soilbus batch writes its results there") from None
    except OSError:  # a network's file system without locks
        pass
    try:
        yield
    finally:
        os.close(descriptor)


def run_batch(
    client: Any,
    jobs: Sequence[Job],
    out: Path,
    progress: Callable[[str], None] = lambda _: None,
    diagnose: bool = False,
    retry: bool = False,
) -> Batch:
    """Replay all logs that are not done yet, then write the results of all.

    Parameters
    ----------
    client
        Of `cluster`.
    jobs
        The logs.
    out
        Folder for the results.
    progress
        Called with what is done.
    diagnose
        Whether to diagnose each vehicle over its logs, and the fleet.
    retry
        Whether to read logs that failed or were damaged again, and to diagnose vehicles again that lack a log.

    Raises
    ------
    ConfigError
        The configuration fits no log.
    BatchError
        The scheduler is lost, or workers have another version.
    NotWritten
        A file cannot be written.
    """
    parts = out / "parts"
    kept = {digest: each for digest, each in _all_kept(jobs, parts).items() if not (retry and each.fault)}
    outcomes = _replay_all(client, jobs, parts, kept, progress)
    of_logs: dict[str, Kept | Outcome] = {**kept, **outcomes}
    if jobs and sum(each.other_bus for each in of_logs.values()) == len(jobs):
        first = next(iter(of_logs.values())).fault
        names = ", ".join(sorted({job.setup.name for job in jobs}))
        raise ConfigError([f"{names}: fits no log: none of {len(jobs)} logs has a frame that its DBC knows ({first})"])
    summaries = {
        job.digest: summary for job in jobs if (summary := summary_of_part(_part_path(parts, job.digest))) is not None
    }
    errors = [
        {"vehicle": job.vehicle, "log": job.log, "windows": summary["windows.all"] if summary else 0, "fault": fault}
        for job in jobs
        for summary in [summaries.get(job.digest)]
        if (fault := summary["fault"] if summary else of_logs[job.digest].fault)
    ]
    logs = dataset.log_rows(summaries.values())
    vehicles = dataset.vehicle_rows(logs, errors)
    _write_windows(client, jobs, summaries, out, progress)
    dataset.write_rows(out / "errors.parquet", errors, dataset.ERROR_COLUMNS)
    if logs:
        dataset.write_rows(out / "logs.parquet", logs)
    else:
        (out / "logs.parquet").unlink(missing_ok=True)
    dataset.write_rows(out / "vehicles.parquet", vehicles)
    return Batch(
        vehicles,
        errors,
        sum(summary["windows.all"] for summary in summaries.values()),
        len(jobs) - len(outcomes),
        sum(each.fault is not None for each in kept.values()),
        _diagnose_all(client, jobs, summaries, out, progress, retry) if diagnose else None,
        math.fsum(outcome.cpu_seconds for outcome in outcomes.values()),
        sum(outcome.log_bytes for outcome in outcomes.values()),
        math.fsum(summary["duration"] for digest, summary in summaries.items() if digest in outcomes),
    )


def _part_path(parts: Path, digest: str) -> Path:
    return parts / f"{digest}.gz"


@dataclass(frozen=True, slots=True)
class Kept:
    """What came of a log, as in an Outcome, and the state of its file: size in bytes, time of change [ns]."""

    fault: str | None
    windows: int
    other_bus: bool
    size: int
    changed: int | None

    def is_of(self, size: int | None, changed: int | None) -> bool:
        """Whether a file in this state is still the same, as far as its state is known."""
        return size in (self.size, None) and (changed == self.changed or None in (changed, self.changed))


def _kept_path(parts: Path, digest: str) -> Path:
    return parts / f"{digest}.kept"


def _all_kept(jobs: Sequence[Job], parts: Path) -> dict[str, Kept]:
    """What came before, by digest, of logs whose files are still the same; what is there of others is removed."""
    with ThreadPoolExecutor(STATES_AT_ONCE) as threads:
        kept = dict(zip((job.digest for job in jobs), threads.map(lambda job: _kept(parts, job), jobs), strict=True))
    same = {digest: one for digest, one in kept.items() if one is not None}
    for digest in kept.keys() - same.keys():
        _part_path(parts, digest).unlink(missing_ok=True)
        _kept_path(parts, digest).unlink(missing_ok=True)
    return same


def _kept(parts: Path, job: Job) -> Kept | None:
    """What came of a log before; None where there is nothing, its part is lost, or its file is another one."""
    try:
        kept = Kept(**json.loads(_kept_path(parts, job.digest).read_bytes()))
    except (OSError, ValueError, TypeError):
        return None
    if kept.windows and summary_of_part(_part_path(parts, job.digest)) is None:
        return None
    return kept if kept.is_of(*_state_of(job.log)) else None


def _state_of(log: str) -> tuple[int | None, int | None]:
    """Size [bytes] of a log and, of a file, when it was changed [ns]; None where this machine cannot say."""
    if "://" in log:
        from fsspec.core import url_to_fs

        try:
            files, name = url_to_fs(log)
            return files.size(name), None
        except Exception:  # each protocol has its own
            return None, None
    try:
        state = Path(log).stat()
    except OSError:
        return None, None
    return state.st_size, state.st_mtime_ns


def _replay_all(
    client: Any, jobs: Sequence[Job], parts: Path, kept: Mapping[str, Kept], progress: Callable[[str], None]
) -> dict[str, Outcome]:
    """Outcomes, by digest, of the logs of which nothing is kept."""
    left = {job.digest: job for job in jobs if job.digest not in kept}
    outcomes: dict[str, Outcome] = {}
    states: dict[str, tuple[int | None, int | None]] = {}
    unseen = _unseen_folders(client, left.values())

    def task(job: Job) -> tuple[Job, str]:
        states[job.digest] = (None, None) if "://" in job.log else _state_of(job.log)
        return _carrying(job, unseen), __version__

    failed = 0
    for digest, result in done_in_turn(client, part_of, ((digest, task(job)) for digest, job in left.items())):
        outcome = _outcome(left[digest], result)
        outcomes[digest] = replace(outcome, part=None)
        size, changed = states.pop(digest)
        if outcome.part is not None or outcome.lasting:
            size = outcome.log_bytes if size is None else size
            record = Kept(outcome.fault, outcome.windows, outcome.other_bus, size, changed)
            dataset.put(_kept_path(parts, digest), json.dumps(asdict(record)).encode())
        if outcome.part is not None:  # last: with it the log is done
            dataset.put(_part_path(parts, digest), outcome.part)
        failed += outcome.part is None
        done = len(jobs) - len(left) + len(outcomes)
        progress(f"{done} of {len(jobs)} logs" + (f", {failed} failed" if failed else ""))
    return outcomes


def _outcome(job: Job, result: Outcome | BaseException) -> Outcome:
    """The outcome of a task; of one that ended with an exception, what it says."""
    if isinstance(result, Outcome):
        return result
    if isinstance(result, OtherVersion):
        raise BatchError(str(result))
    if type(result).__name__ == "KilledWorker":
        return Outcome(None, f"{job.log}: its worker died each time it was tried (out of memory?)")
    return Outcome(None, f"{job.log}: {one_line(Exception(str(result)), 200)} ({type(result).__name__})")


def unseen_of(folders: Sequence[str]) -> list[str]:
    """Those of the folders that are not on this machine."""
    return [folder for folder in folders if not Path(folder).is_dir()]


def _unseen_folders(client: Any, jobs: Iterable[Job]) -> set[str]:
    """Folders of logs that are here and that some worker does not see."""
    folders = sorted({str(Path(job.log).parent) for job in jobs if "://" not in job.log})
    here = [folder for folder in folders if Path(folder).is_dir()]
    return {folder for unseen in client.run(unseen_of, here).values() for folder in unseen} if here else set()


def _carrying(job: Job, unseen: set[str]) -> Job:
    """The job with its log where workers do not see it, or why it is not sent along."""
    if "://" in job.log or str(Path(job.log).parent) not in unseen:
        return job
    path = Path(job.log)
    try:
        size = path.stat().st_size
        if size <= MAX_SENT_BYTES:
            return replace(job, content=path.read_bytes())
    except FileNotFoundError:
        return job
    except OSError as error:
        return replace(job, not_sent=f"{job.log}: {one_line(error, 200)}")
    what = f"workers do not see this path, and with {math.ceil(size / 2**20)} MiB it is too large to be sent along"
    how = f"(at most {MAX_SENT_BYTES / 2**20:g} MiB): put it where they see the same path, or name it by a URL"
    return replace(job, not_sent=f"{job.log}: {what} {how}")


def _write_windows(
    client: Any,
    jobs: Sequence[Job],
    summaries: Mapping[str, Mapping[str, Any]],
    out: Path,
    progress: Callable[[str], None],
) -> None:
    """The parts as tables by vehicle and day, and the map of them."""
    new, windows, vehicles = out / ".windows", out / "windows", {job.digest: job.vehicle for job in jobs}
    shutil.rmtree(new, ignore_errors=True)  # of a run that was stopped
    if not summaries:
        shutil.rmtree(windows, ignore_errors=True)
        (out / "map.parquet").unlink(missing_ok=True)
        return
    columns = dataset.window_columns(summaries.values())
    tasks = ((digest, (_part_path(out / "parts", digest).read_bytes(), columns)) for digest in summaries)
    for n, (digest, files) in enumerate(done_in_turn(client, dataset.day_files, tasks), 1):
        if isinstance(files, BaseException):
            part, why = _part_path(out / "parts", digest), one_line(Exception(str(files)), 100)
            raise BatchError(f"{part}: cannot be converted ({why}): delete it, and --resume reads its log again")
        for day, content in files.items():
            dataset.put(dataset.folder_of(new, vehicles[digest], day) / f"{digest}.parquet", content)
        progress(f"tables of {n} of {len(summaries)} logs")
    dataset.replace_folder(new, windows)
    progress("map")
    dataset.write_map(out / "map.parquet", windows)


def _diagnose_all(
    client: Any,
    jobs: Sequence[Job],
    summaries: Mapping[str, Mapping[str, Any]],
    out: Path,
    progress: Callable[[str], None],
    retry: bool,
) -> dict[str, Any]:
    """Findings of every vehicle, kept one by one, those of each type together, and the fleet's diagnosis of them."""
    groups: dict[tuple[str, str], list[Job]] = {}
    for job in sorted(jobs, key=lambda job: (summaries.get(job.digest, {}).get("begin") or 0, job.log)):
        if job.digest in summaries:
            groups.setdefault((job.setup.digest, job.vehicle), []).append(job)
    types: dict[str, list[list[Job]]] = {}
    for (setup, _), group in sorted(groups.items()):
        types.setdefault(setup, []).append(chosen(group))
    found = [
        findings_of_type(
            vehicles[0][0].setup,
            len(vehicles),
            partial(_diagnosed, client, vehicles, parts=out / "parts", progress=progress, retry=retry),
        )
        for vehicles in types.values()
    ]
    fleet = judged([of_type for of_type, _ in found], [each for _, findings in found for each in findings])
    dataset.put(out / "diagnosis.json", (json.dumps(known(fleet), indent=1, allow_nan=False) + "\n").encode())
    dataset.write_rows(out / "effects.parquet", effect_rows(fleet), dataset.EFFECT_COLUMNS)
    return fleet


def _diagnosed(
    client: Any,
    vehicles: Sequence[Sequence[Job]],
    given: Sequence[Given],
    parts: Path,
    progress: Callable[[str], None],
    retry: bool,
) -> list[dict[str, Any]]:
    """Findings of each vehicle beside the effects given for it; those that are kept are not made again."""
    kept = [parts / f"{_digest_of(jobs, each, parts)}.json" for jobs, each in zip(vehicles, given, strict=True)]
    left = {path.stem: v for v, path in enumerate(kept) if not _are_kept(path, retry)}
    unseen = _unseen_folders(client, (job for v in left.values() for job in vehicles[v]))
    tasks = (
        (digest, ([_carrying(job, unseen) for job in vehicles[v]], __version__, given[v])) for digest, v in left.items()
    )
    for n, (digest, findings) in enumerate(done_in_turn(client, findings_of, tasks), 1):
        if isinstance(findings, OtherVersion):
            raise BatchError(str(findings))
        if isinstance(findings, BaseException):
            fault = f"{one_line(Exception(str(findings)), 200)} ({type(findings).__name__})"
            findings = no_findings(vehicles[left[digest]][0].vehicle, fault)
        dataset.put(kept[left[digest]], json.dumps(known(findings), indent=1, allow_nan=False).encode())
        beside = f" beside {', '.join(given[0])}" if given[0] else ""
        progress(f"{n} of {len(left)} vehicles diagnosed{beside}")
    return [json.loads(path.read_bytes()) for path in kept]


def _are_kept(path: Path, retry: bool) -> bool:
    """Whether a vehicle's findings are there; with `retry` those that lack a log are not."""
    if not path.exists():
        return False
    findings = json.loads(path.read_bytes()) if retry else {}
    return not (findings.get("fault") or findings.get("left_out"))


def _digest_of(jobs: Sequence[Job], given: Given, parts: Path) -> str:
    """Names the findings of a vehicle: of its logs as they were read, and the effects given."""
    of = hashlib.sha256(json.dumps(given, sort_keys=True).encode())
    for job in jobs:
        of.update(job.digest.encode() + _kept_path(parts, job.digest).read_bytes())
    return of.hexdigest()[:24]
