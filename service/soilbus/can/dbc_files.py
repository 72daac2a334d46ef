"""Finding and reading DBC files: the integrator's own beside the configuration, or ours by name."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from copy import copy
from functools import lru_cache
from pathlib import Path
from typing import Any

from cantools.database.can import Database, Message

from soilbus.can.checksum import CHECKSUM, COUNTER, checkable_byte
from soilbus.can.columns import column_database, mapped_columns, mapped_signals
from soilbus.can.j1939 import STANDARD_PGNS, pgn_of
from soilbus.can.publish import ERROR, NOT_AVAILABLE, Publisher
from soilbus.config.file import DBC_FOLDERS, located, shipped_dbc
from soilbus.config.model import Config, ConfigError
from soilbus.files import read_bounded
from soilbus.words import LONGEST_NAME, did_you_mean, one_line, shown

LARGEST = 32 * 2**20  # bytes of a DBC file: five times those of one with 10 000 messages
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,127}")  # C_identifier of the DBC file format (Vector, 1.0.5)
_EXTENDED = 1 << 31
_MESSAGE = re.compile(
    r"""^BO_[ \t]+(?P<id>\d+)[ \t]+(?P<name>\w+)[ \t]*:[^"\n]*\n"""
    r"""(?:[ \t]+SG_[ \t][^"\n]*"[^"\n]*"[^"\n]*\n)*""",
    re.MULTILINE,
)
_ABOUT = re.compile(
    r"""^(?:(?:CM_|BA_[ \t]+"[^"\n]*")[ \t]+(?:BO_|SG_)|VAL_|BO_TX_BU_|SIG_GROUP_|SIG_VALTYPE_|SG_MUL_VAL_)"""
    r"""[ \t]+(?P<id>\d+)\b[^"\n]*(?:"[^"\n]*"[^"\n]*)*;[ \t\r]*\n""",
    re.MULTILINE,
)

MOST_MULTIPLEXER_VALUES = 1 << 18
"""Values of all ranges of a DBC: 1024 signals in each of 256 pages.  cantools makes 0.3 kB of each."""
MOST_DIGITS = 12  # digits of a number in a range: a multiplexer of 32 bits has 10
_RANGES = re.compile(r"\bSG_MUL_VAL_\s+\d+\s+(?P<signal>\w+)\s+\w+(?P<ranges>[^;]*)")
_RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")


def load_databases(config: Config, mapped_only: bool = False) -> Database:
    """Return all DBC files of the configuration as one database; with [columns] the mapped columns.

    With `mapped_only` messages are left out that can have no say in what is mapped, unless a mapped one is missing.
    Raises ConfigError with a line for each file that is missing or no DBC, and each message defined in two ways.
    """
    if config.columns is not None:
        return column_database(mapped_columns(config))
    faults = [] if config.dbc.input else ["dbc.input: no DBC file given"]
    messages: dict[str, tuple[str, Message]] = {}
    mapped = {*config.dbc.checked, *(signal.signal.partition(".")[0] for signal in mapped_signals(config))}
    names = mapped if mapped_only else None
    for name in config.dbc.input:
        try:
            read = _read_named("dbc.input", config.folder, name, names)
        except ConfigError as error:
            faults += error.faults
            continue
        for message in read.messages:
            first, known = messages.setdefault(message.name, (name, message))
            if _layout(known) != _layout(message):
                faults.append(f"dbc.input: {first} and {name} define message {message.name} differently")
    if faults:
        raise ConfigError(faults)
    if mapped_only and not mapped <= messages.keys():
        return load_databases(config)  # whoever says what is missing may name what is there
    return Database([message for _, message in messages.values()], strict=False)


def checked_messages(config: Config, database: Database) -> frozenset[str]:
    """Return the names of the messages that must carry a right Counter and Checksum.

    Those are messages with both signals in DBC files that soilbus ships, and what `dbc.checked` names; what another
    maker's Checksum means is not known.  ConfigError has a line for each name that is in no DBC or cannot be checked.
    """
    found: set[str] = set()
    for path in (located(config.folder, name) for name in config.dbc.input):
        with suppress(FileNotFoundError):  # of the name of one that is shipped
            if shipped_dbc(path.name).resolve() == path.resolve():
                found |= {m.name for m in _read(path).messages if checkable_byte(m) is not None}
    known = {m.name: m for m in database.messages}
    faults = []
    for name in config.dbc.checked:
        if name not in known:
            faults.append(f"dbc.checked: no message {name} in the DBC{did_you_mean(name, known)}")
        elif checkable_byte(known[name]) is None:
            faults.append(f"dbc.checked: {name} has no {COUNTER} and byte-aligned 8-bit {CHECKSUM}")
    if faults:
        raise ConfigError(faults)
    return frozenset(found.union(config.dbc.checked))


