"""Processes of this machine that work for a batch, through pipes: there is no port that another user could reach.

Each process has one task at a time, so that a process that dies costs no task but its own.
"""

from __future__ import annotations

import os
import resource
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from typing import Any

from soilbus.allocator import keep_freed_memory
from soilbus.workers import workers

__all__ = ["KilledWorker", "LocalWorkers", "local_workers"]

TRIES = 4
"""Processes that may die of a task before it is given up: those of Dask (distributed.scheduler.allowed-failures)."""
LEAST_MEMORY = 2**30
"""Memory [bytes] that each process may ask for, however many there are: a worker's peak is 369 MB (docs/fleet.md)."""
HERE = "this machine"


class KilledWorker(Exception):
    """Error of a task whose process died each time that it was tried."""


class LocalWorkers:
    """Processes of this machine with the methods of a Dask client that `run_batch` uses.

    Parameters
    ----------
    count
        Number of processes.
    folder
        For the temporary files of the processes; only this user may read it.
    """

    def __init__(self, count: int, folder: str) -> None:
        memory = max(LEAST_MEMORY, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // count)
        self._lanes = [_Lane(folder, memory) for _ in range(count)]

    def nthreads(self) -> dict[str, int]:
        """Return the number of processes."""
        return {HERE: len(self._lanes)}

    def run(
        self, function: Callable[..., Any], *arguments: Any, workers: Iterable[str] | None = None
    ) -> dict[str, Any]:
        """Return what a function returns in each process; with `workers`, in this one."""
        if workers is not None:
            return dict.fromkeys(workers, function(*arguments))
        futures = [lane.submit(function, *arguments) for lane in self._lanes]
        return {f"{HERE}, {n}": future.result() for n, future in enumerate(futures)}

    def done_in_turn(
        self, function: Callable[..., Any], tasks: Iterable[tuple[str, tuple[Any, ...]]]
    ) -> Iterator[tuple[str, Any]]:
        """Yield results as they come, by key; the exception itself where a task failed.

        Tasks are drawn one by one as others end.
        """
        waiting, running = iter(tasks), dict[Future[Any], tuple[_Lane, str, tuple[Any, ...], int]]()

        def begin(lane: _Lane, key: str, arguments: tuple[Any, ...], tries: int) -> None:
            running[lane.submit(function, *arguments)] = lane, key, arguments, tries

        for lane, task in zip(self._lanes, waiting, strict=False):
            begin(lane, *task, 1)
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                lane, key, arguments, tries = running.pop(future)
                fault = future.exception()
                if isinstance(fault, BrokenProcessPool):
                    lane.replace()
                    if tries < TRIES:
                        begin(lane, key, arguments, tries + 1)
                        continue
                    fault = KilledWorker()
                if (task_next := next(waiting, None)) is not None:
                    begin(lane, *task_next, 1)
                yield key, future.result() if fault is None else fault

    def close(self, *exception: Any) -> None:
        """End the processes; after an exception without waiting for their tasks."""
        for lane in self._lanes:
            lane.close(*exception)


class _Lane:
    """One process, which is replaced when it has died."""

    def __init__(self, *arguments: Any) -> None:
        self._arguments = arguments
        self._begin()

    def _begin(self) -> None:
        self._stack = ExitStack()
        self._pool = self._stack.enter_context(workers(1, "spawn", _begin, *self._arguments))

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Let the process call a function."""
        try:
            return self._pool.submit(function, *arguments)
        except BrokenProcessPool:  # it died without a task
            self.replace()
            return self._pool.submit(function, *arguments)

    def replace(self) -> None:
        """Take a new process."""
        self.close()
        self._begin()

    def close(self, *exception: Any) -> None:
        """End the process, as `LocalWorkers.close`."""
        self._stack.__exit__(*(exception or (None, None, None)))


@contextmanager
def local_workers(count: int | None = None) -> Iterator[LocalWorkers]:
    """Give processes of this machine, by default one for each core."""
    with tempfile.TemporaryDirectory(prefix="soilbus-", ignore_cleanup_errors=True) as folder, _one_thread():
        client = LocalWorkers(count or len(os.sched_getaffinity(0)), folder)
        with ExitStack() as stack:
            stack.push(client.close)
            yield client


@contextmanager
def _one_thread() -> Iterator[None]:
    """A process that starts meanwhile computes with one thread."""
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


def _begin(folder: str, memory: int) -> None:
    """In the process: too much memory is an error of the log, and what is left over goes with the batch."""
    keep_freed_memory()
    tempfile.tempdir = folder
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (memory if most < 0 else min(memory, most), most))
