"""The limits of a log that is made to fill memory or time, and the channel whose frames are read."""

import bz2
import gzip
import lzma
import struct
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pyarrow as pa
import pytest

from soilbus.can.dbc_files import load_databases
from soilbus.can.logs import Log, LogError
from soilbus.config.file import parse_config
from soilbus.config.model import ConfigError
from soilbus.offline.replay import channel_notes, read_frames, replay
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.reference import reference_configuration

LINE = b"(1700000000.000000) can0 123#0011223344556677\n"
BLANKS = b" " * 60_000 + b"\n"


@contextmanager
def memory_below(mebibytes: int) -> Iterator[None]:
    """Fail where what is done in it takes more memory at any time."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < mebibytes * 2**20
    finally:
        tracemalloc.stop()


def packed_lines(pack: Callable[..., object]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        with pack(path, "wb") as file:  # type: ignore[attr-defined]
            file.write(LINE * 200)
            file.write(BLANKS * 300)

    return write


def zstd_lines(path: Path) -> None:
    with pa.output_stream(path, compression="zstd") as file:
        file.write(LINE * 200 + BLANKS * 300)


def blf_of(containers: int, mebibytes: int) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        with can.BLFWriter(path) as log:
            log(can.Message(timestamp=1.7e9, arbitration_id=0x123, is_extended_id=False, data=bytes(8)))
        skipped = struct.pack("<4sHHLL", b"LOBJ", 32, 1, mebibytes << 20, 99)  # of no kind that is known
        content = zlib.compress(skipped.ljust(mebibytes << 20, b"\0"), 9)
        body = struct.pack("<H6xL4x", 2, mebibytes << 20) + content
        size = 16 + len(body)
        block = struct.pack("<4sHHLL", b"LOBJ", 16, 1, size, 10) + body + bytes(size % 4)
        with path.open("ab") as file:
            file.write(block * containers)

    return write


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (packed_lines(lzma.open), "unpacks to more than 250 times its size"),
        (packed_lines(bz2.open), "unpacks to more than 250 times its size"),
        (zstd_lines, "unpacks to more than 250 times its size"),
        (blf_of(64, 4), "unpacks to more than 250 times its size"),
        (blf_of(1, 80), "a block of more than 64 MiB"),
    ],
    ids=["xz", "bzip2", "zstd", "containers", "container"],
)
def test_a_small_log_that_unpacks_to_much_is_refused_in_little_memory(
    write: Callable[[Path], None], reason: str, tmp_path: Path
) -> None:
    path = tmp_path / "bomb"
    write(path)
    n = 0
    with memory_below(150), pytest.raises(LogError, match=reason):
        for n, _ in enumerate(Log(path).frames(), 1):  # noqa: B007
            pass
    assert n >= 1


@pytest.mark.parametrize(("blocks", "mebibytes", "reason"), [(1, 80, "a block of more than 64 MiB"), (40, 32, "250")])
def test_an_mf4_of_blocks_that_unpack_to_much_is_refused(
    blocks: int, mebibytes: int, reason: str, tmp_path: Path
) -> None:
    pytest.importorskip("asammdf")
    packed = zlib.compress(bytes(mebibytes << 20), 9)
    lengths = struct.pack("<4xQQ", mebibytes << 20, len(packed))
    block = b"##DZ" + struct.pack("<4xQQ", 48 + len(packed), 0) + b"DT\0\0" + lengths + packed
    path = tmp_path / "bomb.mf4"
    path.write_bytes(b"MDF     4.10    soilbus " + bytes(40) + block * blocks)
    with memory_below(150), pytest.raises(LogError, match=reason):
        list(Log(path).frames())


def test_a_log_of_constant_data_is_no_bomb(tmp_path: Path) -> None:
    path = tmp_path / "parked.log"
    with lzma.open(path, "wb") as file:
        file.writelines(b"(%.6f) can0 123#0000000000000000\n" % (1.7e9 + n) for n in range(100_000))
    assert sum(1 for _ in Log(path).frames()) == 100_000


@pytest.mark.parametrize("kind", [".log", ".log.gz", ".asc", ".csv"])
def test_a_line_without_end_is_damage_and_takes_no_memory(kind: str, tmp_path: Path) -> None:
    head = tmp_path / f"head{kind.removesuffix('.gz')}"
    with can.Logger(head) as writer:
        for i in range(300):
            writer(
                can.Message(timestamp=1.7e9 + i / 100.0, arbitration_id=0x123, is_extended_id=False, data=b"soilbus!")
            )
    path = tmp_path / f"endless{kind}"
    with gzip.open(path, "wb", compresslevel=1) if kind.endswith(".gz") else path.open("wb") as file:
        file.write(head.read_bytes().removesuffix(b"End TriggerBlock\n"))
        for _ in range(64):
            file.write(b"0" * 2**20)
    before: list[object] = []
    with memory_below(8), pytest.raises(LogError, match=r"a line of more than \d+ characters"):
        before.extend(read_frames(path))
    assert len(before) == 300


MUX = """VERSION ""
BU_: E
BO_ 256 M: 8 E
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" E
 SG_ Speed m1 : 8|16@1+ (0.001,0) [0|60] "m/s" E
