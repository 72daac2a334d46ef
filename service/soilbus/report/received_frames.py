"""Received frames: the last good frame of each message, whether it is fresh, and the verdict that may be shown.

    stale    if  age > 3 cycle times + 0.2 s
    verdict   =  unknown or no_go as the last frame says it, else the least of the last five frames in a row

These are rules of dbc/README.md: a frame with a wrong checksum or a repeated counter is not received, one counter with
two payloads shows a second sender, and a value out of range, not available or an error is None.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import can
from cantools.database import DecodeError
from cantools.database.can import Database
from cantools.database.can.signal import Signal
from cantools.database.namedsignalvalue import NamedSignalValue

from soilbus.can.checksum import COUNTER, checkable_byte, frame_checksum
from soilbus.can.wire import Received

CYCLES_UNTIL_STALE = 3
"""Cycle times of the message after which its last frame is stale."""
BUS_DELAY = 0.2
"""Time [s] beyond these cycles that a bus may take."""
SECOND_SENDER_HOLD = 3.0
"""Time [s] for which nothing is trusted after a second sender: as long as soilbus itself says so (dbc/README.md)."""
IN_A_ROW = 5
"""Frames in a row, each with the next counter, that go and caution need: in their 0.4 s soilbus itself has spoken."""
LEAST_CYCLES = 2
"""Cycles that these frames take at least: a faster second sender could send five between two frames of soilbus."""
BUS_COUNTS = {
    "Overruns": "overruns", "Dropped": "dropped", "ForeignFrames": "foreign_frames", "ErrorFrames": "error_frames",
    "Reopened": "reopened",
}  # fmt: skip
"""Signals of BusHealth that are counts, and their keys in JSON."""
STATES = ("unknown", "no_go", "caution", "go")
"""States of Traversability, the least first."""


@dataclass(slots=True)
class _Stream:
    """What came of one message; times [s]."""

    cycle: float
    counter_modulus: int
    values: dict[str, Any] = field(default_factory=dict)
    data: bytes = b""
    seen: float = -math.inf
    distrusted_until: float = -math.inf
    row: deque[tuple[float, str]] = field(default_factory=lambda: deque(maxlen=IN_A_ROW))
    """Time and state of the last frames whose counters went on by one."""

    def is_stale(self, now: float) -> bool:
        """Whether no good frame came for CYCLES_UNTIL_STALE cycles, or none at all."""
        return now - self.seen > CYCLES_UNTIL_STALE * self.cycle + BUS_DELAY

    def take(self, now: float, data: bytes, values: dict[str, Any]) -> bool:
        """Keep a frame with a right checksum; return whether its counter has moved."""
        step = (values[COUNTER] - self.values[COUNTER]) % self.counter_modulus if self.values else None
        if step == 0:
            if data != self.data:
                self.distrusted_until = now + SECOND_SENDER_HOLD
                self.row.clear()
            return False
        if step == 1 and not self.is_stale(now):
            state = str(values.get("State"))
            self.row.append((now, state if state in STATES else STATES[0]))
        else:
            self.row.clear()
        self.values, self.data, self.seen = values, data, now
        return True

    def verdict(self) -> str | None:
        """Return the state to show: unknown and no_go at once, more only where the last frames in a row all say it."""
        last = str(self.values["State"])
        if last not in STATES[2:]:
            return last if last in STATES else None
        if len(self.row) < IN_A_ROW or self.row[-1][0] - self.row[0][0] < LEAST_CYCLES * self.cycle:
            return STATES[0]
        return min((state for _, state in self.row), key=STATES.index)


class ReceivedFrames:
    """The last good frame of each message of our output DBC, by a monotonic clock [s]."""

    def __init__(self, database: Database, clock: Callable[[], float] = time.monotonic) -> None:
        self._messages = {(m.frame_id, m.is_extended_frame): m for m in database.messages}
        self._signals = {m.name: {s.name: s for s in m.signals} for m in database.messages}
        modulus = {name: 1 << signals[COUNTER].length for name, signals in self._signals.items()}
        self._streams = {m.name: _Stream((m.cycle_time or 1000) / 1000.0, modulus[m.name]) for m in database.messages}
        self._clock = clock
        self.bad_frames = 0

    @property
    def now(self) -> float:
        """Time [s] of the clock."""
        return self._clock()

    @property
    def has_second_sender(self) -> bool:
        """Whether a second sender of any of our messages showed itself in the last SECOND_SENDER_HOLD."""
        return self._clock() < max(stream.distrusted_until for stream in self._streams.values())

    def age(self, *messages: str) -> float | None:
        """Return the time [s] since the last good frame of these messages, or of any; None without one."""
        seen = max(self._streams[name].seen for name in messages or self._streams)
        return self._clock() - seen if math.isfinite(seen) else None

    def is_stale(self, message: str) -> bool:
        """Return whether the last good frame is too old, or there is none."""
        return self._streams[message].is_stale(self._clock())

    def receive(self, message: Received | can.Message) -> None:
        """Take one frame; count and drop a bad one (checksum, repeated counter, not decodable)."""
        layout = self._messages.get((message.arbitration_id, message.is_extended_id))
        if layout is None or message.is_remote_frame or len(message.data) != layout.length:
            return
        place = checkable_byte(layout)
        data = bytes(message.data)
        is_wrong = place is not None and data[place] != frame_checksum(message.arbitration_id, data, place)
        try:
            values: dict[str, Any] = layout.decode(data)  # type: ignore[assignment]
        except (DecodeError, ValueError):  # an output.dbc of the user's may have multiplexers
            is_wrong = True
        if message.is_fd or is_wrong or not self._streams[layout.name].take(self._clock(), data, values):
            self.bad_frames += 1

    def value(self, message: str, signal: str) -> float | str | None:
        """Return a signal's value, or its name in the value table.

        None where the frame is stale or has a second sender, or the value is not available, an error or reserved.
        """
        stream, now = self._streams[message], self._clock()
        if stream.is_stale(now):
            return None
        if (message, signal) == ("Traversability", "State"):
            return STATES[0] if self.has_second_sender else stream.verdict()
        if now < stream.distrusted_until:
            return None
        value = stream.values.get(signal)
        if isinstance(value, NamedSignalValue):
            name = str(value)
            return None if name in ("not_available", "error") else name
        return None if value is None or _is_reserved(self._signals[message][signal], value) else float(value)

    @property
    def is_unproven(self) -> bool:
        """Whether the last verdict may not be shown yet, for want of frames in a row."""
        stream = self._streams["Traversability"]
        return bool(stream.values) and str(stream.values["State"]) in STATES[2:] and stream.verdict() == STATES[0]

    def number(self, message: str, signal: str) -> float | None:
        """Return a signal's value where it is a number."""
        value = self.value(message, signal)
        return value if isinstance(value, float) else None

    def is_at_top(self, message: str, signal: str) -> bool:
        """Return whether a number is the greatest that its signal can say."""
        value, top = self.number(message, signal), self._signals[message][signal].maximum
        return value is not None and top is not None and value >= top

    def is_valid(self, message: str) -> bool:
        """Return whether a message may be acted on: fresh, of one sender, its Status (if any) valid."""
        if "Status" in self._signals[message]:
            return not self.has_second_sender and self.value(message, "Status") == "valid"
        return not self.has_second_sender and not self.is_stale(message)


def _is_reserved(signal: Signal, value: float) -> bool:
    """Whether a value without a name means nothing yet: beyond the signal's range, or among named states."""
    low, high = signal.minimum, signal.maximum
    if low is None or high is None:
        return False
    half = abs(signal.scale) / 2.0
    named = [code * signal.scale + signal.offset for code in (signal.choices or ())]
    return not low - half < value < high + half or any(low - half < x < high + half for x in named)
