"""The formats of logs that people have, each recognised by its content and read as frames with their channels.

    first bytes -> Format(name, frames)         frames(stream) -> (channel, frame) of each

python-can reads ASC, BLF, TRC, MF4 and its own CSV; candump (can/candump.py), other CSVs and BUSMASTER are read here.
"""

from __future__ import annotations

import gc
import math
import mmap
import re
import sqlite3
import struct
import sys
import traceback
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from functools import partial
from io import BufferedReader
from pathlib import Path
from shutil import copyfileobj
from tempfile import NamedTemporaryFile
from typing import NamedTuple

import can

from soilbus.can.candump import Heard, candump_frames, is_candump, of_message
from soilbus.can.mcap_frames import mcap_frames
from soilbus.files import LIMITS, text_lines, within_ratio

HEAD = 1 << 13  # bytes at the begin of a log by which its format is recognised
WRAP = 2**32 / 1e6  # seconds after which the stamps of an analyser of 32 bits begin again
OF_SIGNALS = "if it holds decoded signals, soilbus init --table maps them"
TOO_LARGE = f"a block of more than {LIMITS.block >> 20} MiB"
DAY = 86400.0  # seconds after which a clock of hours, minutes and seconds begins again


class Format(NamedTuple):
    """Name of a format for a user, and the reader of a stream of it, which raises all kinds on a damaged file."""

    name: str
    frames: Callable[[BufferedReader], Iterator[Heard]]


def format_of(head: bytes) -> Format:
    """Return the format of a log by its first bytes; ValueError says what it is instead."""
    for mark, found in _BINARY.items():
        if head.startswith(mark):
            if isinstance(found, str):
                raise ValueError(f"{found}, without CAN frames")
            return found
    is_wide = head[:2] in (b"\xff\xfe", b"\xfe\xff")
    text = head.decode("utf-16" if is_wide else "utf-8-sig", errors="replace")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if not lines:
        return Format("an empty file", lambda _: iter(()))
    if "\0" in text:
        raise ValueError("binary data of no known format")
    first = lines[0]
    if first.startswith("***BUSMASTER"):
        return Format("BUSMASTER log", _busmaster)
    if csv := csv_of_frames(first):
        return csv
    if first.startswith(";") or _TRC_LINE.match(first):
        return Format("PCAN TRC log", lambda stream: map(of_message, can.TRCReader(text_lines(stream))))  # type: ignore[arg-type]
    if any(map(_ASC_LINE.match, lines)):
        return Format("Vector ASC log", _asc)
    if any(map(is_candump, lines)):
        return Format("candump log", lambda stream: candump_frames(text_lines(stream)))
    if "\ufffd" in text:
        raise ValueError("binary data of no known format")
    if columns := [cell for cell in re.split("[,;\t]", first) if cell.strip()][1:]:
        raise ValueError(f"a table, whose {len(columns) + 1} columns are not those of CAN frames; {OF_SIGNALS}")
    raise ValueError("text of no known format")


# --- text


_ASC_LINE = re.compile(
    r"date\s+\w+\s.*\d|base\s+(hex|dec)\b|begin\s+triggerblock\b|//\s*version\b"
    r"|\d+\.\d+\s+(\d+\s+(\w+\s+[TR]x|ErrorFrame)|CANFD\s)",
    re.IGNORECASE,
)
_TRC_LINE = re.compile(r"\d+\)\s+\d")
_ASC_NO_FRAME = re.compile(r"\s*+(date\s|[\d.]++\s++(CANFD\s++(?!\d)|.*\sTxRq\s))", re.IGNORECASE)
"""Events that python-can would take for frames ("Start of measurement" of CAN FD, requests to send), and the date:
in some languages python-can does not know it and reads no base after it."""


def _asc(stream: BufferedReader) -> Iterator[Heard]:
    """Stamps count from the log's begin; those after the last event cannot be summed up, as not all events are read."""
    reader = can.ASCReader(line for line in text_lines(stream) if not _ASC_NO_FRAME.match(line))  # type: ignore[arg-type]
    last = float("-inf")
    for message in reader:
        if message.timestamp < last and reader.timestamps_format == "relative":
            raise ValueError("its stamps are relative to the event before: save it with absolute ones")
        last = message.timestamp
        yield of_message(message, 1)


class _Clock:
    """Time [s] that goes on where the stamps begin again after a period [s]."""

    def __init__(self, period: float) -> None:
        self._period, self._late, self._last = period, 0.0, -math.inf

    def __call__(self, t: float) -> float:
        if self._period > self._last > t + self._period / 2.0:
            self._late += self._period
        self._last = t
        return t + self._late


_Said = tuple[float, bool, bytes, int, bool]
"""What a row of a CSV says: time [s], extended, data, length, remote."""


def _truth(text: str) -> bool:
    return text.lower() in ("1", "true")


def _gvret(row: Mapping[str, str]) -> _Said:
    data = bytes(int(cell, 16) for i in range(1, 65) if (cell := row.get(f"d{i}", "")))
    return int(row["time stamp"]) / 1e6, _truth(row["extended"]), data, int(row["len"]), False


