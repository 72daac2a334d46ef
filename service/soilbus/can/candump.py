"""Frames of a candump log, a batch of lines at a time: of `candump -L`, and what candump prints on a terminal.

    (1700000000.000672) can0 18FF30D0#1380B499D0070FE3 R                          a log line
     (2023-11-14 22:13:20.000672)  can0  18FF30D0   [8]  13 80 B4 99 D0 07 0F E3  a console line, made a log line here

python-can's reader spends 7 us on a line, more than admission and binning together on its
frame.  Nearly every line of a log is a plain classic frame, so batches of such lines are cut
up here by a few calls for all of them, at 2 us a line; a batch with anything else in it (FD,
remote or error frames, empty data, garbage) goes to python-can's reader, which stays
the judge of what a line means.  A second process that reads ahead was not taken: it needs a
second core, and saves no work.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from itertools import repeat
from operator import index

import can

Frame = tuple[float, int, bool, bytes | bytearray, bool, bool]
"""Time [s], identifier, whether extended, data, whether a remote frame, whether an error frame."""

Batch = tuple[Iterable[str], list[Frame]]
"""Channel of each frame, and the frames."""

BATCH = 128
NO_STAMPS = "its lines have no time stamps: record with candump -L, or candump -ta"

# identifiers above 1FFFFFFF carry flags; the channel must not contain what the line is cut at
_PLAIN_LINES = re.compile(
    r"""(?:\([0-9]++\.[0-9]++\) [!"$-'*-~]++ (?:[0-9A-Fa-f]{3}|[01][0-9A-Fa-f]{7})#[0-9A-Fa-f]++\n)*+"""
).fullmatch
"""Without their directions.  Digits of data in pairs, or directions, in the pattern take it five times as long."""
_DIRECTION = re.compile(r" [RT]\n")
_CUTS = str.maketrans("()#", "   ")
_STAMP = r"\s*+\(\s*+(?P<date>\d{4}-\d\d-\d\d\s++)?(?P<time>[\d:.]++)\)\s++"
_LOG_LINE = re.compile(_STAMP + r"(?P<channel>\S++)\s++(?P<id>[0-9A-Fa-f]{3,8})#(?P<rest>.*)", re.DOTALL)
_CONSOLE_LINE = re.compile(
    rf"(?:{_STAMP})?+\s*+(?P<channel>[^\s(]\S*+)\s++(?P<way>[RT]X [-B] [-E]\s++)?"
    r"(?P<id>[0-9A-Fa-f]{3,8})\s++\[(?P<length>\d\d?)\](?P<rest>.*)",
    re.DOTALL,
)
_UNSTAMPED = re.compile(r"\s*+[^\s(]\S*+\s++[0-9A-Fa-f]{3,8}#")
_ERROR_FLAG = 0x20000000
_ERROR_ID = "20000080"
"""The identifier of an error frame that python-can takes for one; of candump's others it makes frames of data."""


def frame_of(message: can.Message) -> Frame:
    """Return the frame that a message of python-can stands for.

    Raises TypeError or ValueError where its time or identifier is no number, as from a damaged SQLite log.
    """
    return (
        float(message.timestamp),
        index(message.arbitration_id),
        message.is_extended_id,
        message.data,
        message.is_remote_frame,
        message.is_error_frame,
    )


def whole(message: can.Message) -> can.Message:
    """Return the message; ValueError where it has fewer or more bytes than it says."""
    stated = message.dlc if message.is_fd else min(message.dlc, 8)
    if not (message.is_remote_frame or message.is_error_frame or len(message.data) == stated):
        raise ValueError(f"a frame of {stated} bytes has {len(message.data)}")
    return message


def is_candump(line: str) -> bool:
    """Return whether a line is one of candump, with or without a stamp."""
    return any(pattern.match(line) for pattern in (_LOG_LINE, _CONSOLE_LINE, _UNSTAMPED))


def log_line(line: str) -> str:
    """Return a line that candump printed as `candump -L` would write it; any other line unchanged.

    An error frame of any class gets the identifier by which python-can knows one.  Stamps by date are taken as UTC.
    Raises ValueError for a line without a stamp, and for one that was cut off.
    """
    if found := _LOG_LINE.match(line):
        is_error = int(found["id"], 16) & _ERROR_FLAG
        if not (found["date"] or is_error):
            return line
        identifier = _ERROR_ID if is_error else found["id"]
        return f"({_seconds(found)}) {found['channel']} {identifier}#{found['rest']}"
    found = _CONSOLE_LINE.match(line)
    if found is None:
        if _UNSTAMPED.match(line):
            raise ValueError(NO_STAMPS)
        return line
    if found["time"] is None:
        raise ValueError(NO_STAMPS)
    identifier, length, rest = found["id"], int(found["length"]), found["rest"].split()
    data = "".join(rest[:length])
    if int(identifier, 16) & _ERROR_FLAG:
        identifier = _ERROR_ID
    if rest[:2] == ["remote", "request"]:
        data = f"R{length}"
    elif len(data) != 2 * length:
        raise ValueError(f"a frame of {length} bytes has {len(data) // 2}")
    elif len(found["length"]) == 2:  # of CAN FD; its flags are not printed
        data = f"#0{data}"
    return f"({_seconds(found)}) {found['channel']} {identifier}#{data}\n"


def _seconds(found: re.Match[str]) -> str:
    """The stamp [s] of a line, as text."""
    if not found["date"]:
        return found["time"]
    whole, _, part = found["time"].partition(".")
    day = datetime.strptime(f"{found['date'].strip()} {whole}", "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    return f"{int(day.timestamp())}.{part or '0'}"


def candump_batches(lines: Iterable[str]) -> Iterator[Batch]:
    """Yield the frames of a log's lines in lists, with their channels; the same that `can.CanutilsLogReader` reads.

    Raises what the reader (ValueError, IndexError) or `lines` raises, or ValueError for half a byte,
    after the frames before that place.
    """
    for batch in _batches(iter(lines)):
        plain = _plain(_DIRECTION.sub("\n", "".join(batch)))
        if plain is None:
            with suppress(ValueError):  # raised again in its turn, after the frames before
                plain = _plain(_DIRECTION.sub("\n", "".join(map(log_line, batch))))
        if plain is not None:
            yield plain
        else:
            yield from map(of_message, can.CanutilsLogReader(log_line(line) for line in batch))  # type: ignore[arg-type]


def of_message(message: can.Message, first: int = 0) -> Batch:
    """Return a message of python-can as a batch; `first` is the number of the log's first channel."""
    channel = message.channel
    name = channel + first if isinstance(channel, int) else channel or ""
    return (str(name),), [frame_of(whole(message))]


def _batches(lines: Iterator[str]) -> Iterator[list[str]]:
    """Lines in lists of BATCH; what was read before an error comes before the error."""
    batch: list[str] = []
    try:
        for line in lines:
            batch.append(line)
            if len(batch) == BATCH:
                yield batch
                batch = []
    except Exception:
        yield batch
        raise
    yield batch


def _plain(text: str) -> Batch | None:
    """Channels and frames of plain lines without directions, four words each once cut; None for any other line."""
    if not _PLAIN_LINES(text):
        return None
    words = text.translate(_CUTS).split()
    identifiers = words[2::4]
    try:
        data = list(map(bytes.fromhex, words[3::4]))
    except ValueError:  # half a byte
        return None
    frames = zip(
        map(float, words[::4]),
        map(int, identifiers, repeat(16)),
        [len(i) > 3 for i in identifiers],
        data,
        repeat(False),
        repeat(False),
    )
    return words[1::4], list(frames)
