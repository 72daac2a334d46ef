"""Many logs at once: each log its own task, its result on disk at once, what is done never done again.

    LOG...  ->  jobs  ->  parts/DIGEST.gz (one a log)  ->  windows, summaries, errors, map

Only logs that have no part yet are replayed, so a run that is stopped loses only the logs in work. The fault of a log
is kept as well, and beside both the state of its file (parts/DIGEST.kept): a log whose file changed is read again.
Workers need neither the configuration nor the DBC files nor the output folder: settings travel with a job, and parts
come back. Workers open a log by its path or URL; where they do not see the path, it is sent along.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import math
import os
import shutil
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import accumulate, islice
from pathlib import Path
from typing import Any

from soilbus import __version__
from soilbus.config.model import ConfigError
from soilbus.files import LIMITS, read_bounded
from soilbus.grouping import grouped
from soilbus.offline import dataset
from soilbus.offline.fleet import (
    chosen,
    effect_rows,
    findings_of,
    judged,
    no_findings,
)
from soilbus.offline.jobs import BatchError, jobs_of
from soilbus.offline.local_workers import LocalWorkers, local_workers
from soilbus.offline.parts import (
    WINDOWS_OF_PIECE,
    Job,
    OtherVersion,
    Outcome,
    Rest,
    part_of,
    piece_left,
    pieces_of_part,
    summary_of_part,
)
from soilbus.pipeline.outputs import known
from soilbus.words import one_line, shown

__all__ = ["Batch", "BatchError", "check_out", "cluster", "jobs_of", "results_in", "run_batch", "workers_watched"]

CONNECT_TIMEOUT = 10.0
"""Seconds in which a scheduler must answer."""
WORKERS_COUNTED_EVERY = 10.0
"""Seconds after which a scheduler is asked again whether it has workers; no evidence recorded."""
TASKS_PER_THREAD = 3
"""Tasks that are handed out for each thread: one in work, one to follow, one on its way."""
COMPARED = ("python", "dask", "distributed", "numpy")
"""Packages of which other versions may fail, or compute other last digits."""
STATES_AT_ONCE = 32
"""Files that are asked for their state at once: of 80 000 logs on a server that answers in 50 ms in two minutes."""
OF_DIAGNOSIS = ("diagnosis.json", "effects.parquet")
"""What `--diagnose` writes."""
MAX_SENT_BYTES = 256 * 2**20
"""Bytes of a log that is sent along; it is in memory on its way."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Result of a batch.

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
    stale_diagnosis
        Whether that of an earlier run was there, and is removed.
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
    stale_diagnosis: bool = False


class WorkerLost(Exception):
    """Error of a worker that is gone with something it kept for us."""


# --- Dask


@contextmanager
def cluster(address: str | None, say: Callable[[str], None], processes: int | None = None) -> Iterator[Any]:
    """Give a Dask client of the scheduler at an address, or processes of this machine with the same use.

    Parameters
    ----------
    address
        Such as tcp://10.0.0.1:8786; None for this machine, where no port is opened.
    say
        Called with a line for the user.
    processes
        Of this machine; one for each core by default.

    Raises
    ------
    BatchError
        There is no scheduler, it has no workers, or these have another soilbus.
    """
    if address is None:
        with local_workers(processes) as local:
            yield local
        return
    dask: Any = import_module("dask")
    distributed: Any = import_module("distributed")  # typed only in part
    # Dask speaks of every worker that is lost; what it means for a log we say ourselves
    for name in list(logging.root.manager.loggerDict):  # Dask sets a level for some of them
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)
    settings = {
        "distributed.comm.timeouts.connect": CONNECT_TIMEOUT,
        "distributed.client.scheduler-info-interval": 2000,
    }
    with dask.config.set(settings):
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
            with workers_watched(client, partial(_say_of, address, say)):
                yield client


def _announce(client: Any, say: Callable[[str], None]) -> None:
    """Where Dask's own dashboard is, if there is one."""
    if find_spec("bokeh") and client.scheduler_info().get("services", {}).get("dashboard"):
        say(f"Dask's dashboard: {client.dashboard_link}")


def _say_of(address: str, say: Callable[[str], None], has_workers: bool) -> None:
    lost = "its workers are gone: the batch waits until one comes back (ctrl-C stops it, --resume goes on from here)"
    say(f"{address}: {'it has workers again' if has_workers else lost}")


