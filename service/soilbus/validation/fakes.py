"""A bus, a clock and a worker that tests hold in their hands."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, Future
from typing import Any

import can


class FakeClock:
    """Monotonic time that passes only when somebody waits."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += max(seconds, 0.0)

    def wait_for(self, future: Future[Any], longest: float) -> None:
        """Waits for what is never done while somebody waits."""
        if not future.done():
            self.sleep(longest)


class InlineExecutor(Executor):
    """Does the work at once, in the caller's thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class ScriptedBus:
    """Hands out messages when the clock has reached their stamps (counted from `start`); keeps what is sent.

    `fail_receive` and `fail_send` hold exceptions to raise instead, once each; until `full_until`
    there is no room for a frame.
    """

    def __init__(self, clock: FakeClock, messages: Iterable[can.Message] = (), start: float = 1.7e9) -> None:
        self.clock, self.messages, self.offset = clock, list(messages), start - clock.now
        self.sent: list[tuple[float, can.Message]] = []
        self.fail_receive: list[Exception] = []
        self.fail_send: list[Exception] = []
        self.full_until = 0.0
        self.closed = False
        self.next = 0

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.fail_receive:
            raise self.fail_receive.pop(0)
        due = self.messages[self.next].timestamp - self.offset if self.next < len(self.messages) else float("inf")
        if due > self.clock.now + (timeout or 0.0):
            self.clock.sleep(max(timeout or 0.0, 1e-4))
            return None
        self.clock.now = max(self.clock.now, due)
        self.next += 1
        return self.messages[self.next - 1]

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        if self.fail_send:
            raise self.fail_send.pop(0)
        if self.clock.now < self.full_until:
            raise can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS)
        self.sent.append((self.clock.now, message))

    def shutdown(self) -> None:
        self.closed = True
