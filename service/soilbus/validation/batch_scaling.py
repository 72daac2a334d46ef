"""How much faster a batch is on several processes, and what an hour of log costs.

    python -m soilbus.validation.batch_scaling [--logs 8] [--seconds 60] [--workers 2]

The same simulated logs are replayed three ways in one run: one after the other in one process, by a pool of
multiprocessing, and as `soilbus batch` does.  Workers are started, and have replayed a log, before the clock
runs.  On a machine with other work only the ratio of the two parallel ways and the CPU seconds mean something; the load
is printed beside them.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from soilbus import __version__
from soilbus.can.log_writer import write_log
from soilbus.offline.batch import cluster, done_in_turn
from soilbus.offline.parts import Job, Outcome, part_of, setup_of
from soilbus.simulator.frames import frames
from soilbus.simulator.play import scenario_over
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration


def jobs_in(folder: Path, logs: int, seconds: float) -> list[Job]:
    """Simulated logs, each of another drive."""
    config = reference_configuration()
    setup = setup_of(config, "tractor.toml")
    paths = [folder / f"{n}.log" for n in range(logs)]
    for seed, path in enumerate(paths, 1):
        write_log(frames(simulate(config, scenario_over(["loam"], seconds), seed), config), path)
    return [Job(str(path), "tractor", setup) for path in paths]


def replayed(job: Job) -> Outcome:
    """One log, for a pool."""
    return part_of(job, __version__)


def in_one_process(jobs: Sequence[Job], _: int) -> tuple[float, list[Outcome]]:
    """Wall time [s] and outcomes."""
    replayed(jobs[0])
    begin = time.perf_counter()
    outcomes = [replayed(job) for job in jobs]
    return time.perf_counter() - begin, outcomes


def by_multiprocessing(jobs: Sequence[Job], workers: int) -> tuple[float, list[Outcome]]:
    """The same with multiprocessing's pool."""
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        pool.map(replayed, [jobs[0]] * workers, chunksize=1)
        begin = time.perf_counter()
        outcomes = pool.map(replayed, jobs, chunksize=1)
        return time.perf_counter() - begin, outcomes


def by_batch(jobs: Sequence[Job], workers: int) -> tuple[float, list[Outcome]]:
    """The same with the processes of `soilbus batch`."""
    with cluster(None, print, workers) as client:
        client.run(replayed, jobs[0])
        begin = time.perf_counter()
        results = dict(done_in_turn(client, part_of, ((job.digest, (job, __version__)) for job in jobs)))
        return time.perf_counter() - begin, [results[job.digest] for job in jobs]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; 1 where the ways do not give the same parts."""
    parser = argparse.ArgumentParser(prog="python -m soilbus.validation.batch_scaling", description=__doc__)
    parser.add_argument("--logs", type=int, default=8, help="simulated logs (8)")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each log (60)")
    parser.add_argument("--workers", type=int, default=2, help="processes (2)")
    chosen = parser.parse_args(arguments)
    with TemporaryDirectory() as folder:
        jobs = jobs_in(Path(folder), chosen.logs, chosen.seconds)
        hours = chosen.logs * chosen.seconds / 3600.0
        alone: float | None = None
        parts: list[bytes | None] = []
        for way in (in_one_process, by_multiprocessing, by_batch):
            load = os.getloadavg()[0]
            wall, outcomes = way(jobs, chosen.workers)
            alone, parts = alone or wall, parts or [outcome.part for outcome in outcomes]
            if [outcome.part for outcome in outcomes] != parts:
                print("the parts differ")
                return 1
            cpu = sum(outcome.cpu_seconds for outcome in outcomes)
            cost = f"{cpu / hours:.0f} CPU s an hour of log, load {load:.1f} before"
            name = way.__name__.replace("_", " ")
            print(f"{name:20s} {wall:7.1f} s wall, {alone / wall:.2f} times as fast as one process, {cost}", flush=True)
        read = sum(outcome.log_bytes for outcome in outcomes) / hours
        kept = sum(len(part or b"") for part in parts) / hours
    print(f"an hour of log: {read / 1e6:.1f} MB read, {kept / 1e6:.2f} MB kept as parts")
    return 0


if __name__ == "__main__":
    sys.exit(main())