@contextmanager
def workers_watched(
    client: Any, report: Callable[[bool], None], every: float = WORKERS_COUNTED_EVERY
) -> Iterator[None]:
    """Call `report` with False when the last worker of a scheduler has gone, and with True when there is one again.

    every: time between two looks [s].  A scheduler that is lost itself ends the watch: its tasks are cancelled.
    """
    ended = threading.Event()

    def watch() -> None:
        had_workers = True
        while not ended.wait(every):
            try:
                has_workers = bool(client.nthreads())
            except Exception:  # of each protocol its own
                return
            if has_workers != had_workers:
                report(has_workers)
            had_workers = has_workers

    thread = threading.Thread(target=watch, name="workers", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def worker_version() -> str:
    """Return the version of soilbus on a worker."""
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
    """Yield results as they come, by key; the exception itself where a task failed.

    Tasks are drawn one by one as others end, so that what travels with them is never in memory all at once.

    Raises
    ------
    BatchError
        The scheduler is lost.
    """
    if isinstance(client, LocalWorkers):
        yield from client.done_in_turn(function, tasks)
        return
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
    """Raise ConfigError where a folder holds results that no run resumes, or other files."""
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
    """Lock a folder for results; BatchError where another process writes to it, OSError."""
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
    of_piece: int = WINDOWS_OF_PIECE,
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
    of_piece
        Windows of a log that are in memory at once, here and on the workers.

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
    outcomes = _replay_all(client, jobs, parts, kept, progress, of_piece)
    of_logs: dict[str, Kept | Outcome] = {**kept, **outcomes}
    if jobs and sum(each.other_bus for each in of_logs.values()) == len(jobs):
        first = next(iter(of_logs.values())).fault
        names = ", ".join(sorted({job.setup.name for job in jobs}))
        raise ConfigError([f"{names}: fits no log: none of {len(jobs)} logs has a frame that its DBC knows ({first})"])
    summaries = {
        job.digest: summary for job in jobs if (summary := summary_of_part(_part_path(parts, job.digest))) is not None
    }
    errors = [
        {
            "vehicle": job.vehicle,
            "log": job.log,
            "windows": summary["windows.all"] if summary else 0,
            "fault": shown(fault),
        }
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
    stale = [] if diagnose else [path for name in OF_DIAGNOSIS if (path := out / name).exists()]
    for path in stale:
        path.unlink()
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
        bool(stale),
    )


def _part_path(parts: Path, digest: str) -> Path:
    return parts / f"{digest}.gz"


@dataclass(frozen=True, slots=True)
class Kept:
    """Result of a log, as in an Outcome, and the state of its file: size in bytes, time of change [ns]."""

    fault: str | None
    windows: int
    other_bus: bool
    size: int
    changed: int | None

    def is_of(self, size: int | None, changed: int | None) -> bool:
        """Return whether a file in this state is still the same, as far as its state is known."""
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
        kept = Kept(**json.loads(read_bounded(_kept_path(parts, job.digest), LIMITS.whole)))
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
    client: Any,
    jobs: Sequence[Job],
    parts: Path,
    kept: Mapping[str, Kept],
    progress: Callable[[str], None],
    of_piece: int,
) -> dict[str, Outcome]:
    """Outcomes, by digest, of the logs of which nothing is kept."""
    left = {job.digest: job for job in jobs if job.digest not in kept}
    outcomes: dict[str, Outcome] = {}
    states: dict[str, tuple[int | None, int | None]] = {}
    unseen = _unseen_folders(client, left.values())

    def task(job: Job) -> tuple[Job, str, int]:
        states[job.digest] = (None, None) if "://" in job.log else _state_of(job.log)
        return _carrying(job, unseen), __version__, of_piece

    failed = 0
    for digest, result in done_in_turn(client, part_of, ((digest, task(job)) for digest, job in left.items())):
        outcome = _outcome(left[digest], result)
        size, changed = states.pop(digest)
        if outcome.part is not None or outcome.lasting:
            size = outcome.log_bytes if size is None else size
            record = Kept(outcome.fault, outcome.windows, outcome.other_bus, size, changed)
            dataset.put(_kept_path(parts, digest), [json.dumps(asdict(record)).encode()])
        if outcome.part is not None:  # last: with it the log is done
            try:
                dataset.put(_part_path(parts, digest), _pieces(client, outcome.part, outcome.rest))
            except WorkerLost:
                fault = f"{left[digest].log}: its worker was lost before it handed over all windows"
                outcome = Outcome(None, fault, cpu_seconds=outcome.cpu_seconds, log_bytes=outcome.log_bytes)
        outcomes[digest] = replace(outcome, part=None)
        failed += outcome.part is None
        done = len(jobs) - len(left) + len(outcomes)
        progress(f"{done} of {len(jobs)} logs" + (f", {failed} failed" if failed else ""))
    return outcomes


