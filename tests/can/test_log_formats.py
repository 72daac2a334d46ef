"""One drive in the formats in which people have their logs: each gives the same frames, or a reason."""

import bz2
import gzip
import json
import lzma
import sqlite3
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from random import Random

import asammdf
import can
import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from soilbus.can.logs import Log, LogError
from soilbus.can.mcap_frames import frame_message

BEGIN = 1_700_000_000.0
_random = Random(51)
ROWS = [
    (
        round(BEGIN + 0.01 * n + _random.random() / 500.0, 4),
        *_random.choice([("18FF30D0", 8), ("123", 8), ("0CFE6CEE", 3)]),
    )
    for n in range(300)
]
DATA = [bytes(_random.randrange(256) for _ in range(length)) for _, _, length in ROWS]
FRAMES = [(t, identifier, data) for (t, identifier, _), data in zip(ROWS, DATA, strict=True)]
Row = Callable[[float, str, bytes], str]


def is_extended(identifier: str) -> bool:
    return len(identifier) == 8


def date(t: float) -> datetime:
    return datetime.fromtimestamp(t, UTC)


def spaced(data: bytes) -> str:
    return data.hex(" ").upper()


def console(stamp: Callable[[float], str], way: str = "") -> Row:
    return lambda t, i, d: f" ({stamp(t)})  can0  {way}{i:>8s}   [{len(d)}]  {spaced(d)}"


def gvret(stamp: Callable[[float], int], end: str = "") -> Row:
    return lambda t, i, d: f"{stamp(t)},{int(i, 16):08X},{str(is_extended(i)).lower()},Rx,0,{len(d)},{d.hex(',')}{end}"


def of_day(t: float) -> str:
    return f"{date(t):%H:%M:%S}:{date(t).microsecond // 100:04d}"


def wrapped(t: float) -> int:
    """Microseconds of a signed counter of 32 bits that begins again after a second."""
    return (2**31 - 1_000_000 + round((t - BEGIN) * 1e6) + 2**31) % 2**32 - 2**31


def decimal_asc(t: float, identifier: str, data: bytes) -> str:
    name = f"{int(identifier, 16)}{'x' * is_extended(identifier)}"
    return f"{t - BEGIN:11.6f} 1  {name:15s} Rx   d {len(data)} {' '.join(map(str, data))}"


GVRET = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"
BUSMASTER = """***BUSMASTER Ver 3.2.2***
***PROTOCOL CAN***
***START DATE AND TIME 14:11:2023 22:13:20:000***
***{base}***
***SYSTEM MODE***
***<Time><Tx/Rx><Channel><CAN ID><Type><DLC><DataBytes>***"""
ASC = """date {day} 06:24:08.927 {year}
base {base}  timestamps absolute
internal events logged
Begin Triggerblock {day} 06:24:08.846 {year}
   0.000000 {start}Start of measurement"""
