"""The one-go judgement of plain batches against the detailed one."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any
from unittest import mock

import numpy as np
import pytest
from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion
from hypothesis import given
from hypothesis import strategies as st

from soilbus.can.admission import Admission
from soilbus.can.channels import Channel, Decoded
from soilbus.can.inbox import Inbox, inbox_of

LENGTH = 8


def signal(name: str, start: int, length: int, **more: Any) -> Signal:
    conversion = BaseConversion.factory(
        more.pop("scale", 1), more.pop("offset", 0), more.pop("choices", None), more.pop("is_float", False)
    )
    return Signal(name, start, length, conversion=conversion, **more)


def channel(name: str, **more: Any) -> Channel:
    limits = {"factor": 1.0, "offset": 0.0, "low": -1e9, "high": 1e9} | more
    return Channel(quantity=name, wheel="", message="M", signal=name, **limits)


def message(signals: list[Signal]) -> Message:
    return Message(1, "M", LENGTH, signals)


def inbox(signals: list[Signal], channels: list[Channel]) -> Inbox:
    return inbox_of(message(signals), channels, is_open=False, checked=False)


def taken(signals: list[Signal], channels: list[Channel], payloads: list[bytes], detailed: bool = False) -> Decoded:
    """What an admission makes of the payloads; detailed: without the short way."""
    with mock.patch("soilbus.can.inbox.plain_plan", return_value=None) if detailed else nullcontext():
        a = Admission(channels, Database([message(signals)]))
    for i, payload in enumerate(payloads):
        a.feed(0.01 * i, 1, False, payload)
    return a.take()


def assert_same(ours: Decoded, peer: Decoded) -> None:
    assert ours.columns.keys() == peer.columns.keys()
    for name, column in peer.columns.items():
        assert ours.columns[name].t.tobytes() == column.t.tobytes()
        assert ours.columns[name].value.tobytes() == column.value.tobytes()
        assert ours.columns[name].value.dtype == column.value.dtype
    assert {k: t.tolist() for k, t in ours.refused.items()} == {k: t.tolist() for k, t in peer.refused.items()}


@st.composite
def cases(draw: st.DrawFn) -> tuple[list[Signal], list[Channel]]:
    """Up to three signals in a row, aligned or not, each with its own scaling, limits and named codes."""
    start = draw(st.sampled_from([0, 0, 3]))
    signals: list[Signal] = []
    channels: list[Channel] = []
    for i in range(draw(st.integers(1, 3))):
        length = draw(st.sampled_from([2, 7, 8, 12, 16]))
        minimum = draw(st.none() | st.integers(-200, 100))
        s = signal(
            f"S{i}", start, length, is_signed=draw(st.booleans()),
            scale=draw(st.sampled_from([1, 2, -1, 0.25, -0.1])), offset=draw(st.sampled_from([0, -40, 1.5])),
            minimum=minimum, maximum=draw(st.none() | st.integers(101, 40000)),
            choices=draw(st.none() | st.just({1: "Error", 5: "Active", 9: "SNA"})),
        )  # fmt: skip
        start += length
        signals.append(s)
        channels.append(
            channel(
                s.name,
                factor=draw(st.sampled_from([1.0, 1 / 3, -2.0])),
                offset=draw(st.sampled_from([0.0, 0.7])),
                low=draw(st.sampled_from([-1e9, -30.0, 0.0])),
                high=draw(st.sampled_from([1e9, 50.0, 7000.0])),
            )
        )
    signals.append(signal("V", 56, 3))
    if draw(st.booleans()):
        values = tuple(draw(st.sets(st.integers(0, 7), min_size=1, max_size=4)))
        first = channels[0]
        channels[0] = channel(
            first.signal, factor=first.factor, offset=first.offset, low=first.low, high=first.high,
            valid_signal="V", valid_values=values,
        )  # fmt: skip
    return signals, channels


@given(cases(), st.data())
def test_samples_equal_those_judged_one_channel_at_a_time(
    case: tuple[list[Signal], list[Channel]], data: st.DataObject
) -> None:
    # few different codes, so that whole batches of good ones occur
    byte = st.sampled_from(data.draw(st.lists(st.integers(0, 255), min_size=1, max_size=4)))
    payloads = data.draw(st.lists(st.lists(byte, min_size=LENGTH, max_size=LENGTH).map(bytes), min_size=1, max_size=6))
    assert_same(taken(*case, payloads), taken(*case, payloads, detailed=True))


@pytest.mark.parametrize(
    ("length", "more", "limits"),
    [
        (16, {"scale": 0.1, "offset": -40}, {}),
        (16, {"is_signed": True, "scale": -0.5}, {"low": -100.0, "high": 3000.25}),
        (8, {"minimum": 10, "maximum": 90}, {"factor": -1.0, "low": -80.0}),
        (12, {"choices": {100: "Error", 4000: "Not available"}}, {"high": 5000.0}),
        (8, {}, {"low": 300.0}),
    ],
)
def test_plain_codes_are_the_longest_run_of_admitted_ones(
    length: int, more: dict[str, Any], limits: dict[str, float]
) -> None:
    case = [signal("S", 0, length, **more)], [channel("S", **limits)]
    plan, decoder = inbox(*case).plain, inbox(*case).decoder
    payloads = [code.to_bytes(LENGTH, "little") for code in range(1 << length)]
    raw = decoder.raw(np.frombuffer(b"".join(payloads), np.uint8).reshape(-1, LENGTH))["S"]
    admitted = set(raw[np.round(taken(*case, payloads, detailed=True).columns["S"].t * 100).astype(int)].tolist())
    runs = [[c] for c in admitted if c - 1 not in admitted]
    for run in runs:
        while run[-1] + 1 in admitted:
            run.append(run[-1] + 1)
    if plan is None:
        assert not admitted
        return
    low, span = int(plan.blocks[0].low[0, 0]), int(plan.blocks[0].span[0, 0])
    assert list(range(low, low + span + 1)) == max(runs, key=len)


def test_good_batches_take_the_short_way() -> None:
    box = inbox([signal("S", 0, 16), signal("T", 32, 16)], [channel("S"), channel("T", factor=2.0)])
    plan = box.plain
    assert plan is not None
    blocks = box.decoder.blocks(np.array([[1, 0, 0xFF, 0xFF, 2, 0, 0xFF, 0xFF]], np.uint8))
    samples = plan.samples(blocks)
    assert samples is not None
    assert {name: v.tolist() for name, v in samples.items()} == {"S": [1.0], "T": [4.0]}
    assert plan.samples(box.decoder.blocks(np.full((1, LENGTH), 0xFF, np.uint8))) is None


def test_floats_and_multiplexed_signals_have_no_short_way() -> None:
    real = signal("F", 0, 32, is_float=True, is_signed=True)
    assert inbox([real], [channel("F")]).plain is None
    selector = Signal("Mux", 0, 8, is_multiplexer=True)
    child = Signal("Child", 8, 8, multiplexer_ids=[1], multiplexer_signal="Mux")
    assert inbox([selector, child], [channel("Child")]).plain is None
