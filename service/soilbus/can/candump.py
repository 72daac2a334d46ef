"""Frames of a candump log: of `candump -L`, and what candump prints on a terminal.

    (1700000000.000672) can0 18FF30D0#1380B499D0070FE3 R                          a log line
     (2023-11-14 22:13:20.000672)  can0  18FF30D0   [8]  13 80 B4 99 D0 07 0F E3  a console line, made a log line here

A line with a classic data frame is cut up here by one pattern, in a third of the time that python-can takes.  Any other
(FD, remote or error frames, empty data, garbage) goes to python-can's reader, the judge of what a line means.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from operator import index

import can

Frame = tuple[float, int, bool, bytes | bytearray, bool, bool]
"""Time [s], identifier, whether extended, data, whether a remote frame, whether an error frame."""

Heard = tuple[str, Frame]  # channel of a frame, and the frame

# identifiers above 1FFFFFFF carry flags
_PLAIN_LINE = re.compile(
    r"\(([0-9]+\.[0-9]+)\) (\S+) ([0-9A-Fa-f]{3}|[01][0-9A-Fa-f]{7})#([0-9A-Fa-f]+)(?: [RT])?\n?"
).fullmatch
_STAMP = r"\s*+\(\s*+(?P<date>\d{4}-\d\d-\d\d\s++)?(?P<time>[\d:.]++)\)\s++"
_LOG_LINE = re.compile(_STAMP + r"(?P<channel>\S++)\s++(?P<id>[0-9A-Fa-f]{3,8})#(?P<rest>.*)", re.DOTALL)
_CONSOLE_LINE = re.compile(
    rf"(?:{_STAMP})?+\s*+(?P<channel>[^\s(]\S*+)\s++(?P<way>[RT]X [-B] [-E]\s++)?"
    r"(?P<id>[0-9A-Fa-f]{3,8})\s++\[(?P<length>\d\d?)\](?P<rest>.*)",
    re.DOTALL,
)
_UNSTAMPED = re.compile(r"\s*+[^\s(]\S*+\s++[0-9A-Fa-f]{3,8}#")
_ERROR_FLAG = 0x20000000
_ERROR_ID = "20000080"  # of an error frame that python-can takes for one; of candump's others it makes frames of data


def frame_of(message: can.Message) -> Frame:
    """Return the frame of a message of python-can; TypeError or ValueError where time or identifier is no number."""
    is_extended, is_remote, is_error = message.is_extended_id, message.is_remote_frame, message.is_error_frame
    return float(message.timestamp), index(message.arbitration_id), is_extended, message.data, is_remote, is_error


def whole(message: can.Message) -> can.Message:
    """Return the message; ValueError where it has fewer or more bytes than it says."""
    stated = message.dlc if message.is_fd else min(message.dlc, 8)
    if not (message.is_remote_frame or message.is_error_frame or len(message.data) == stated):
        raise ValueError(f"a frame of {stated} bytes has {len(message.data)}")
    return message


def of_message(message: can.Message, first: int = 0) -> Heard:
    """Return a message of python-can as a frame with its channel; `first` is the number of the log's first channel."""
    channel = message.channel
    name = channel + first if isinstance(channel, int) else channel or ""
    return str(name), frame_of(whole(message))


def is_candump(line: str) -> bool:
    """Return whether a line is one of candump, with or without a stamp."""
    return any(pattern.match(line) for pattern in (_LOG_LINE, _CONSOLE_LINE, _UNSTAMPED))


def candump_frames(lines: Iterable[str]) -> Iterator[Heard]:
    """Yield the frames that `can.CanutilsLogReader` reads of lines; ValueError or IndexError where it cannot."""
    for line in lines:
        found = _PLAIN_LINE(line) or _PLAIN_LINE(line := _log_line(line))
        if found is not None and len(found[4]) % 2 == 0:
            t, channel, identifier, data = found.groups()
            yield channel, (float(t), int(identifier, 16), len(identifier) > 3, bytes.fromhex(data), False, False)
        else:
            yield from map(of_message, can.CanutilsLogReader(io.StringIO(line)))


def _log_line(line: str) -> str:
    """A line of candump as `candump -L` would write it, dates as UTC, error frames as python-can knows them."""
    found = _LOG_LINE.match(line) or _CONSOLE_LINE.match(line)
    if (found is None and _UNSTAMPED.match(line)) or (found is not None and found["time"] is None):
        raise ValueError("its lines have no time stamps: record with candump -L, or candump -ta")
    if found is None:
        return line
    is_error = int(found["id"], 16) & _ERROR_FLAG
    stamp = found["time"]
    if found["date"]:
        clock, _, part = stamp.partition(".")
        day = datetime.strptime(f"{found['date'].strip()} {clock}", "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
        stamp = f"{int(day.timestamp())}.{part or '0'}"
    head = f"({stamp}) {found['channel']} {_ERROR_ID if is_error else found['id']}#"
    if found.re is _LOG_LINE:
        return head + found["rest"] if found["date"] or is_error else line
    length, rest = int(found["length"]), found["rest"].split()
    data = "".join(rest[:length])
    if rest[:2] == ["remote", "request"]:
        return f"{head}R{length}\n"
    if len(data) != 2 * length:
        raise ValueError(f"a frame of {length} bytes has {len(data) // 2}")
    is_fd = len(found["length"]) == 2  # its flags are not printed
    return f"{head}{'#0' * is_fd}{data}\n"
