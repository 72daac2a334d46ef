"""The column decoder against cantools, bit for bit."""

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from cantools.database.errors import DecodeError
from hypothesis import given
from hypothesis import strategies as st

from soilbus.can.dbc_files import load_databases
from soilbus.can.decode import ColumnDecoder
from soilbus.config.file import load_config
from soilbus.offline.replay import read_frames

FIELD = Path(__file__).resolve().parents[1] / "field/field.toml"

SCALES = st.one_of(
    st.sampled_from([1, 1.0, 2, 3, -1, -2.0, 0.1, 0.001, 0.05, 1e-9, -0.25, 10**10, 2**40, 1 / 3]),
    st.floats(-1e6, 1e6, allow_nan=False).filter(bool),
)
OFFSETS = st.one_of(
    st.sampled_from([0, 0.0, 1, -40, -1600.0, 0.5, -273.15, 10**12, 2**62]), st.floats(-1e6, 1e6, allow_nan=False)
)


@st.composite
def signals_of(draw: st.DrawFn, length: int, order: str, first: int, last: int) -> list[dict[str, Any]]:
    """Layouts of signals of one byte order in bits first..last (counted in that order)."""
    found: list[dict[str, Any]] = []
    bit = first
    while bit < last and len(found) < 8:
        bit += draw(st.sampled_from([0, 0, 0, 1, 3, 8]))
        is_float = draw(st.integers(0, 5)) == 0
        size = draw(st.sampled_from([16, 32, 64])) if is_float else draw(st.sampled_from([8, 16, 32, *range(1, 65)]))
        if bit + size > last:
            break
        found.append({"bit": bit, "length": size, "order": order, "is_float": is_float})
        bit += size
    return found


@st.composite
def messages(draw: st.DrawFn) -> Message:
    """Messages without overlaps: little-endian signals in the first bytes, big-endian ones behind."""
    length = draw(st.sampled_from([1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 64]))
    border = 8 * draw(st.integers(0, length))
    layouts = draw(signals_of(length, "little_endian", 0, border))
    layouts += draw(signals_of(length, "big_endian", border, 8 * length))
    signals = []
    for i, layout in enumerate(layouts):
        bit, big = layout["bit"], layout["order"] == "big_endian"
        choices = draw(st.sampled_from([None, {0: "zero", 3: "three"}]))
        signals.append(
            Signal(
                name=f"S{i}",
                start=8 * (bit // 8) + 7 - bit % 8 if big else bit,
                length=layout["length"],
                byte_order=layout["order"],
                is_signed=draw(st.booleans()),
                conversion=BaseConversion.factory(draw(SCALES), draw(OFFSETS), choices, layout["is_float"]),
            )
        )
    extended = draw(st.booleans())
    identifier = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    return Message(identifier, "M", length, signals, is_extended_frame=extended, is_fd=length > 8, strict=True)


def payloads(length: int) -> st.SearchStrategy[list[bytes]]:
    edges = [bytes(length), b"\xff" * length, b"\x80" + bytes(length - 1), bytes(length - 1) + b"\x80"]
    row = st.one_of(st.sampled_from(edges), st.binary(min_size=length, max_size=length))
    return st.lists(row, min_size=1, max_size=6)


def as_column(rows: list[bytes], length: int) -> np.ndarray:
    return np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(-1, length)


def same(ours: Any, theirs: int | float) -> bool:
    """The same number as a 64-bit float, to the bit; any nan equals any other.

    Products of integers beyond 2^53, which no 64-bit float tells apart, may be rounded twice.
    """
    if abs(theirs) > 2**53 and isinstance(theirs, int):
        return math.isclose(ours, theirs, rel_tol=2.0**-51)
    both_nan = ours != ours and theirs != theirs
    return both_nan or struct.pack(">d", ours) == struct.pack(">d", theirs)


def assert_equal_to_cantools(message: Message, rows: list[bytes]) -> None:
    decoder = ColumnDecoder(message, [s.name for s in message.signals])
    columns = decoder.columns(as_column(rows, message.length))
    for i, row in enumerate(rows):
        try:
            physical = message.decode(row, decode_choices=False)
            raw = message.decode(row, decode_choices=False, scaling=False)
        except DecodeError:  # cantools refuses a multiplexer code without signals
            continue
        for name, column in columns.items():
            assert (column.present is None or column.present[i]) == (name in physical), (name, row)
            if name in physical:
                ours = column.physical[i : i + 1].tolist()[0]
                assert same(ours, physical[name]), (name, row, ours, physical[name])
                assert same(column.raw[i : i + 1].tolist()[0], raw[name]), (name, row)


@given(st.data())
def test_equals_cantools(data: st.DataObject) -> None:
    message = data.draw(messages())
    assert_equal_to_cantools(message, data.draw(payloads(message.length)))


def signal(name: str, start: int, length: int, **more: Any) -> Signal:
    conversion = BaseConversion.factory(more.pop("scale", 1), more.pop("offset", 0), None, more.pop("is_float", False))
    return Signal(name, start, length, conversion=conversion, **more)


@given(st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=8))
def test_nested_multiplexers_equal_cantools(rows: list[bytes]) -> None:
    outer = {"multiplexer_signal": "Outer"}
    inner = {"multiplexer_signal": "Inner", "is_signed": True, "scale": 0.1}
    message = Message(
        1,
        "M",
        8,
        [
            signal("Outer", 0, 1, is_multiplexer=True),
            signal("Always", 1, 7, scale=0.5),
            signal("A", 8, 12, multiplexer_ids=[0], **outer),
            signal("Inner", 8, 2, is_multiplexer=True, multiplexer_ids=[1], **outer),
            signal("B0", 16, 16, multiplexer_ids=[0, 1], **inner),
            signal("B2", 16, 16, multiplexer_ids=[2], **inner),
        ],
    )
    assert_equal_to_cantools(message, rows)