def output_database(config: Config) -> Database:
    """Return the messages that soilbus sends, from the address of [j1939] where there is one.

    Raises ConfigError where `output.dbc` is missing, no DBC, or lacks anything of a message of ours.
    """
    name = config.output.dbc
    database = _read_named("output.dbc", config.folder, name)
    ours = {m.name: m for m in _read(shipped_dbc("soilbus.dbc")).messages}
    missing = sorted(ours.keys() - {m.name for m in database.messages})
    if missing:
        raise ConfigError([f"output.dbc: {name}: no message {', '.join(missing)}"])
    messages = [copy(message) for message in database.messages if message.name in ours]
    if faults := [fault for message in messages for fault in _unlike(message, ours[message.name])]:
        raise ConfigError([f"output.dbc: {name}: {fault}" for fault in faults])
    if config.j1939.address is None:
        return database if len(messages) == len(database.messages) else Database(messages, strict=False)
    for message in messages:
        if not message.is_extended_frame:
            raise ConfigError([f"j1939.address: {message.name} in {name} has an identifier of 11 bits, without one"])
        message.frame_id = message.frame_id & ~0xFF | config.j1939.address
    return Database(messages, strict=False)


def _unlike(message: Message, ours: Message) -> Iterator[str]:
    """What an edited message lacks that is sent in ours, or why it cannot be sent."""
    signals = {signal.name: signal for signal in message.signals}
    for signal in ours.signals:
        if signal.name not in signals:
            yield f"no signal {message.name}.{signal.name}"
            continue
        names = {NOT_AVAILABLE, ERROR, *map(str, (signals[signal.name].choices or {}).values())}
        if lacks := [str(name) for name in (signal.choices or {}).values() if str(name) not in names]:
            yield f"no code for {', '.join(lacks)} in the value table of {message.name}.{signal.name}"
    try:
        Publisher(Database([message], strict=False))
    except ValueError as error:
        yield one_line(error)


def filters_of(database: Database) -> list[dict[str, Any]]:
    """Return filters for python-can that pass the messages of a database only."""
    return [{"can_id": m.frame_id, "can_mask": 0x1FFFFFFF, "extended": m.is_extended_frame} for m in database.messages]


def _read_named(key: str, folder: Path, name: str, names: set[str] | None = None) -> Database:
    """`_read` of a DBC that the configuration names; ConfigError with the key where it cannot be read."""
    try:
        return _read(located(folder, name), names)
    except FileNotFoundError as error:
        there = {path.name for place in (folder, *DBC_FOLDERS) for path in place.glob("*.dbc")}
        why = f"{error.strerror or error}{did_you_mean(name, there)}"
    except OSError as error:
        why = error.strerror or str(error)
    except Exception as error:  # the parser raises all kinds on a text that is no DBC
        why = f"not a DBC file: {one_line(error)}"
    raise ConfigError([f"{key}: {name}: {why}"])


def _read(path: Path, names: set[str] | None = None) -> Database:
    """The DBC of a file; of its messages only these and those that may be mistaken for one of them."""
    raw = read_bounded(path, LARGEST)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("cp1252", errors="replace")
    check_multiplexers(text)
    if names is not None:
        text = of_messages(text, names)
    database = _parsed(text)
    if names is None and not database.messages:
        raise ValueError("no message in it")
    return database


def check_multiplexers(text: str) -> None:
    """Raise ValueError where the ranges of SG_MUL_VAL_ have too many values for the parser to expand."""
    left = MOST_MULTIPLEXER_VALUES
    for found in _RANGES.finditer(text):
        for low, high in _RANGE.findall(found["ranges"]):
            left -= max(int(high) - int(low) + 1, 0) if len(high) < MOST_DIGITS else left + 1
            if left < 0:
                raise ValueError(
                    f"SG_MUL_VAL_ of {found['signal']}: with {low}-{high} the multiplexers have more than"
                    f" {MOST_MULTIPLEXER_VALUES} values"
                )


def of_messages(text: str, names: set[str]) -> str:
    """Return the DBC's text with these messages, those of their identifiers, and those of the standards' groups.

    cantools needs 30 kB and 2 ms for a message; a maker's DBC may have thousands, of which a tractor maps a dozen.
    What is not plainly the definition of a message, or one line about one, stays: the parser is the judge of it.
    """
    known = [(int(found["id"]), found["name"]) for found in _MESSAGE.finditer(text)]
    wanted = {number for number, name in known if name in names}
    wanted |= {number for number, _ in known if number & _EXTENDED and pgn_of(number & ~_EXTENDED) in STANDARD_PGNS}

    def kept(found: re.Match[str]) -> str:
        return found[0] if int(found["id"]) in wanted else ""

    return _ABOUT.sub(kept, _MESSAGE.sub(kept, text))


@lru_cache(maxsize=4)
def _parsed(text: str) -> Database:
    """For reading only: a start asks for each text twice, and parsing is slow."""
    # not strict: an overlap in a message that nobody maps is none of our business
    database = Database(strict=False)
    database.add_dbc_string(text)
    named = [("message", message.name) for message in database.messages]
    named += [(f"signal of {message.name}", signal.name) for message in database.messages for signal in message.signals]
    for what, name in (*named, *(("node", node.name) for node in database.nodes)):
        if _IDENTIFIER.fullmatch(name) is None:  # attributes for long names can hold anything
            said = "letters, digits and _, at most 128 of them, a digit not first"
            raise ValueError(f"the {what} named {shown(name, LONGEST_NAME)}: a name is {said}")
    return database


def _layout(message: Message) -> tuple[object, ...]:
    signals = sorted(
        (s.name, s.start, s.length, s.byte_order, s.is_signed, s.conversion.is_float, s.scale, s.offset, s.unit or "")
        for s in message.signals
    )
    return message.frame_id, message.is_extended_frame, message.length, tuple(signals)