TEXTS: dict[str, tuple[str, Row]] = {
    "log": ("", lambda t, i, d: f"({t:.6f}) can0 {i}#{d.hex().upper()}"),
    "log of dates": ("", lambda t, i, d: f"({date(t):%Y-%m-%d %H:%M:%S.%f}) can0 {i}#{d.hex()}"),
    "log from zero": ("", lambda t, i, d: f"({t - BEGIN:010.6f}) can0 {i}#{d.hex()} R"),
    "console": ("", console("{:.6f}".format)),
    "console of dates": ("", console(lambda t: f"{date(t):%Y-%m-%d %H:%M:%S.%f}")),
    "console from zero": ("", console(lambda t: f"{t - BEGIN:010.6f}", "RX - -  ")),
    "console with text": ("", lambda t, i, d: console("{:.6f}".format)(t, i, d) + "   '........'"),
    "gvret": (GVRET, gvret(lambda t: round((t - BEGIN) * 1e6))),
    "gvret that wraps": (GVRET, gvret(wrapped, ",")),
    "canedge": (
        "TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;DataBytes",
        lambda t, i, d: f"{t:.6f};1;{i};{is_extended(i):d};{len(d)};{len(d)};0;0;0;{d.hex().upper()}",
    ),
    "busmaster": (
        BUSMASTER.format(base="HEX"),
        lambda t, i, d: f"{of_day(t)} Rx 1 0x{i} {'sx'[is_extended(i)]} {len(d)} "
        + spaced(d),
    ),
    "busmaster, decimal": (
        BUSMASTER.format(base="DEC"),
        lambda t, i, d: f"{of_day(t)} Rx 1 {int(i, 16)} {'sx'[is_extended(i)]} "
        f"{len(d)} {' '.join(map(str, d))}",
    ),
    "trc 1.1": (
        ";$FILEVERSION=1.1\n;$STARTTIME=43008.920986",
        lambda t, i, d: f"   1) {(t - BEGIN) * 1e3:11.1f}  Rx    {i:>8s}  {len(d)}    {spaced(d)} ",
    ),
    "trc 2.1": (
        ";$FILEVERSION=2.1\n;$STARTTIME=43008.920986\n;$COLUMNS=N,O,T,B,I,d,R,L,D",
        lambda t, i, d: f"      1 {(t - BEGIN) * 1e3:13.3f} DT 1 {i:>8s} Rx - {len(d)}    {spaced(d)} ",
    ),
    "asc": (
        ASC.format(day="Fri May 05", year=2024, base="hex", start=""),
        lambda t, i, d: f"{t - BEGIN:11.6f} 1  {i + 'x' * is_extended(i):15s} Rx   d {len(d)} {spaced(d)}  ID = 4",
    ),
    "asc, decimal, of a German month": (ASC.format(day="Die Mär 05", year=2024, base="dec", start=""), decimal_asc),
    "asc, decimal, of a French month": (ASC.format(day="mar. févr. 13", year=2024, base="dec", start=""), decimal_asc),
    "asc of CAN FD": (
        ASC.format(day="Fri May 05", year=2024, base="hex", start="CANFD   "),
        lambda t, i, d: f"{t - BEGIN:11.6f} CANFD   1 Rx {i + 'x' * is_extended(i):>11s}   1 0 {len(d):x} {len(d)} "
        f"{spaced(d)}   0  0   323040 0 0 0 0 0",
    ),
}  # fmt: skip


def text(kind: str) -> str:
    head, row = TEXTS[kind]
    return "".join(f"{line}\n" for line in [*([head] if head else []), *(row(*frame) for frame in FRAMES)])


