"""A reader in C, of our DBC by cantools and of the README's rules, reads what our publisher sends and nothing else.

Compiled by the command that dbc/README.md states for reader.c.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import can
import cantools
import numpy as np
import pytest
from cantools.database.can import Message, Signal

from availability import unavailable
from soilbus.can.checksum import frame_checksum
from soilbus.can.publish import Frame, Publisher, ValueCodes

REPO = Path(__file__).resolve().parents[2]
DBC = REPO / "dbc"
PAGE = (DBC / "README.md").read_text(encoding="utf-8")
DATABASE = cantools.database.load_file(DBC / "soilbus.dbc", strict=True)
PROTOCOL = ("Counter", "Checksum")
READ = [DATABASE.get_message_by_name(name) for name in ("Traversability", "WheelSlip", "TractionLimits")]
MESSAGES = [pytest.param(message, id=message.name) for message in READ]


class Line(NamedTuple):
    """What the reader said: of which message, what about it, frames lost before, values."""

    message: str
    verdict: str
    lost: int | None = None
    values: tuple[str, ...] = ()


Read = Callable[[Iterable[tuple[float, Frame]]], list[Line]]


def values_of(message: Message) -> list[Signal]:
    return [signal for signal in message.signals if signal.name not in PROTOCOL]


@pytest.fixture(scope="module")
def read(tmp_path_factory) -> Read:
    """The reader, built by the page's one command where only our sources are; what it says of frames."""
    if shutil.which("gcc") is None:
        unavailable("no gcc")
    place = tmp_path_factory.mktemp("reader")
    for folder in ("dbc", "tests"):
        (place / folder).symlink_to(REPO / folder)
    command = re.search(r"^python -m cantools .*reader\.c$", PAGE, re.M)[0]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(command, shell=True, cwd=place, check=True, capture_output=True, env={**os.environ, "PATH": path})

    def read(frames: Iterable[tuple[float, Frame]]) -> list[Line]:
        log = "".join(map(candump, frames))
        done = subprocess.run([place / "reader"], input=log, text=True, capture_output=True, check=True)
        return [line_of(text) for text in done.stdout.splitlines()]

    return read


def of_frames(lines: Iterable[Line]) -> list[Line]:
    """The lines of frames, without those of the verdict to show."""
    return [line for line in lines if line.message != "verdict"]


def candump(stamped: tuple[float, Frame]) -> str:
    t, frame = stamped
    return f"({t:.6f}) can0 {frame.arbitration_id:0{8 if frame.extended else 3}X}#{frame.data.hex().upper()}\n"


def line_of(text: str) -> Line:
    message, verdict, *rest = text.split()
    return Line(message, verdict, int(rest[0]), tuple(rest[1:])) if rest else Line(message, verdict)


def assert_same(line: Line, frame: Frame) -> None:
    """Value for value what cantools decodes, codes by the names of the value table."""
    message = DATABASE.get_message_by_frame_id(frame.arbitration_id)
    assert (line.message, line.verdict) == (message.name, "good")
    raw = message.decode(frame.data, scaling=False, decode_choices=False)
    decoded = message.decode(frame.data, decode_choices=False)
    if message.name == "TractionLimits":  # the page's max_draft
        codes = ValueCodes(message.get_signal_by_name("MaxDraft"))
        is_known = codes.lowest <= raw["MaxDraft"] <= codes.highest and raw["Status"] == codes_of_status()["valid"]
        assert line.values == (f"{decoded['MaxDraft']:.17g}" if is_known else "none",)
        return
    for signal, said in zip(values_of(message), line.values, strict=True):
        name = str(signal.choices.get(raw[signal.name]))
        codes = ValueCodes(signal)
        if name in ("error", "not_available"):
            assert said == name, signal.name
        elif codes.lowest <= raw[signal.name] <= codes.highest:
            assert float(said) == pytest.approx(decoded[signal.name], rel=1e-12, abs=1e-12), signal.name
        else:
            assert said == "reserved", signal.name


