"""Processes of this machine that work for a batch, through pipes: there is no port that another user could reach.

Each process has one task at a time, so that a process that dies costs no task but its own.
"""

from __future__ import annotations

import os
import resource
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from soilbus.allocator import keep_freed_memory
from soilbus.workers import process_pool

TRIES = 4
"""Processes that may die of a task before it is given up: those of Dask (distributed.scheduler.allowed-failures)."""
LEAST_MEMORY = 2**30
"""Memory [bytes] that each process may ask for, however many there are: a worker takes 223 MB (docs/fleet.md)."""
HERE = "this machine"


class KilledWorker(Exception):
    """Error of a task whose process died each time that it was tried."""


class LocalWorkers:
    """Processes of this machine with the methods of a Dask client that a batch uses.

    Their temporary files are in `folder`, which only this user may read.
    """

    def __init__(self, count: int, folder: str) -> None:
        memory = max(LEAST_MEMORY, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // count)
        self._count, self._begin_arguments = count, (folder, memory)
        self._threads, self._own = ThreadPoolExecutor(count), threading.local()  # a process for each thread
        self._processes: list[ProcessPoolExecutor] = []

    def nthreads(self) -> dict[str, int]:
        """Return the number of processes."""
        return {HERE: self._count}

    def get_executor(self, **_: Any) -> LocalWorkers:
        """Return this, which takes tasks."""
        return self

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Let the next free process call a function; KilledWorker where it dies of that each time."""
        return self._threads.submit(self._result, function, *arguments)

    def _result(self, function: Callable[..., Any], *arguments: Any) -> Any:
        for _ in range(TRIES):
            if not hasattr(self._own, "process"):
                self._own.process = process_pool(1, "spawn", _begin, *self._begin_arguments)
                self._processes.append(self._own.process)
            try:
                return self._own.process.submit(function, *arguments).result()
            except BrokenProcessPool:
                del self._own.process
        raise KilledWorker

    def close(self, wait: bool) -> None:
        """End the processes; with `wait` when their tasks are done."""
        for pool in (*self._processes, self._threads):
            pool.shutdown(wait=wait, cancel_futures=not wait)


@contextmanager
def local_workers(count: int | None = None) -> Iterator[LocalWorkers]:
    """Give processes of this machine, by default one for each core; after an exception nobody waits for them."""
    with tempfile.TemporaryDirectory(prefix="soilbus-", ignore_cleanup_errors=True) as folder:
        client = LocalWorkers(count or len(os.sched_getaffinity(0)), folder)
        try:
            yield client
        except BaseException:
            client.close(wait=False)
            raise
        client.close(wait=True)


def _begin(folder: str, memory: int) -> None:
    """In the process: too much memory is an error of the log, and what is left over goes with the batch."""
    keep_freed_memory()
    tempfile.tempdir = folder
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (memory if most < 0 else min(memory, most), most))
