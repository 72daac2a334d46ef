"""Columns of a table of decoded signals as messages: each column is one message, whose one signal is a 64-bit float.

    column "wheel FL [rpm]"  ->  message of that name, unit rpm  ->  a frame for each cell that holds something

So a table goes through admission, bins and comparisons just as a log of frames does.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress

from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion

from soilbus.can.channels import WHOLE
from soilbus.can.units import unit_of
from soilbus.config.model import Config
from soilbus.config.model import Signal as MappedSignal

_IN_BRACKETS = re.compile(r".*[\[(]\s*([^\[\]()]*?)\s*[\])]\s*")
_BEHIND = re.compile(r".*?[_ /,]([^\s_,]+)\s*")
LETTERS = frozenset({"N", "m", "g"})  # units of one letter that may end a column's name; others number a sensor


def unit_in(column: str) -> str:
    """Return the unit that ends a column's name, in brackets or as its last word; "" without one.

    Examples
    --------
    >>> unit_in("wheel FL [1/min]"), unit_in("draft_kN"), unit_in("torque_R"), unit_in("Zugkraft (N)")
    ('1/min', 'kN', '', 'N')
    """
    if found := _IN_BRACKETS.fullmatch(column):
        return found[1]
    found = _BEHIND.fullmatch(column)
    while found is not None:
        with suppress(ValueError):
            if (len(found[1]) > 1 or found[1] in LETTERS) and unit_of(found[1]) is not None:
                return found[1]
        found = _BEHIND.fullmatch(found[1])
    return ""


def column_database(units: Mapping[str, str]) -> Database:
    """Return the columns of a table as messages, each numbered by its place; `units` by name, "" where not known."""
    conversion, messages = BaseConversion.factory(scale=1, offset=0, is_float=True), []
    for number, (column, unit) in enumerate(units.items()):
        signal = Signal(WHOLE, 0, 64, "little_endian", True, conversion=conversion, unit=unit or None)
        is_extended = number >= 1 << 11
        messages.append(Message(number, column, 8, [signal], is_extended_frame=is_extended, strict=False))
    return Database(messages, strict=False)


def mapped_columns(config: Config) -> dict[str, str]:
    """Return the unit of each column that the configuration maps, by its name."""
    return {s.signal: unit_in(s.signal) if s.unit is None else s.unit for s in mapped_signals(config)}


def mapped_signals(config: Config) -> Iterator[MappedSignal]:
    """Yield each signal that a configuration maps."""
    for part in (config.vehicle, config.signals, *config.axle, *config.wheel):
        yield from (value for _, value in part or () if isinstance(value, MappedSignal))
