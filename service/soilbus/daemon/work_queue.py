"""Work queue: the windows that the worker thread has, and their results in order.

At most MAX_PENDING_WINDOWS wait; of more, the oldest that the worker has not begun is dropped and counted as a missed
deadline. Free memory goes back to the kernel once every WINDOWS_PER_MEMORY_RELEASE windows, in the worker.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, wait
from typing import NamedTuple

from soilbus.allocator import give_back_freed_memory
from soilbus.pipeline.intake import WindowTask
from soilbus.pipeline.result import WindowResult

MAX_PENDING_WINDOWS = 3
"""Windows that may wait for the worker."""
WINDOWS_PER_MEMORY_RELEASE = 60
"""Windows between two releases of free memory."""


class Pending(NamedTuple):
    """Window that the worker has, ended at a monotonic time [s] in an epoch of the intake."""

    future: Future[WindowResult]
    at: float
    epoch: int


def wait_for(future: Future[WindowResult], longest: float) -> None:
    """Wait until the result is there, or for `longest` [s]."""
    wait([future], longest)


class WorkQueue:
    """Queue of windows, which the one thread of `workers` solves beside the loop by `solve`.

    `waiting` waits for a future, for at most the seconds given.
    """

    def __init__(
        self,
        workers: Executor,
        solve: Callable[[WindowTask], WindowResult],
        now: float,
        waiting: Callable[[Future[WindowResult], float], None] = wait_for,
    ) -> None:
        self._workers, self._solve, self._waiting = workers, solve, waiting
        self._pending: deque[Pending] = deque()
        self._busy_since = now
        self.solved = 0
        """Windows solved since the start."""

    def __bool__(self) -> bool:
        return bool(self._pending)

    @property
    def solving_since(self) -> float | None:
        """Time [s] at which the worker began with the oldest window, or got it; None without one."""
        return self._busy_since if self._pending else None

    @property
    def oldest_end(self) -> float | None:
        """Monotonic time [s] at which the oldest window here ended; None where there is none."""
        return self._pending[0].at if self._pending else None

    @property
    def has_result(self) -> bool:
        """Whether the oldest window is solved."""
        return bool(self._pending) and self._pending[0].future.done()

    def add(self, task: WindowTask, ended: float, epoch: int, now: float) -> int:
        """Give the worker a window that ended at `ended` [s]; return how many waiting ones were dropped for it."""
        if not self._pending:
            self._busy_since = now
        self._pending.append(Pending(self._workers.submit(self._solve, task), ended, epoch))
        dropped = 0
        while len(self._pending) > MAX_PENDING_WINDOWS and self._pending[1].future.cancel():
            del self._pending[1]
            dropped += 1
        return dropped

    def wait(self, longest: float) -> None:
        """Wait until the oldest window is solved, at most `longest` [s]."""
        if self._pending and longest > 0.0:
            self._waiting(self._pending[0].future, longest)

    def results(self, now: float) -> Iterator[tuple[WindowResult, Pending]]:
        """Yield the solved windows in their order; now and then the worker frees memory after one."""
        while self.has_result:
            pending = self._pending.popleft()
            self._busy_since = now
            self.solved += 1
            yield pending.future.result(), pending
            if self.solved % WINDOWS_PER_MEMORY_RELEASE == 0:
                self._workers.submit(give_back_freed_memory)

    def close(self) -> None:
        """Shut the worker down; waiting windows are dropped."""
        self._workers.shutdown(wait=False, cancel_futures=True)
