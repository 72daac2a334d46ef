"""Received frames: the last good frame of each message, and whether it is fresh.

    stale  if  age > 3 cycle times + 0.2 s

The rules are those of dbc/README.md: a frame with a wrong checksum, a repeated counter or no layout counts as not
received; a value outside the signal's range, not available or an error is None.
"""

from __future__ import annotations

import time
from collections.abc import Callable
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


class ReceivedFrames:
    """The last good frame of each message of a database.

    Parameters
    ----------
    database
        Our output DBC.
    clock
        Monotonic time [s].
    """

    def __init__(self, database: Database, clock: Callable[[], float] = time.monotonic) -> None:
        self._messages = {(m.frame_id, m.is_extended_frame): m for m in database.messages}
        self._signals = {m.name: {s.name: s for s in m.signals} for m in database.messages}
        self._cycle = {m.name: (m.cycle_time or 1000) / 1000.0 for m in database.messages}
        self._clock = clock
        self._values: dict[str, dict[str, Any]] = {}
        self._seen: dict[str, float] = {}
        self.bad_frames = 0

    @property
    def now(self) -> float:
        """Time [s] of the clock."""
        return self._clock()

    def age(self, *messages: str) -> float | None:
        """Time [s] since the last good frame of any of these messages, or of any at all; None where there was none."""
        seen = [self._seen[name] for name in messages or self._seen if name in self._seen]
        return self._clock() - max(seen) if seen else None

    def is_stale(self, message: str) -> bool:
        """Whether no good frame came for CYCLES_UNTIL_STALE cycles, or none at all."""
        age = self.age(message)
        return age is None or age > CYCLES_UNTIL_STALE * self._cycle[message] + BUS_DELAY

    def receive(self, message: Received | can.Message) -> None:
        """Take one frame; a bad one (wrong checksum, repeated counter, not decodable) is counted and not used."""
        layout = self._messages.get((message.arbitration_id, message.is_extended_id))
        if layout is None or message.is_remote_frame or len(message.data) != layout.length:
            return
        place = checkable_byte(layout)
        data = bytes(message.data)
        if place is not None and data[place] != frame_checksum(message.arbitration_id, data, place):
            self.bad_frames += 1
            return
        try:
            values: dict[str, Any] = layout.decode(data)  # type: ignore[assignment]
        except (DecodeError, ValueError):  # an output.dbc of the user's may have multiplexers
            self.bad_frames += 1
            return
        if COUNTER in values and values[COUNTER] == self._values.get(layout.name, {}).get(COUNTER):
            self.bad_frames += 1
            return
        self._values[layout.name] = values
        self._seen[layout.name] = self._clock()

    def value(self, message: str, signal: str) -> float | str | None:
        """A signal's value, or its name in the value table.

        Returns
        -------
        None where the frame is stale, or the value not available, an error or reserved.
        """
        if self.is_stale(message):
            return None
        value = self._values[message].get(signal)
        if isinstance(value, NamedSignalValue):
            name = str(value)
            return None if name in ("not_available", "error") else name
        if value is None or _is_reserved(self._signals[message][signal], value):
            return None
        return float(value)

    def number(self, message: str, signal: str) -> float | None:
        """A signal's value where it is a number."""
        value = self.value(message, signal)
        return value if isinstance(value, float) else None

    def is_at_top(self, message: str, signal: str) -> bool:
        """Whether a number is the greatest that its signal can say, which of one that saturates means this or more."""
        value = self.number(message, signal)
        top = None if value is None else self._signals[message][signal].maximum
        return value is not None and top is not None and value >= top

    def is_valid(self, message: str) -> bool:
        """Whether a message may be acted on: it is fresh and its Status, where it has one, is valid."""
        status = self.value(message, "Status")
        return status == "valid" or "Status" not in self._values.get(message, {"Status": None})


def _is_reserved(signal: Signal, value: float) -> bool:
    """Whether a value without a name means nothing yet: beyond the signal's range, or among named states."""
    low, high = signal.minimum, signal.maximum
    if low is None or high is None:
        return False
    half = abs(signal.scale) / 2.0
    named = [code * signal.scale + signal.offset for code in (signal.choices or ())]
    return not low - half < value < high + half or any(low - half < x < high + half for x in named)