def _canedge(row: Mapping[str, str]) -> _Said:
    data = bytes.fromhex(row["databytes"])
    length = int(row.get("datalength", len(data)))
    return float(row["timestampepoch"]), _truth(row["ide"]), data, length, _truth(row.get("rtr", "0"))


_CSVS = (
    ("SavvyCAN (GVRET) CSV", {"time stamp", "id", "extended", "len", "d1"}, _gvret),
    ("CANedge CSV", {"timestampepoch", "id", "ide", "databytes"}, _canedge),
)
"""Name, columns by which it is recognised, and what a row says."""
_OF_PYTHON_CAN = ["timestamp", "arbitration_id", "extended", "remote", "error", "dlc", "data"]


def csv_of_frames(header: str) -> Format | None:
    """Return the format of a CSV of frames with this first line; None of any other."""
    names = _cells(header.lower())
    if names == _OF_PYTHON_CAN:
        return Format("CSV of python-can", lambda stream: map(of_message, can.CSVReader(text_lines(stream))))  # type: ignore[arg-type]
    for name, columns, said in _CSVS:
        if columns <= {*names}:
            return Format(name, partial(_of_csv, said))
    return None


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.replace(";", ",").split(",")]


def _of_csv(said: Callable[[Mapping[str, str]], _Said], stream: BufferedReader) -> Iterator[Heard]:
    rows = (line for line in text_lines(stream) if line.strip())
    names = _cells(next(rows).lower())
    unwrapped = _Clock(WRAP if said is _gvret else math.inf)
    for line in rows:
        cells = _cells(line)
        if len(cells) > len(names):
            cells = [*cells[: len(names)], *filter(None, cells[len(names) :])]  # a comma at the end of a line
        row = dict(zip(names, cells, strict=len(cells) > len(names)))
        try:
            identifier = int(row["id"], 16)
            t, extended, data, length, remote = said(row)
        except KeyError as name:
            raise ValueError(f"a line without {name}") from None
        if not remote and len(data) != length:
            raise ValueError(f"a frame of {length} bytes has {len(data)}")
        channel = row.get("bus") or row.get("buschannel") or ""
        yield channel, (unwrapped(t), identifier & 0x1FFFFFFF, extended, data, remote, False)


_BUSMASTER_DATE = re.compile(r"\*\*\*START DATE AND TIME (\d+):(\d+):(\d+) ")


def _busmaster(stream: BufferedReader) -> Iterator[Heard]:
    """Stamps are the time of the day, or count from the log's begin."""
    base, midnight, unwrapped = 16, 0.0, _Clock(DAY)
    in_day = True
    for line in text_lines(stream):
        if line.startswith("***DEC"):
            base = 10
        elif line.startswith("***RELATIVE MODE"):
            raise ValueError("its stamps are relative to the frame before: log in system or absolute mode")
        elif line.startswith("***ABSOLUTE MODE"):
            in_day = False
        elif found := _BUSMASTER_DATE.match(line):
            day, month, year = map(int, found.groups())
            midnight, unwrapped = datetime(year, month, day, tzinfo=UTC).timestamp(), _Clock(DAY)
        if line.startswith("***") or not line.strip():
            continue
        stamp, _, channel, identifier, kind, length, *data = line.split()
        hours, minutes, seconds, parts = map(int, stamp.split(":"))  # the last in units of 0.1 ms
        t = unwrapped(3600.0 * hours + 60.0 * minutes + seconds + parts / 1e4)
        remote, n = "r" in kind.lower(), int(length)
        content = b"" if remote else bytes(int(byte, base) for byte in data[:n])
        if not remote and len(content) != n:
            raise ValueError(f"a frame of {n} bytes has {len(content)}")
        number = int(identifier, 16 if identifier.lower().startswith("0x") else base)
        yield channel, (t + midnight * in_day, number, kind.lower().startswith("x"), content, remote, False)


# --- binary


_BLF_OBJECT, _BLF_CONTAINER = struct.Struct("<4s4xLL"), struct.Struct("<H6xL4x")
_IS_CONTAINER, _IS_PLAIN, _IS_DEFLATED, _LEAST_BLF_HEAD = 10, 0, 2, 144


class _BoundedBlf(can.BLFReader):
    """python-can's reader, which would unpack a container of any size, with each of them bounded."""

    def __iter__(self) -> Generator[can.Message, None, None]:
        packed = plain = 0
        while (head := self.file.read(_BLF_OBJECT.size)).strip(b"\0"):  # the end may be padded
            mark, size, kind = _BLF_OBJECT.unpack(head)
            left = max(size - len(head), 0)
            body = self.file.read(min(left, LIMITS.block + 1))
            if mark != b"LOBJ" or len(body) > LIMITS.block:
                raise ValueError(TOO_LARGE if mark == b"LOBJ" else "no object of a BLF log")
            if len(body) < left:
                raise ValueError("cut off within a block")
            self.file.read(size % 4)
            if kind != _IS_CONTAINER:
                continue
            method, _ = _BLF_CONTAINER.unpack_from(body)
            content = body[_BLF_CONTAINER.size :]
            if method == _IS_DEFLATED:
                content = inflated(content)
            packed, plain = packed + len(body), plain + len(content)
            within_ratio(packed, plain)
            if method in (_IS_PLAIN, _IS_DEFLATED):
                yield from self._parse_container(content)