def codes_of_status() -> dict[str, int]:
    """Code by name of a Status."""
    choices = DATABASE.get_message_by_name("TractionLimits").get_signal_by_name("Status").choices
    return {str(name): code for code, name in choices.items()}


def any_value(signal: Signal, rng: np.random.Generator) -> float | None:
    """Mostly a value, now and then none or one out of the range."""
    span = signal.maximum - signal.minimum
    return [
        None,
        signal.maximum + span + 1.0,
        signal.minimum - span - 1.0,
        signal.minimum,
        signal.maximum,
        *rng.uniform(signal.minimum, signal.maximum, 5).tolist(),
    ][rng.integers(10)]


def recording(seconds: float, seed: int) -> list[tuple[float, Frame]]:
    """Every message at its cycle with random values, as our publisher sends them."""
    rng, publisher = np.random.default_rng(seed), Publisher(DATABASE)
    return [
        (0.1 * tick, publisher.frame(m.name, {s.name: any_value(s, rng) for s in values_of(m)}))
        for tick in range(round(10 * seconds))
        for m in READ
        if tick % (m.cycle_time // 100) == 0
    ]


def corrected(frame: Frame, data: bytes) -> Frame:
    """The frame with other data and the checksum that belongs to them."""
    return Frame(
        frame.arbitration_id, frame.extended, data[:7] + bytes((frame_checksum(frame.arbitration_id, data, 7),))
    )


def test_a_recording_reads_as_cantools_decodes_it(read):
    frames = recording(seconds=40.0, seed=11)
    lines = of_frames(read(frames))
    for line, (_, frame) in zip(lines, frames, strict=True):
        assert line.lost == 0
        assert_same(line, frame)
    said = [value for line in lines for value in line.values]
    codes = {value for value in said if value.isidentifier()}
    assert codes == {"error", "not_available", "none"}
    assert sum(value not in codes for value in said) > 0.6 * len(said)
    assert {line.message for line in lines} == {message.name for message in READ}


def test_any_payload_reads_as_cantools_decodes_it_and_reserved_codes_are_no_values(read):
    rng = np.random.default_rng(12)
    frames = []
    for message in READ:
        for i in range(100):
            data = bytearray(rng.bytes(8))
            data[6] = data[6] & 0x0F | i % 16 << 4
            frames.append((0.0, corrected(Frame(message.frame_id, True, b""), bytes(data))))
    lines = of_frames(read(frames))
    for line, (_, frame) in zip(lines, frames, strict=True):
        assert_same(line, frame)
    assert "reserved" in {value for line in lines for value in line.values}


@pytest.mark.parametrize("message", MESSAGES)
def test_every_wrong_bit_is_a_wrong_checksum(message, read):
    good = Publisher(DATABASE).frame(message.name, {})
    bits = int.from_bytes(good.data, "little")
    bad = [Frame(good.arbitration_id, True, (bits ^ 1 << bit).to_bytes(8, "little")) for bit in range(64)]
    assert read((0.0, frame) for frame in bad) == [Line(message.name, "wrong_checksum")] * 64


def test_a_frame_relayed_under_another_identifier_is_a_wrong_checksum(read):
    relayed = [
        Frame(other.frame_id, True, Publisher(DATABASE).frame(message.name, {}).data)
        for message in DATABASE.messages
        for other in READ
        if other is not message
    ]
    assert {line.verdict for line in read((0.0, frame) for frame in relayed)} == {"wrong_checksum"}


@pytest.mark.parametrize("message", MESSAGES)
def test_a_stuck_counter_is_refused_and_its_message_goes_stale(message, read):
    cycle = message.cycle_time / 1000.0
    stuck = [Publisher(DATABASE).frame(message.name, {})] * 7
    lines = of_frames(read((i * cycle, each) for i, each in enumerate(stuck)))
    assert [line.verdict for line in lines] == ["good", *["repeated"] * 3, "stale", *["repeated"] * 3]
    assert {line.message for line in lines} == {message.name}


@pytest.mark.parametrize("message", MESSAGES)
def test_the_same_counter_with_another_payload_is_a_second_sender(message, read):
    one, two = (Publisher(DATABASE).frame(message.name, {}) for _ in range(2))
    other = corrected(two, bytes((two.data[0] ^ 1,)) + two.data[1:])
    assert [line.verdict for line in of_frames(read([(0.0, one), (0.01, other)]))] == ["good", "second_sender"]


@pytest.mark.parametrize("jump", range(1, 16))
def test_a_jump_of_the_counter_tells_how_many_frames_were_lost(jump, read):
    publisher = Publisher(DATABASE)
    sent = [publisher.frame("TractionLimits", {}) for _ in range(20 + jump)]
    heard = [*sent[:13], *sent[12 + jump :]]
    lines = read((0.1 * i, frame) for i, frame in enumerate(heard))
    assert [line.lost for line in lines] == [*[0] * 13, jump - 1, *[0] * 7]


def test_bad_frames_neither_refresh_nor_count(read):
    publisher = Publisher(DATABASE)
    one, two = (publisher.frame("Traversability", {"State": "go"}) for _ in range(2))
    short = Frame(one.arbitration_id, True, two.data[:7])
    empty = Frame(one.arbitration_id, True, b"")
    wrong = Frame(one.arbitration_id, True, two.data[:7] + bytes((two.data[7] ^ 1,)))
    lines = of_frames(read([(0.0, one), (0.1, short), (0.2, empty), (0.3, wrong), (0.31, wrong), (0.4, two)]))
    assert [(line.verdict, line.lost) for line in lines] == [
        ("good", 0), ("wrong_length", None), ("wrong_length", None), ("wrong_checksum", None),
        ("stale", None), ("wrong_checksum", None), ("good", 0),
    ]  # fmt: skip


def test_silence_of_three_cycles_is_stale_once(read):
    frames = recording(seconds=1.0, seed=13)[: len(READ)]
    fast = {message.name for message in READ if message.cycle_time == 100}
    foreign = Frame(0x7FF, False, b"")
    lines = of_frames(read([*frames, *((t, foreign) for t in (0.3, 0.301, 2.0, 3.0, 3.001, 60.0))]))
    after = lines[len(frames) :]
    breaks = [i for i, line in enumerate(after) if line == Line("-", "foreign")]
    between = [{line.message for line in after[a + 1 : b]} for a, b in zip([-1, *breaks], breaks, strict=False)]
    everything = {message.name for message in READ}
    assert between == [set(), fast, set(), set(), everything - fast, set()]
    assert {line.verdict for line in after} == {"stale", "foreign"}


def test_other_identifiers_are_foreign(read):
    frame = Publisher(DATABASE).frame("Traversability", {"State": "go"})
    others = [Frame(frame.arbitration_id ^ 1, True, frame.data), Frame(0x49A, False, frame.data)]
    assert read((0.0, other) for other in others) == [Line("-", "foreign")] * 2


def test_the_reader_has_all_the_c_of_the_page():
    text = (REPO / "tests" / "dbc" / "reader.c").read_text(encoding="utf-8")
    *of_rules, program = re.findall(r"```c\n(.*?)```", PAGE, re.S)
    (of_layouts,) = re.findall(r"```c max_draft\n(.*?)```", PAGE, re.S)
    assert "int main" in program
    assert all(block in text for block in (*of_rules, of_layouts))
    steps = [of_layouts.index(word) for word in ("_unpack(", "_is_in_range(", "_decode(")]
    assert steps == sorted(steps)


def test_the_reader_shows_the_verdict_by_the_rules(read):
    log = (DBC / "sample.log").read_text()
    frames = [(m.timestamp, Frame(m.arbitration_id, True, bytes(m.data))) for m in can.CanutilsLogReader(StringIO(log))]
    shown = [line.verdict for line in read(frames) if line.message == "verdict"]
    assert shown[:3] == ["caution", "go", "caution"]
    assert "no_go" in shown