def check_same(log: Log, resolution: float) -> None:
    """The frames of the drive, but for the time at which it began."""
    found = [frame for frame in log.frames() if not (frame[4] or frame[5])]
    assert [(i, x, bytes(d)) for _, i, x, d, _, _ in found] == [(int(i, 16), is_extended(i), d) for _, i, d in FRAMES]
    passed = [t - found[0][0] for t, *_ in found]
    assert passed == pytest.approx([t - FRAMES[0][0] for t, *_ in FRAMES], abs=resolution)
    assert log.span == pytest.approx(FRAMES[-1][0] - FRAMES[0][0], abs=resolution)


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "utf-16"])
@pytest.mark.parametrize("kind", TEXTS)
def test_a_text_gives_the_frames_whatever_its_name(kind: str, encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "drive.txt"
    path.write_text(text(kind), encoding=encoding)
    check_same(Log(path, "can0"), 2.1e-4)  # BUSMASTER and TRC 1.1 have 0.1 ms


@pytest.mark.parametrize("kind", [".blf", ".mf4", ".db", ".csv", ".asc"])
def test_what_python_can_writes_gives_the_frames(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"drive{kind}"
    with can.Logger(path) as log:
        for t, identifier, data in FRAMES:
            log(can.Message(t, int(identifier, 16), is_extended(identifier), data=data, channel=0))
    check_same(Log(path, "can0"), 1e-5)


def mcap_of(path: Path, topics: dict[str, list[bytes]], compression: CompressionType) -> None:
    """An MCAP file of JSON messages by the name of their schema."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start()
        for name, messages in topics.items():
            channel = writer.register_channel(f"/{name}", "json", writer.register_schema(name, "jsonschema", b"{}"))
            for message in messages:
                writer.add_message(channel, 0, message, 0)
        writer.finish()


@pytest.mark.parametrize("compression", list(CompressionType))
def test_an_mcap_of_frames_gives_the_frames(compression: CompressionType, tmp_path: Path) -> None:
    messages = [
        frame_message("can0", (t, int(identifier, 16), is_extended(identifier), data, False, False))
        for t, identifier, data in FRAMES
    ]
    said = [json.dumps(message).encode() for message in messages]
    mcap_of(tmp_path / "drive", {"other": [b"{}"], "can_msgs/Frame": said}, compression)
    check_same(Log(tmp_path / "drive", "can0"), 1e-12)


@pytest.mark.parametrize(
    ("topics", "reason"),
    [
        ({"soilbus.Window": [b"{}"]}, "it has no CAN frames: no JSON message of schema can_msgs/Frame"),
        ({"can_msgs/Frame": [b'{"dlc": 1}']}, "a frame without 'header'"),
        ({"can_msgs/Frame": [b"[" * 100_000]}, "a frame of more than 65536 characters"),
        ({"other": [bytes(70 << 20)]}, "a block of more than 64 MiB"),
        ({"other": [bytes(1 << 22)] * 20}, "it unpacks to more than 250 times its size"),
    ],
)
def test_an_mcap_that_cannot_be_read_has_its_reason(
    topics: dict[str, list[bytes]], reason: str, tmp_path: Path
) -> None:
    mcap_of(tmp_path / "drive.mcap", topics, CompressionType.ZSTD)
    with pytest.raises(LogError, match=reason):
        list(Log(tmp_path / "drive.mcap").frames())


def test_an_mf4_of_decoded_signals_has_its_reason(tmp_path: Path) -> None:
    path = tmp_path / "decoded.mf4"
    stamps = np.arange(0.0, 2.0, 0.01)
    with asammdf.MDF(version="4.10") as signals:
        for name in ("Torque", "Speed"):
            signals.append(asammdf.Signal(np.sin(stamps), stamps, name=name, unit="N m"))
        signals.save(path)
    with pytest.raises(LogError) as fault:
        list(Log(path).frames())
    assert str(fault.value) == (
        f"{path}: not a CAN log that can be read (it has no CAN frames; if it holds decoded signals, soilbus init"
        " --table maps them)"
    )


def packed_by_zstd(data: bytes) -> bytes:
    arrow = pytest.importorskip("pyarrow")
    sink = arrow.BufferOutputStream()
    with arrow.CompressedOutputStream(sink, "zstd") as out:
        out.write(data)
    return sink.getvalue().to_pybytes()


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress, packed_by_zstd])
def test_a_packed_log_gives_the_frames_and_a_cut_one_a_line(pack: Callable[[bytes], bytes], tmp_path: Path) -> None:
    path, half = tmp_path / "drive", len(text("log")) // 2
    content = text("log").encode()
    path.write_bytes(pack(content[:half]) + pack(content[half:]))
    check_same(Log(path, "can0"), 1e-6)
    path.write_bytes(pack(content)[:-9])
    with pytest.raises(LogError, match=r"drive: (cut off or damaged after|not a CAN log)"):
        list(Log(path).frames())


def test_error_frames_and_remote_frames_are_told_apart(tmp_path: Path) -> None:
    lines = [
        " (1.000000)  can0       123   [2]  01 02",
        " (1.100000)  can0  20000004   [8]  00 08 00 00 00 00 00 00   ERRORFRAME",
        " (1.200000)  can0       123   [2]  remote request",
        " (1.300000)  can0       124  [12]  00 01 02 03 04 05 06 07 08 09 0A 0B",
        "(1.400000) can0 20000004#0008000000000000",
    ]
    path = tmp_path / "a.log"
    path.write_text("\n".join(lines) + "\n")
    found = [(t, bytes(d or b""), remote, error) for t, _, _, d, remote, error in Log(path).frames()]
    assert found == [
        (1.0, b"\1\2", False, False), (1.1, b"", False, True), (1.2, b"", True, False),
        (1.3, bytes(range(12)), False, False), (1.4, b"", False, True),
    ]  # fmt: skip


def deltas(row: Row) -> str:
    before = [FRAMES[0][0], *(t for t, *_ in FRAMES[:-1])]
    return "".join(row(BEGIN + max(t - b, 1e-6), i, d) + "\n" for b, (t, i, d) in zip(before, FRAMES, strict=True))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (deltas(TEXTS["log from zero"][1]), "its stamps are relative to the frame before"),
        (deltas(TEXTS["console from zero"][1]), "its stamps are relative to the frame before"),
        ("  can0  123   [2]  01 02\n" * 9, "its lines have no time stamps"),
        ("can0  123#0102\n" * 9, "its lines have no time stamps"),
        (text("busmaster").replace("SYSTEM", "RELATIVE"), "its stamps are relative to the frame before"),
        (" (1.5)  can0  123   [8]  01 02\n", "a frame of 8 bytes has 2"),
        (f"{GVRET}\n1,123,false,Rx,0,8,01,02\n", "a frame of 8 bytes has 2"),
        (f"{GVRET}\n1,123\n", "a line without 'extended'"),
        ("t,slip,pull\n1,2,3\n", "a table, whose 3 columns are not those of CAN frames"),
        ("Dear diary\n", "text of no known format"),
        ("PAR1", "a Parquet table, without CAN frames"),
        ("MDF     3.30", "an MDF file of version 3"),
        ("\0\1\2", "binary data of no known format"),
        (";\0 1,2", "binary data of no known format"),
        ("".join(f"({9.0 - 0.1 * i:.6f}) can0 123#0102\n" for i in range(60)), "its stamps go backwards"),
        ("", "no frame in it"),
    ],
)  # fmt: skip
def test_what_gives_no_frames_has_its_reason(content: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "x.log").write_text(content)
    with pytest.raises(LogError, match=reason):
        list(Log(tmp_path / "x.log").frames())


def test_a_channel_of_control_characters_is_text_in_a_fault(tmp_path: Path) -> None:
    (tmp_path / "x.log").write_text("(1.0) a\x1b[31m\u202e 123#00\n(2.0) b\x07 123#00\n")
    with pytest.raises(LogError) as fault:
        list(Log(tmp_path / "x.log", "can0").frames())
    assert str(fault.value).isprintable()
    assert r"a\x1b[31m\u202e and b\x07" in str(fault.value)


@pytest.mark.parametrize(
    "schema",
    [
        "CREATE VIEW messages AS WITH RECURSIVE c(x) AS (SELECT 1.0 UNION ALL SELECT x + 1 FROM c) SELECT x AS ts, 1 AS"
        " arbitration_id, 0 AS extended, 0 AS remote, 0 AS error, 1 AS dlc, x'00' AS data FROM c",
        "CREATE TABLE messages (ts, arbitration_id, extended, remote, error, dlc, data AS (zeroblob(1000000000)))",
        "CREATE VIRTUAL TABLE messages USING fts5(ts, arbitration_id, extended, remote, error, dlc, data)",
    ],
)
def test_a_database_that_computes_its_messages_is_refused(schema: str, tmp_path: Path) -> None:
    path = tmp_path / "bomb.db"
    with closing(sqlite3.connect(path)) as log:
        log.execute(schema)
        if "zeroblob" in schema:
            log.execute("INSERT INTO messages VALUES (1.0, 1, 0, 0, 0, 1)")
        log.commit()
    with pytest.raises(
        LogError, match=r"bomb.db: not a CAN log that can be read \((its messages are no table|string or blob too big)"
    ):
        list(Log(path).frames())