def _blf(stream: BufferedReader) -> Iterator[Heard]:
    (size,) = struct.unpack_from("<4xL", stream.peek(8))
    if not _LEAST_BLF_HEAD <= size <= LIMITS.block:
        raise ValueError("no head of a BLF log")
    return (of_message(message, 1) for message in _BoundedBlf(stream))


def inflated(packed: bytes) -> bytes:
    """Return what deflated bytes unpack to; ValueError where it is more than LIMITS.block, or cut off."""
    decoder = zlib.decompressobj()
    content = decoder.decompress(packed, LIMITS.block)
    if decoder.unconsumed_tail:
        raise ValueError(TOO_LARGE)
    if not decoder.eof:
        raise ValueError("cut off within a block")
    return content


@contextmanager
def placed_copy(stream: BufferedReader) -> Iterator[Path]:
    """Give the path of a copy of a stream, for libraries that seek in a file."""
    with NamedTemporaryFile(prefix="soilbus-") as file:
        copyfileobj(stream, file)
        file.flush()
        yield Path(file.name)


_MF4_BLOCK = re.compile(rb"##DZ....(.{8})\0{8}(..)([\0-\xff]).(.{4})(.{8})(.{8})", re.DOTALL)


def _mf4(stream: BufferedReader) -> Iterator[Heard]:
    if can.io.mf4.asammdf is None:  # type: ignore[attr-defined]
        raise ModuleNotFoundError("this format needs soilbus[mf4]")
    with placed_copy(stream) as path:
        check_mf4_blocks(path)
        is_empty = True
        with _mf4_reader(path) as reader:
            for message in reader:
                is_empty = False
                yield of_message(message)
        if is_empty:
            raise ValueError(f"it has no CAN frames; {OF_SIGNALS}")


def _mf4_reader(path: Path) -> can.MF4Reader:
    usual = sys.unraisablehook
    try:
        return can.MF4Reader(path)
    except Exception as error:
        sys.unraisablehook = lambda _: None  # asammdf's destructor fails on what its constructor has left unmade
        traceback.clear_frames(error.__traceback__)
        gc.collect()
        raise
    finally:
        sys.unraisablehook = usual


def check_mf4_blocks(path: Path) -> None:
    """Raise ValueError where a deflated block unpacks to more than its size allows."""
    size = path.stat().st_size
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        plain = 0
        for found in _MF4_BLOCK.finditer(content):
            if int.from_bytes(found[1], "little") != 48 + int.from_bytes(found[6], "little"):
                continue  # no block, but data that look like one
            if found[3] not in b"\0\1":
                raise ValueError("a block that is packed by other than deflate")
            plain += len(inflated(content[found.end() : found.end() + int.from_bytes(found[6], "little")]))
            within_ratio(size, plain)


_SQL = "SELECT ts, arbitration_id, extended, remote, error, dlc, data FROM messages"


def _sqlite(stream: BufferedReader) -> Iterator[Heard]:
    """Frames of python-can's SQLite log; a view, a function or a virtual table in their place is refused."""
    with placed_copy(stream) as path, closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as log:
        log.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LIMITS.line)
        log.execute("PRAGMA trusted_schema = OFF")
        kinds = log.execute("SELECT type, sql FROM sqlite_schema WHERE name = 'messages'").fetchall()
        if [(kind, sql.split()[1].upper()) for kind, sql in kinds if sql] != [("table", "TABLE")]:
            raise ValueError("its messages are no table")

        def allowed(action: int, table: str | None, *_: object) -> int:
            reads = action == sqlite3.SQLITE_SELECT or (action == sqlite3.SQLITE_READ and table == "messages")
            return sqlite3.SQLITE_OK if reads else sqlite3.SQLITE_DENY

        log.set_authorizer(allowed)
        for t, identifier, extended, remote, error, dlc, data in log.execute(_SQL):
            message = can.Message(
                timestamp=t, arbitration_id=identifier, is_extended_id=bool(extended), is_remote_frame=bool(remote),
                is_error_frame=bool(error), dlc=dlc, data=data or b"",
            )  # fmt: skip
            yield of_message(message)


_BINARY: Mapping[bytes, Format | str] = {
    b"LOGG": Format("BLF log", _blf),
    b"MDF     4": Format("MF4 log", _mf4),
    b"\x89MCAP": Format("MCAP log", mcap_frames),
    b"SQLite format 3\0": Format("SQLite log of python-can", _sqlite),
    b"PAR1": "a Parquet table",
    b"UnFinMF ": "an MDF file that was never finished",
    b"MDF     ": "an MDF file of version 3",
    b"PK\x03\x04": "a ZIP archive",
}
