"""Many logs at once: each log its own task, its result on disk at once, what is done never done again.

    LOG...  ->  jobs  ->  parts/DIGEST.parquet, DIGEST.json (one log)  ->  windows, summaries, errors, map

Only logs that have no part yet are replayed, so a run that is stopped loses only the logs in work. The fault of a log
is kept as well, and the state of its file: a log whose file changed is read again. Workers need neither the
configuration nor the DBC files nor the output folder: settings travel with a job, and parts come back. Workers open a
log by its path or URL.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from soilbus.config.model import ConfigError
from soilbus.export.table import parquet_of
from soilbus.files import LIMITS, read_bounded
from soilbus.grouping import grouped
from soilbus.offline import dataset
from soilbus.offline.cluster import BatchError, done_in_turn
from soilbus.offline.fleet import chosen, effect_rows, findings_of, judged, no_findings
from soilbus.offline.parts import Job, Outcome, kept_of, part_of, part_path
from soilbus.pipeline.outputs import known
from soilbus.words import one_line, shown

STATES_AT_ONCE = 32
"""Files that are asked for their state at once: of 80 000 logs on a server that answers in 50 ms in two minutes."""
OF_DIAGNOSIS = ("diagnosis.json", "effects.parquet")
"""What `--diagnose` writes."""
Say = Callable[[str], None]
"""Says what is done."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Result of a batch: rows of vehicles.parquet and errors.parquet, and what else the command says.

    Of the logs that were done before this run (`resumed`) those of a kept fault are `failed_before`. `fleet` is the
    content of diagnosis.json where that was asked for; `stale_diagnosis`: that of an earlier run was there, and is
    removed.
    """

    vehicles: list[dict[str, Any]]
    errors: list[dict[str, Any]]
    windows: int
    resumed: int
    failed_before: int
    fleet: dict[str, Any] | None
    stale_diagnosis: bool = False


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
    client: Any, jobs: Sequence[Job], out: Path, say: Say = lambda _: None, diagnose: bool = False, retry: bool = False
) -> Batch:
    """Replay all logs that are not done yet, then write the results of all into a folder.

    With `diagnose` each vehicle is diagnosed over its logs, and the fleet. With `retry` logs that failed or were
    damaged are read again, and vehicles diagnosed again that lack a log. `say` is called with what is done.

    ConfigError where the configuration fits no log; BatchError where the scheduler is lost, or a part cannot be read;
    NotWritten where a file cannot be written.
    """
    parts = out / "parts"
    before = {digest: each for digest, each in _all_kept(jobs, parts).items() if not (retry and each.fault)}
    of_logs = before | _replay_all(client, jobs, parts, before, say)
    if jobs and sum(each.other_bus for each in of_logs.values()) == len(jobs):
        first = next(iter(of_logs.values())).fault
        names = ", ".join(sorted({job.setup.name for job in jobs}))
        raise ConfigError([f"{names}: fits no log: none of {len(jobs)} logs has a frame that its DBC knows ({first})"])
    summaries = {job.digest: summary for job in jobs if (summary := of_logs[job.digest].summary) is not None}
    windows = {digest: summary["windows.all"] for digest, summary in summaries.items()}
    failed = [(job, fault, windows.get(job.digest, 0)) for job in jobs if (fault := of_logs[job.digest].fault)]
    errors = [{"vehicle": of.vehicle, "log": of.log, "windows": n, "fault": shown(why)} for of, why, n in failed]
    logs = dataset.log_rows(summaries.values())
    vehicles = dataset.vehicle_rows(logs, errors)
    say("tables")
    dataset.write_windows(out, [part_path(parts, digest) for digest in summaries])
    dataset.put(out / "errors.parquet", parquet_of(errors, dataset.ERROR_COLUMNS))
    if logs:
        dataset.put(out / "logs.parquet", parquet_of(logs))
    else:
        (out / "logs.parquet").unlink(missing_ok=True)
    dataset.put(out / "vehicles.parquet", parquet_of(vehicles))
    stale = [] if diagnose else [path for name in OF_DIAGNOSIS if (path := out / name).exists()]
    for path in stale:
        path.unlink()
    fleet = _diagnose_all(client, jobs, summaries, out, say, retry) if diagnose else None
    failed_before = sum(each.fault is not None for each in before.values())
    return Batch(vehicles, errors, sum(windows.values()), len(before), failed_before, fleet, bool(stale))


def _all_kept(jobs: Sequence[Job], parts: Path) -> dict[str, Outcome]:
    """What came before, by digest, of logs whose files are still the same; what is there of others is removed."""
    same = {}
    with ThreadPoolExecutor(STATES_AT_ONCE) as threads:
        for job, state in zip(jobs, threads.map(lambda job: _state_of(job.log), jobs), strict=True):
            kept = kept_of(parts, job.digest)
            if kept is not None and kept.is_of(*state):
                same[job.digest] = kept
            else:
                for path in parts.glob(f"{job.digest}.*"):
                    path.unlink()
    return same


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
    client: Any, jobs: Sequence[Job], parts: Path, before: Mapping[str, Outcome], progress: Say
) -> dict[str, Outcome]:
    """What comes of each log of which nothing is kept, by digest; on disk where the same log gives it again."""
    left = {job.digest: job for job in jobs if job.digest not in before}
    found: dict[str, Outcome] = {}
    states: dict[str, tuple[int | None, int | None]] = {}

    def task(job: Job) -> tuple[Job]:
        states[job.digest] = (None, None) if "://" in job.log else _state_of(job.log)
        return (job,)

    failed = 0
    for digest, result in done_in_turn(client, part_of, ((digest, task(job)) for digest, job in left.items())):
        of, part = (_failed(left[digest], result), b"") if isinstance(result, BaseException) else result
        size, changed = states.pop(digest)
        found[digest] = of = replace(of, size=of.size if size is None else size, changed=changed)
        if part:
            dataset.put(part_path(parts, digest), part)
        if part or of.lasting:  # last: with it the log is done
            dataset.put(parts / f"{digest}.json", json.dumps(asdict(of), allow_nan=False).encode())
        failed += not part
        progress(f"{len(before) + len(found)} of {len(jobs)} logs" + (f", {failed} failed" if failed else ""))
    return found


def _failed(job: Job, error: BaseException) -> Outcome:
    """The outcome of a task that ended with an exception."""
    if type(error).__name__ == "KilledWorker":
        return Outcome(f"{job.log}: its worker died each time it was tried (out of memory?)")
    return Outcome(f"{job.log}: {one_line(Exception(str(error)), 200)} ({type(error).__name__})")


def _diagnose_all(
    client: Any, jobs: Sequence[Job], summaries: Mapping[str, Mapping[str, Any]], out: Path, progress: Say, retry: bool
) -> dict[str, Any]:
    """Findings of every vehicle, kept one by one, and the fleet's diagnosis of them."""
    read = [job for job in jobs if job.digest in summaries]
    read.sort(key=lambda job: (summaries[job.digest].get("begin") or 0, job.log))
    of_vehicles = grouped(read, lambda job: (job.setup.digest, job.vehicle))
    vehicles = [chosen(group) for _, group in sorted(of_vehicles.items())]
    found = _diagnosed(client, vehicles, out / "parts", progress, retry)
    named = [group[0].setup.name for group in vehicles]
    fleet = judged([each | {"configuration": name} for each, name in zip(found, named, strict=True)])
    dataset.put(out / OF_DIAGNOSIS[0], (json.dumps(known(fleet), indent=1, allow_nan=False) + "\n").encode())
    dataset.put(out / OF_DIAGNOSIS[1], parquet_of(effect_rows(fleet), dataset.EFFECT_COLUMNS))
    return fleet


