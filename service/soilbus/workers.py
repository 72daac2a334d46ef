"""Processes that work beside this one, and end when it does, however it ends."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.context import ForkContext, ForkProcess, SpawnContext, SpawnProcess
from multiprocessing.process import BaseProcess
from typing import Any, Literal

from soilbus.process import ENDING

_PR_SET_PDEATHSIG = 1  # prctl(2)


class _Deaf(BaseProcess):
    """A process that never hears the terminal's interrupt: that is for the one that started it."""

    def start(self) -> None:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            with _undisturbed():  # a process half started would complain of what it does not know
                super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Signals that would raise an exception here, even ones that another thread took, do so afterwards."""
    received: list[int] = []
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        handlers = {n: handler for n in ENDING if callable(handler := signal.getsignal(n))}
    for number in handlers:
        signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for taken in received:
            signal.raise_signal(taken)


class _Forked(_Deaf, ForkProcess):
    pass


class _Spawned(_Deaf, SpawnProcess):
    pass


class _ForkContext(ForkContext):
    Process = _Forked


class _SpawnContext(SpawnContext):
    Process = _Spawned


@contextmanager
def workers(
    count: int, method: Literal["fork", "spawn"], begin: Callable[..., None], *arguments: Any
) -> Iterator[ProcessPoolExecutor]:
    """Give a `process_pool`; left by an exception, the context waits for none of its processes."""
    pool = process_pool(count, method, begin, *arguments)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown()


def process_pool(
    count: int, method: Literal["fork", "spawn"], begin: Callable[..., None], *arguments: Any
) -> ProcessPoolExecutor:
    """Return a pool of `count` processes, each of which calls `begin` first.

    They are killed when this process dies, and when the thread that starts them ends.
    """
    if method == "spawn":
        _start_quiet_tracker()
    context = _ForkContext() if method == "fork" else _SpawnContext()
    return ProcessPoolExecutor(count, context, _begin, (os.getpid(), begin, *arguments))


def _start_quiet_tracker() -> None:
    """multiprocessing's tracker tidies up after a process that was killed, which is no news."""
    quiet = "ignore:resource_tracker"
    sys.warnoptions.append(quiet)  # handed on to it
    try:
        resource_tracker.ensure_running()
    finally:
        sys.warnoptions.remove(quiet)


def _begin(parent: int, begin: Callable[..., None], *arguments: Any) -> None:
    """In the worker."""
    prctl = getattr(ctypes.CDLL(None), "prctl", None)  # of Linux
    if prctl is not None:
        prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before
        os._exit(1)
    for number in (signal.SIGTERM, signal.SIGHUP):  # a fork has its parent's handlers
        signal.signal(number, signal.SIG_DFL)
    begin(*arguments)
