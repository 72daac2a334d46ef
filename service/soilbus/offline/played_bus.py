"""A recording played to the live service or to the dashboard: a bus and a clock that follow the frames' stamps.

    now = now at the last frame + (its stamp - the last one's)    time passes only while somebody waits

Stamps that go back take no time, and a silence takes LONGEST_GAP at most, after which another recording begins anyway.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from typing import Any

import can

from soilbus.can.admission import LONGEST_GAP
from soilbus.can.candump import Frame
from soilbus.can.wire import Received

LEAST_WAIT = 1e-4
"""Time [s] that a look at an empty bus takes at least: a loop that only looks comes to an end."""


class PlayedClock:
    """Monotonic time [s] that passes only when somebody waits, at most `speed` times as fast as real time."""

    def __init__(self, speed: float = math.inf) -> None:
        self.now = self._begin = 1000.0
        self._speed, self._began = speed, time.monotonic()

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self.now += max(seconds, 0.0)
        if math.isfinite(self._speed):
            time.sleep(max(self._began + (self.now - self._begin) / self._speed - time.monotonic(), 0.0))

    def wait_for(self, future: Future[Any], longest: float) -> None:
        """Let the time `longest` [s] pass, unless the future is done."""
        if not future.done():
            self.sleep(longest)


class InlineExecutor(Executor):
    """Executor that does the work at once, in the caller's thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Do the work and return it as done."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class PlayedBus:
    """Bus that carries the frames of a recording that pass the filters of python-can, and keeps what is sent.

    The clock goes on with the frames; what is sent has the name of the channel.
    """

    fault = ""

    def __init__(
        self, frames: Iterator[Frame], filters: Sequence[dict[str, Any]], clock: PlayedClock, channel: str = ""
    ) -> None:
        self._frames, self._filters, self._clock, self._channel = frames, filters, clock, channel
        self._passes: dict[tuple[int, bool], bool] = {}
        self._stamp, self._taken_at = math.nan, clock.now
        self._sent: list[can.Message] = []
        self._next = self._following()

    @property
    def is_empty(self) -> bool:
        """Whether the recording has ended."""
        return self._next is None

    def recv(self, timeout: float | None = None) -> Received | None:
        """Return the next frame, or None after `timeout` [s]."""
        now, longest = self._clock.now, timeout or 0.0
        if self._next is None or (due := self._due(self._next.timestamp)) > now + longest:
            self._clock.sleep(max(longest, LEAST_WAIT))
            return None
        frame = self._next
        self._clock.sleep(due - now)
        self._stamp, self._taken_at = frame.timestamp, self._clock.now
        self._next = self._following()
        return frame

    receive = recv

    def send(self, message: can.Message) -> None:
        """Keep a frame, stamped with the bus's time."""
        message.timestamp = self._stamp + self._clock.now - self._taken_at
        message.channel = self._channel
        self._sent.append(message)

    def take_sent(self) -> list[can.Message]:
        """Return what was sent since the last call, without what went out before the first frame."""
        sent, self._sent = self._sent, []
        return [message for message in sent if math.isfinite(message.timestamp)]

    def shutdown(self) -> None:
        """Do nothing, as there is nothing to close."""

    def _due(self, stamp: float) -> float:
        """When a frame comes, by the clock [s]."""
        since = stamp - self._stamp
        return self._taken_at + (min(max(since, 0.0), LONGEST_GAP) if math.isfinite(since) else 0.0)

    def _following(self) -> Received | None:
        for t, identifier, extended, data, remote, error in self._frames:
            if error or self._is_heard(identifier, extended):
                return Received(t, identifier, extended, remote, error, bytes(data))
        return None

    def _is_heard(self, identifier: int, extended: bool) -> bool:
        key = identifier, bool(extended)
        if key not in self._passes:
            alike = (f for f in self._filters if f["extended"] == key[1])
            self._passes[key] = any((identifier ^ f["can_id"]) & f["can_mask"] == 0 for f in alike)
        return self._passes[key]
