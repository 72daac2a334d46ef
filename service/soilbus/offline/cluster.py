"""Processes for many tasks: those of this machine, or the workers of a Dask scheduler, with the same use."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import contextmanager
from importlib import import_module
from itertools import islice
from typing import Any

from soilbus import __version__
from soilbus.offline.local_workers import local_workers
from soilbus.words import WorkError, one_line

CONNECT_TIMEOUT = 10.0
"""Seconds in which a scheduler must answer."""
TASKS_PER_THREAD = 3
"""Tasks that are handed out for each thread: one in work, one to follow, one on its way."""


class BatchError(WorkError):
    """Error of a batch that cannot be done to its end; the text is one line."""


@contextmanager
def cluster(address: str | None, processes: int | None = None) -> Iterator[Any]:
    """Give a Dask client of the scheduler at an address, or processes of this machine with the same use.

    Without an address no port is opened, and there is a process for each core by default. BatchError where there is no
    scheduler, it has no workers, or these have another soilbus.
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
    with dask.config.set({"distributed.comm.timeouts.connect": CONNECT_TIMEOUT}):
        try:
            client = distributed.Client(address, timeout=CONNECT_TIMEOUT)
        except (OSError, TimeoutError, TypeError, ValueError) as error:  # TypeError: TLS without a certificate
            raise BatchError(f"{address}: no Dask scheduler there ({one_line(error, 100)})") from None
        with client:
            _check_workers(client, address)
            yield client


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
        versions_there = f"workers have soilbus {', '.join(others)}, this is {__version__}"
        raise BatchError(f"{address}: {versions_there}: install the same everywhere")


def done_in_turn(
    client: Any, function: Callable[..., Any], tasks: Iterable[tuple[str, tuple[Any, ...]]]
) -> Iterator[tuple[str, Any]]:
    """Yield results as they come, by key; the exception itself where a task failed.

    Tasks are drawn one by one as others end, so that what travels with them is never in memory all at once. BatchError
    where the scheduler is lost.
    """
    executor, waiting = client.get_executor(pure=False), iter(tasks)
    running: dict[Future[Any], str] = {}

    def begin(most: int) -> None:
        for key, arguments in islice(waiting, most):
            running[executor.submit(function, *arguments)] = key

    begin(TASKS_PER_THREAD * (sum(client.nthreads().values()) or 1))
    while running:
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            key = running.pop(future)
            try:
                fault = future.exception()
                begin(1)
            except (CancelledError, OSError, TimeoutError):
                raise BatchError("the Dask scheduler is lost; --resume goes on from here") from None
            yield key, future.result() if fault is None else fault
