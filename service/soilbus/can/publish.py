"""Results -> frames: value codes, counter, checksum.

What happens to a value that cannot be sent is decided here, once for all signals, from what the DBC says of them.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from cantools.database import Database
from cantools.database.can import Message, Signal
from numpy.typing import NDArray

from soilbus.can.checksum import CHECKSUM, COUNTER, checksum_byte, frame_checksum
from soilbus.can.decode import code_limits

NOT_AVAILABLE, ERROR = "not_available", "error"
_BEYOND = 2.0**40  # any code; a value divided by its scale may be infinite


class Frame(NamedTuple):
    """Frame that is ready to send."""

    arbitration_id: int
    extended: bool
    data: bytes


class ValueCodes:
    """Conversion of values of one signal of any maker's DBC to raw codes: physical value = scale * code + offset.

    Valid codes are lowest..highest.  None and what is not finite become `not_available`.  A value outside the range
    becomes `error`, never the nearest valid one, which would be taken for a measurement; but signals with the attribute
    `Saturates` (deviations, ages, counts: "this much or more") stay at the top.  `names` is the value table.

    Without names in the value table, not available is the most negative code of a signed signal and all ones of an
    unsigned one; error is the J1939 code where the range leaves it free, else not available.
    """

    def __init__(self, signal: Signal) -> None:
        """Raises ValueError for a signal that cannot be sent."""
        if signal.is_float or signal.length > 32:
            raise ValueError(f"{signal.name}: only integer signals up to 32 bits can be sent")
        least, greatest = code_limits(signal)
        self.names: Mapping[str, int] = {str(name): int(code) for code, name in (signal.choices or {}).items()}
        if wide := [name for name, code in self.names.items() if not least <= code <= greatest]:
            named = f"{', '.join(wide)} of the value table"
            raise ValueError(f"{signal.name}: {named} does not fit into {signal.length} bits")
        self.not_available = self.names.get(NOT_AVAILABLE, least if signal.is_signed else greatest)
        self.scale, self.offset = float(signal.scale), float(signal.offset)
        bounds = (signal.minimum, signal.maximum)
        ends = [None if bound is None else round((bound - signal.offset) / signal.scale) for bound in bounds]
        low, high = reversed(ends) if self.scale < 0.0 else ends
        self.lowest = least if low is None else max(low, least)
        self.highest = greatest if high is None else min(high, greatest)
        if NOT_AVAILABLE not in self.names and signal.length >= 8:  # a range of all codes means all but this one
            self.lowest += self.lowest == self.not_available
            self.highest -= self.highest == self.not_available
        free = 0xFE << signal.length - 8 if signal.length >= 8 and not signal.is_signed else greatest
        self.error = self.names.get(ERROR, free if self.highest < free < greatest else self.not_available)
        attributes = signal.dbc.attributes if signal.dbc else {}
        self.saturates = "Saturates" in attributes and bool(int(attributes["Saturates"].value))

    def code(self, value: Any) -> int:
        """Return the raw code of a number, a name of the value table, or None; else ValueError or TypeError."""
        if value is None:
            return self.not_available
        if isinstance(value, str):
            if value not in self.names:
                raise ValueError(f"{value!r} is not in the value table ({', '.join(self.names)})")
            return self.names[value]
        if not isinstance(value, numbers.Real):
            raise TypeError(f"a {type(value).__name__} cannot be sent")
        number = float(value)
        if not math.isfinite(number):
            return self.not_available
        code = round(min(max((number - self.offset) / self.scale, -_BEYOND), _BEYOND))
        if self.lowest <= code <= self.highest:
            return code
        return self.highest if self.saturates and code > self.highest else self.error

    def column(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return `code` of many numbers (N,) at once; nan means not available."""
        return np.array([self.code(value) for value in values.tolist()], np.int64)


class _Layout:
    """One message, what its signals are filled with, and where its counter stands."""

    def __init__(self, message: Message) -> None:
        if message.cycle_time is None:
            raise ValueError(f"{message.name}: no cycle time (attribute GenMsgCycleTime)")
        if message.is_multiplexed():
            raise ValueError(f"{message.name}: multiplexed messages cannot be sent")
        self.message, self.cycle_time, self.sent = message, message.cycle_time / 1000.0, 0
        by_name = {signal.name: signal for signal in message.signals}
        guards = [name for name in (COUNTER, CHECKSUM) if name in by_name]
        try:
            self.codes = {name: ValueCodes(signal) for name, signal in by_name.items() if name not in guards}
        except ValueError as error:
            raise ValueError(f"{message.name}.{error}") from None
        self.blank = {name: code.not_available for name, code in self.codes.items()} | dict.fromkeys(guards, 0)
        self.counter_modulus = 1 << by_name[COUNTER].length if COUNTER in by_name else 0
        self.checksum_byte = checksum_byte(message)
        if self.checksum_byte is None and CHECKSUM in by_name:
            raise ValueError(f"{message.name}: {CHECKSUM} must be one whole byte")


class Publisher:
    """Frames of one DBC.  Counters start at 0 and go up by one each frame of a message."""

    def __init__(self, database: Database) -> None:
        """Raises ValueError for a message without cycle time or with a signal it cannot fill."""
        self._layouts = {message.name: _Layout(message) for message in database.messages}
        self.schedule = {name: layout.cycle_time for name, layout in self._layouts.items()}
        """Cycle time [s] by message name, from the DBC's attribute GenMsgCycleTime."""

    def frame(self, message: str, values: Mapping[str, Any]) -> Frame:
        """Return the next frame of a message; signals without a value are sent as not available.

        Values are in the DBC's units, or names of the value table.  Raises KeyError for a message or signal that is not
        in the DBC, counter and checksum included; ValueError and TypeError as `ValueCodes.code`.
        """
        layout = self._layouts[message]
        raw = layout.blank.copy()
        for name, value in values.items():
            try:
                raw[name] = layout.codes[name].code(value)
            except (ValueError, TypeError) as error:
                raise type(error)(f"{message}.{name}: {error}") from None
        if layout.counter_modulus:
            raw[COUNTER] = layout.sent % layout.counter_modulus
            layout.sent += 1
        # Codes are within their bits already; not strict, since codes lie outside min..max.
        data = layout.message.encode(raw, scaling=False, padding=True, strict=False)
        frame_id, place = layout.message.frame_id, layout.checksum_byte
        if place is not None:
            data = data[:place] + bytes((frame_checksum(frame_id, data, place),)) + data[place + 1 :]
        return Frame(frame_id, layout.message.is_extended_frame, data)