def _pieces(client: Any, first: bytes, rest: Rest | None) -> Iterator[bytes]:
    """A part as it comes from its worker; WorkerLost.

    Not as a task: it would wait until the log that is in work there is done.
    """
    yield first
    if rest is None:
        return
    for begin, size in zip(accumulate(rest.sizes, initial=0), rest.sizes, strict=False):
        try:
            piece = client.run(piece_left, rest.path, begin, size, workers=[rest.worker])[rest.worker]
        except Exception as error:  # of each protocol its own
            raise WorkerLost from error
        yield piece


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
    """Return those of the folders that are not on this machine."""
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
    tasks = (
        (f"{digest}-{n:03}", (piece, columns))
        for digest, summary in summaries.items()
        for n, piece in enumerate(pieces_of_part(_part_path(out / "parts", digest), summary["pieces"]))
    )
    pieces = sum(len(summary["pieces"]) for summary in summaries.values())
    for done, (name, files) in enumerate(done_in_turn(client, dataset.day_files, tasks), 1):
        digest = name.partition("-")[0]
        if isinstance(files, BaseException):
            part, why = _part_path(out / "parts", digest), one_line(Exception(str(files)), 100)
            raise BatchError(f"{part}: cannot be converted ({why}): delete it, and --resume reads its log again")
        for day, content in files.items():
            dataset.put(dataset.folder_of(new, vehicles[digest], day) / f"{name}.parquet", [content])
        progress(f"tables: {done} of {pieces}")
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
    """Findings of every vehicle, kept one by one, and the fleet's diagnosis of them."""
    read = [job for job in jobs if job.digest in summaries]
    read.sort(key=lambda job: (summaries[job.digest].get("begin") or 0, job.log))
    of_vehicles = grouped(read, lambda job: (job.setup.digest, job.vehicle))
    vehicles = [chosen(group) for _, group in sorted(of_vehicles.items())]
    found = _diagnosed(client, vehicles, out / "parts", progress, retry)
    named = [group[0].setup.name for group in vehicles]
    fleet = judged([each | {"configuration": name} for each, name in zip(found, named, strict=True)])
    dataset.put(out / OF_DIAGNOSIS[0], [(json.dumps(known(fleet), indent=1, allow_nan=False) + "\n").encode()])
    dataset.write_rows(out / OF_DIAGNOSIS[1], effect_rows(fleet), dataset.EFFECT_COLUMNS)
    return fleet


def _diagnosed(
    client: Any,
    vehicles: Sequence[Sequence[Job]],
    parts: Path,
    progress: Callable[[str], None],
    retry: bool,
) -> list[dict[str, Any]]:
    """Findings of each vehicle; those that are kept are not made again."""
    kept = [parts / f"{_digest_of(jobs, parts)}.json" for jobs in vehicles]
    left = {path.stem: v for v, path in enumerate(kept) if not _are_kept(path, retry)}
    unseen = _unseen_folders(client, (job for v in left.values() for job in vehicles[v]))
    tasks = ((digest, ([_carrying(job, unseen) for job in vehicles[v]], __version__)) for digest, v in left.items())
    for n, (digest, findings) in enumerate(done_in_turn(client, findings_of, tasks), 1):
        if isinstance(findings, OtherVersion):
            raise BatchError(str(findings))
        if isinstance(findings, BaseException):
            fault = f"{one_line(Exception(str(findings)), 200)} ({type(findings).__name__})"
            findings = no_findings(vehicles[left[digest]][0].vehicle, fault)
        dataset.put(kept[left[digest]], [json.dumps(known(findings), indent=1, allow_nan=False).encode()])
        progress(f"{n} of {len(left)} vehicles diagnosed")
    return [json.loads(read_bounded(path, LIMITS.whole)) for path in kept]


def _are_kept(path: Path, retry: bool) -> bool:
    """Whether a vehicle's findings are there; with `retry` those that lack a log are not."""
    if not path.exists():
        return False
    findings = json.loads(read_bounded(path, LIMITS.whole)) if retry else {}
    return not (findings.get("fault") or findings.get("left_out"))


def _digest_of(jobs: Sequence[Job], parts: Path) -> str:
    """Names the findings of a vehicle: of its logs as they were read."""
    of = hashlib.sha256()
    for job in jobs:
        of.update(job.digest.encode() + _kept_path(parts, job.digest).read_bytes())
    return of.hexdigest()[:24]