def _diagnosed(
    client: Any, vehicles: Sequence[Sequence[Job]], parts: Path, progress: Say, retry: bool
) -> list[dict[str, Any]]:
    """Findings of each vehicle; those that are kept are not made again."""

    def is_kept(path: Path) -> bool:
        """Whether a vehicle's findings are there; with `retry` those that lack a log are not."""
        findings = json.loads(read_bounded(path, LIMITS.whole)) if retry and path.exists() else {}
        return path.exists() and not (findings.get("fault") or findings.get("left_out"))

    kept = []
    for jobs in vehicles:
        of = hashlib.sha256()  # of its logs as they were read
        for job in jobs:
            of.update(job.digest.encode() + (parts / f"{job.digest}.json").read_bytes())
        kept.append(parts / f"{of.hexdigest()[:24]}.json")
    left = {path.stem: v for v, path in enumerate(kept) if not is_kept(path)}
    tasks = ((digest, (vehicles[v],)) for digest, v in left.items())
    for n, (digest, findings) in enumerate(done_in_turn(client, findings_of, tasks), 1):
        if isinstance(findings, BaseException):
            fault = f"{one_line(Exception(str(findings)), 200)} ({type(findings).__name__})"
            findings = no_findings(vehicles[left[digest]][0].vehicle, fault)
        dataset.put(kept[left[digest]], json.dumps(known(findings), indent=1, allow_nan=False).encode())
        progress(f"{n} of {len(left)} vehicles diagnosed")
    return [json.loads(read_bounded(path, LIMITS.whole)) for path in kept]