SG_MUL_VAL_ 256 Speed Page {ranges};
"""


def test_ranges_of_a_multiplexer_are_counted_not_expanded(tmp_path: Path) -> None:
    path = tmp_path / "m.dbc"
    config = parse_config({"dbc": {"input": [str(path)]}})
    for ranges in ("0-4294967295", "0-99999, 100000 - 300000", "0-9" + "9" * 5000):
        path.write_text(MUX.format(ranges=ranges))
        with memory_below(64), pytest.raises(ConfigError, match=r"SG_MUL_VAL_ of Speed: .*more than 262144 values"):
            load_databases(config)
    path.write_text(MUX.format(ranges="1-3, 7-7, 200-255"))
    speed = load_databases(config).get_message_by_name("M").get_signal_by_name("Speed")
    assert speed.multiplexer_ids == [1, 2, 3, 7, *range(200, 256)]


def bursts(gap: float) -> str:
    """Ten frames of a mapped message, then a silence, thirty times."""
    return "".join(
        f"({1.7e9 + gap * n + i / 1e3:.6f}) can0 18FF31C8#DB5DD05D755AC85A\n" for n in range(30) for i in range(10)
    )


@pytest.mark.parametrize("gap", [59.0, 61.5])
def test_bursts_far_apart_make_few_windows(gap: float, tmp_path: Path) -> None:
    config = reference_configuration()
    path = tmp_path / "gaps.log"
    path.write_text(bursts(gap))
    windows = list(replay(Pipeline(config, load_databases(config)), [path]))
    assert len(windows) <= 60 + 2 * 30  # a minute of silence, and two for each burst; each second had one before


# --- channels


def two_channels(path: Path, first: str = "can0", second: str = "can1") -> Path:
    path.write_text("".join(f"({n}.0) {first} 123#0{n}\n({n}.5) {second} 123#F{n}\n" for n in range(9)))
    return path


def content(log: Log) -> set[int]:
    return {data[0] >> 4 for _, _, _, data, _, _ in log.frames()}


@pytest.mark.parametrize(
    ("names", "wanted", "chosen"),
    [
        (("can0", "can1"), "can0", "can0"), (("can0", "can1"), "can1", "can1"), (("can0", "can1"), "1", "can1"),
        (("1", "2"), "can0", "1"), (("1", "2"), "can1", "2"), (("1", "2"), "2", "2"),
        (("0", "1"), "can0", "0"), (("0", "1"), "can1", "1"), (("vcan0", "vcan7"), "7", "vcan7"),
    ],
)  # fmt: skip
def test_the_channel_is_chosen_by_name_or_number(
    names: tuple[str, str], wanted: str, chosen: str, tmp_path: Path
) -> None:
    log = Log(two_channels(tmp_path / "two.log", *names), wanted)
    assert content(log) == {0 if chosen == names[0] else 15}
    assert (log.chosen, log.left_out) == (chosen, 9)
    assert log.note.count(chosen) >= 1


def test_a_channel_that_is_not_there_is_refused_where_it_is_demanded_or_there_are_several(tmp_path: Path) -> None:
    log = two_channels(tmp_path / "two.log")
    with pytest.raises(LogError, match="no frame of can5, but of can0 and can1: choose with --channel"):
        list(Log(log, "can5").frames())
    log.write_text("(1.0) can3 123#00\n")
    alone = Log(log, "can0")
    assert len(list(alone.frames())) == 1
    assert alone.note == f"{log}: frames of can3, where bus.channel = can0; it has no other channel"
    with pytest.raises(LogError, match="no frame of can0, but of can3"):
        list(Log(log, "can0", demanded=True).frames())


def test_a_channel_that_begins_late_is_not_lost_in_silence(tmp_path: Path) -> None:
    path = tmp_path / "late.log"
    path.write_text("".join(f"({n / 1e3}) can1 123#00\n" for n in range(3000)) + "(9.0) can0 123#00\n")
    with pytest.raises(LogError, match="begins with can1 alone, but has can0 too: read it with --channel can0"):
        list(Log(path, "can0").frames())
    assert [frame[0] for frame in Log(path, "can0", demanded=True).frames()] == [9.0]


def test_the_other_channels_frames_are_counted_and_said(tmp_path: Path) -> None:
    config = reference_configuration()
    lines = bursts(0.02)
    path = tmp_path / "two.log"
    path.write_text("".join(f"{line}\n{line.replace('can0', 'can1')}\n" for line in lines.splitlines()))
    pipeline = Pipeline(config, load_databases(config))
    list(replay(pipeline, [path]))
    assert pipeline.admission.counts.elsewhere == 300
    assert sum(pipeline.admission.counts.received.values()) == 300
    assert channel_notes(config, [path]) == [
        f"{path}: frames of can0 are read; those of can1 are left out (bus.channel, --channel)"
    ]


def test_error_frames_are_of_no_other_channel(tmp_path: Path) -> None:
    path = tmp_path / "errors.log"
    path.write_text("(1.0) can0 123#00\n(1.1) can0 20000004#0008000000000000\n(1.2) can0 123#00\n")
    log = Log(path, "can0")
    assert [frame[5] for frame in log.frames()] == [False, True, False]
    assert (log.channels, log.note, log.left_out) == ({"can0": 2}, "", 0)


def test_check_says_of_standard_input_what_it_is() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "soilbus", "check", "--config", "tractor", "--channel", "can1", "--log", "-"],
        input=bursts(0.02).replace("can0", "can1").encode() + LINE, capture_output=True, timeout=120.0, check=False,
    )  # fmt: skip
    said = done.stdout.decode()
    assert "standard input: candump log, 0.6 s, 301 frames\nchannels: can0 1, can1 300; read: can1\n" in said
    assert "\nmapped messages: 1 of " in said
