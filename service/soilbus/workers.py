"""Processes that work beside this one, and end when it does, however it ends."""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children
from multiprocessing.context import ForkContext, ForkProcess, SpawnContext, SpawnProcess
from multiprocessing.process import BaseProcess
from typing import Any, Literal

_PR_SET_PDEATHSIG = 1  # prctl(2)


class _Deaf(BaseProcess):
    """A process that never hears the terminal's interrupt: that is for the one that started it."""

    def start(self) -> None:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


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
    """A pool of `count` processes, each of which calls `begin` first.

    They are killed when this process dies, when the thread that starts them ends, and when the context is left by an
    exception.
    """
    context = _ForkContext() if method == "fork" else _SpawnContext()
    others = active_children()
    with ProcessPoolExecutor(count, context, _begin, (os.getpid(), begin, *arguments)) as pool:
        try:
            yield pool
        except BaseException:
            for child in active_children():
                if child not in others:
                    child.kill()
            raise


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