@pytest.mark.parametrize(("order", "start"), [("little_endian", 32), ("big_endian", 39)])
@pytest.mark.parametrize("length", [8, 16, 13, 32])
@pytest.mark.parametrize("others", [{"scale": 0.1}, {"scale": 2}, {"offset": 7}, {"scale": -2, "offset": 0.3}])
def test_signals_that_take_turns_in_the_same_place_have_each_its_own_scale(order, start, length, others) -> None:
    pages = [
        signal(f"S{i}", start, length, byte_order=order, multiplexer_ids=[i], multiplexer_signal="Page", **scale)
        for i, scale in enumerate(({"scale": 0.5}, others, {}))
    ]
    message = Message(0x100, "M", 8, [signal("Page", 0, 8, is_multiplexer=True), *pages])
    assert_equal_to_cantools(message, [bytes([page, 0, 0, 0, 249, 18, 52, 86]) for page in range(3)])


def test_scaled_multiplexer_selects_by_its_physical_value() -> None:
    mux = signal("Mux", 0, 4, scale=2, is_multiplexer=True)
    child = signal("Child", 8, 8, multiplexer_ids=[4], multiplexer_signal="Mux")
    message = Message(1, "M", 2, [mux, child])
    assert_equal_to_cantools(message, [b"\x02\x11", b"\x04\x11"])
    payload = as_column([b"\x02\x11", b"\x04\x11"], 2)
    present = ColumnDecoder(message, ["Child"]).columns(payload)["Child"].present
    assert present.tolist() == [True, False]


def test_integers_beyond_64_bits() -> None:
    message = Message(1, "M", 8, [signal("Wide", 0, 64, scale=10**6, offset=7)])
    assert_equal_to_cantools(message, [b"\xff" * 8])


def test_no_frames() -> None:
    message = Message(1, "M", 3, [signal("S", 3, 9), signal("F", 12, 8)])
    columns = ColumnDecoder(message, ["S", "F"]).columns(np.empty((0, 3), dtype=np.uint8))
    assert [len(c.physical) for c in columns.values()] == [0, 0]


def test_rows_out_of_a_larger_array() -> None:
    message = Message(1, "M", 8, [signal("S", 0, 16), signal("T", 19, 9)])
    large = np.arange(256, dtype=np.uint8).reshape(-1, 16)
    ours = ColumnDecoder(message, ["S", "T"]).columns(large[::2, 3:11])
    for i, row in enumerate(large[::2, 3:11]):
        assert {k: int(v.physical[i]) for k, v in ours.items()} == message.decode(row.tobytes())


def test_signals_that_cannot_be_cut_out() -> None:
    long = Message(1, "M", 64, [signal("Text", 0, 128)])
    outside = Message(1, "M", 1, [signal("Out", 4, 8)], strict=False)
    with pytest.raises(ValueError, match="longer than 64 bits"):
        ColumnDecoder(long, ["Text"])
    with pytest.raises(ValueError, match="do not lie within 1 bytes"):
        ColumnDecoder(outside, ["Out"])
    with pytest.raises(KeyError):
        ColumnDecoder(long, ["Txet"])


def test_field_recording_equals_cantools(field_recording) -> None:
    database = load_databases(load_config(FIELD))
    rows: dict[int, list[bytes]] = {}
    for _, identifier, _, data, *_ in read_frames(field_recording("clay.log.gz")):
        if len(rows.setdefault(identifier, [])) < 400:
            rows[identifier].append(bytes(data))
    assert len(rows) == 9
    for identifier, frames in rows.items():
        assert_equal_to_cantools(database.get_message_by_frame_id(identifier), frames)
