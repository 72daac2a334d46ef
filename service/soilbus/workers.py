"""Processes that work beside this one, and end when it does, however it ends."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, resource_tracker
from typing import Any, Literal

from soilbus.process import ENDING

_PR_SET_PDEATHSIG = 1  # prctl(2)
_QUIET = "ignore:resource_tracker"  # multiprocessing's tracker tidies up after a killed process, which is no news


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
    sys.warnoptions.append(_QUIET)  # handed on to the tracker
    resource_tracker.ensure_running()
    sys.warnoptions.remove(_QUIET)
    return _Pool(count, get_context(method), _begin, (os.getpid(), begin, *arguments))


class _Pool(ProcessPoolExecutor):
    """A pool whose processes hear no signal before `_begin` says what to do with it; `submit` starts them."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
        try:
            return super().submit(fn, *args, **kwargs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(parent: int, begin: Callable[..., None], *arguments: Any) -> None:
    """In the worker."""
    prctl = getattr(ctypes.CDLL(None), "prctl", None)  # of Linux
    if prctl is not None:
        prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before
        os._exit(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal's interrupt is for the process that started it
    for number in (signal.SIGTERM, signal.SIGHUP):  # a fork has its parent's handlers
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
    begin(*arguments)
