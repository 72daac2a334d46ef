"""What a dashboard ECU knows: the last good frame of each message of ours, and how old it is."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import can
from cantools.database.can import Database

from soilbus.can.checksum import COUNTER, frame_checksum
from soilbus.can.inbox import checksum_byte_of

CYCLES_UNTIL_STALE = 3
GRACE = 0.2
"""Time [s] beyond these cycles that a bus may take."""


class Readings:
    """The last good frame of each message, by the rules of dbc/README.md."""

    def __init__(self, database: Database, clock: Callable[[], float] = time.monotonic) -> None:
        self._messages = {m.frame_id: m for m in database.messages}
        self._cycle = {m.name: (m.cycle_time or 1000) / 1000.0 for m in database.messages}
        self._clock = clock
        self._values: dict[str, dict[str, Any]] = {}
        self._seen: dict[str, float] = {}
        self.bad_frames = 0

    def receive(self, message: can.Message) -> None:
        """Take one frame; one with a wrong checksum or the counter of the one before counts as not received."""
        layout = self._messages.get(message.arbitration_id) if message.is_extended_id else None
        if layout is None or message.is_remote_frame or len(message.data) != layout.length:
            return
        place = checksum_byte_of(layout)
        data = bytes(message.data)
        if place is not None and data[place] != frame_checksum(message.arbitration_id, data, place):
            self.bad_frames += 1
            return
        values: dict[str, Any] = layout.decode(data)  # type: ignore[assignment]
        if COUNTER in values and values[COUNTER] == self._values.get(layout.name, {}).get(COUNTER):
            self.bad_frames += 1
            return
        self._values[layout.name] = values
        self._seen[layout.name] = self._clock()

    def value(self, message: str, signal: str) -> float | str | None:
        """A signal's value or name; None where the frame is stale or the value not available."""
        age = self._clock() - self._seen.get(message, -1e9)
        if age > CYCLES_UNTIL_STALE * self._cycle[message] + GRACE:
            return None
        value = self._values[message].get(signal)
        if isinstance(value, (int, float)):
            return float(value)
        name = str(value)
        return None if name in ("not_available", "error") else name

    def number(self, message: str, signal: str) -> float | None:
        """A signal's value where it is a number."""
        value = self.value(message, signal)
        return value if isinstance(value, float) else None

    def is_valid(self, message: str) -> bool:
        """Whether a message may be acted on: it is fresh and its Status, where it has one, is valid."""
        status = self.value(message, "Status")
        return status == "valid" or "Status" not in self._values.get(message, {"Status": None})
