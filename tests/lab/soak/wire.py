"""A bus on which things go wrong: frames lost, spoilt, doubled, late; strangers; outages; clock steps.

It counts the frames that it delivers: the service must account for each of them.
"""

from __future__ import annotations

import errno
from collections import Counter
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass

import can
import numpy as np

from fakes import FakeClock

FAULTS = (  # in turns, each round in another order
    "silent", "spoilt", "stuck", "doubled", "late", "short", "remote", "stranger", "error_frames", "no_bus",
    "full", "clock",
)  # fmt: skip
MEAN_CALM = 180.0
"""Mean time [s] from the end of one fault to the next one's begin."""
MEAN_FAULT = 8.0
CLOCK_STEP = 3600.0
STRANGER = 0x123
CROWDED = 0.15
"""Seconds after a full queue in which frames that waited for room go out late, rightly."""


@dataclass
class Fault:
    """One kind of trouble with one message (an identifier), from `begin` to `end` on the monotonic clock [s]."""

    kind: str
    identifier: int
    begin: float
    end: float


class Wire:
    """Hands out the traffic when the clock has reached it, spoilt as the seed will have it.

    `clock` is a FakeClock, moved by waiting.  `delivered` counts what was handed over by identifier;
    `error_frames` the bus's own; `gone` has the number of faults by kind.  `on_send` hears of frames that had room.
    """

    def __init__(self, clock: FakeClock, messages: Iterator[can.Message], seed: int) -> None:
        self.clock = clock
        self.delivered: Counter[int] = Counter()
        self.error_frames = 0
        self.gone: Counter[str] = Counter()
        self.on_send: Callable[[float, can.Message], None] = lambda t, message: None
        self._rng = np.random.default_rng([seed, 7])
        self._messages = messages
        self._next = next(messages)
        self._lag = clock.now - self._next.timestamp
        self._stepped = 0.0
        self._crowded = -CROWDED
        self._coming: list[str] = []
        self._extra: list[can.Message] = []
        self._last: dict[int, can.Message] = {}
        self._fault = Fault("none", 0, -1.0, clock.now)
        self._plan()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self._look()
        wait = timeout or 0.0
        if self._fault.kind == "no_bus" and self._on:
            raise can.CanOperationError("Network is down", errno.ENETDOWN)
        if self._extra:
            return self.hand_over(self._extra.pop())
        while True:
            due = self._next.timestamp + self._lag
            if due > self.clock.now + wait:
                self.clock.sleep(max(wait, 1e-4))
                return None
            message, self._next = self._next, next(self._messages)
            if due < self.clock.now - 0.5:  # nobody listened
                continue
            self.clock.now = max(self.clock.now, due)
            kept = self._spoilt(message) if self._on else message
            if not (self._on and self._fault.kind == "stuck"):
                self._last[message.arbitration_id] = message
            if kept is not None:
                return self.hand_over(kept)

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        if self._on and self._fault.kind == "no_bus":
            raise can.CanOperationError("Network is down", errno.ENETDOWN)
        if self._on and self._fault.kind == "full":
            self._crowded = self.clock.now
            raise can.CanOperationError("No buffer space available", errno.ENOBUFS)
        if self.clock.now - self._crowded > CROWDED:
            self.on_send(self.clock.now, message)

    def shutdown(self) -> None:
        """Nothing to let go of."""

    @property
    def _on(self) -> bool:
        return self.clock.now >= self._fault.begin

    def _look(self) -> None:
        if self.clock.now >= self._fault.end:
            self.gone[self._fault.kind] += 1
            self._plan()
            if self._fault.kind == "clock":
                self._fault.end = self._fault.begin
                self._stepped = 0.0 if self._stepped else CLOCK_STEP * float(self._rng.choice((-1.0, 1.0)))

    def _plan(self) -> None:
        self._coming = self._coming or self._rng.permutation(FAULTS).tolist()
        begin = self.clock.now + float(self._rng.exponential(MEAN_CALM))
        identifiers = sorted(self._last) or [self._next.arbitration_id]
        self._fault = Fault(
            self._coming.pop(),
            int(self._rng.choice(identifiers)),
            begin,
            begin + float(self._rng.exponential(MEAN_FAULT)),
        )

    def hand_over(self, message: can.Message) -> can.Message:
        if message.is_error_frame:
            self.error_frames += 1
        else:
            self.delivered[message.arbitration_id] += 1
        if not self._stepped:
            return message
        stamped = copy(message)
        stamped.timestamp += self._stepped
        return stamped

    def _spoilt(self, message: can.Message) -> can.Message | None:
        """What arrives instead of the message while the fault lasts; None where nothing does."""
        kind, now = self._fault.kind, message.timestamp
        if kind == "stranger":
            self._extra.append(can.Message(timestamp=now, arbitration_id=STRANGER, is_extended_id=False, data=b"\x5a"))
        elif kind == "error_frames":
            self._extra.append(can.Message(timestamp=now, is_error_frame=True, arbitration_id=4, data=bytes(8)))
        if message.arbitration_id != self._fault.identifier:
            return message
        if kind == "silent":
            return None
        if kind == "doubled":
            self._extra.append(message)
        data = {
            "spoilt": bytes(b ^ 0x5A for b in message.data),
            "stuck": self._last.get(message.arbitration_id, message).data,
            "short": message.data[:3],
        }.get(kind, message.data)
        return can.Message(
            timestamp=now - 0.5 if kind == "late" else now,
            arbitration_id=message.arbitration_id,
            is_extended_id=message.is_extended_id,
            is_remote_frame=kind == "remote",
            data=None if kind == "remote" else data,
            dlc=8 if kind == "remote" else None,
        )
