"""Which codes are values: J1939 bands, value tables, ranges, validity signals."""

import math
from typing import Any

import numpy as np
import pytest
from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion
from hypothesis import given
from hypothesis import strategies as st

from soilbus.can.admission import Admission
from soilbus.can.channels import Channel, Reason
from soilbus.can.decode import SignalColumn
from soilbus.can.validity import CodeRule, in_si, judge_codes, judge_validity, meaning

SPEED_MAX = 64.255
NA, ERROR, RESERVED, OUT = Reason.NOT_AVAILABLE, Reason.ERROR, Reason.RESERVED, Reason.OUT_OF_RANGE


def signal(length: int = 16, **more: Any) -> Signal:
    conversion = BaseConversion.factory(
        more.pop("scale", 1), more.pop("offset", 0), more.pop("choices", None), more.pop("is_float", False)
    )
    return Signal("S", 0, length, conversion=conversion, **more)


def verdicts(s: Signal, codes: list[Any]) -> list[Reason | None]:
    raw = np.array(codes)
    physical = np.array([s.conversion.raw_to_scaled(c, False) for c in codes])
    return reasons(judge_codes(CodeRule(s), raw, physical))


def reasons(verdict: Any) -> list[Reason | None]:
    return [[*Reason][v - 1] if v else None for v in verdict.tolist()]


@pytest.mark.parametrize(
    ("s", "expected"),
    [
        (
            signal(16, scale=0.001, minimum=0, maximum=SPEED_MAX),
            {0: None, 0xFAFF: None, 0xFB00: RESERVED, 0xFDFF: RESERVED, 0xFE00: ERROR, 0xFF00: NA, 0xFFFF: NA},
        ),
        (signal(8, scale=0.4, minimum=0, maximum=100), {250: None, 251: RESERVED, 253: RESERVED, 254: ERROR, 255: NA}),
        (
            signal(32, scale=0.001, minimum=0, maximum=4211081.215),
            {0xFAFFFFFF: None, 0xFB000000: RESERVED, 0xFE123456: ERROR, 0xFF000000: NA},
        ),
        (signal(16, minimum=0, maximum=1000), {1000: None, 1001: OUT, 0xFAFF: OUT, 0xFB00: RESERVED, 0xFFFF: NA}),
        (signal(2, minimum=0, maximum=1), {1: None, 2: ERROR, 3: NA}),
        (signal(2, minimum=0, maximum=3), {2: None, 3: None}),
        (signal(4, minimum=0, maximum=13), {13: None, 14: ERROR, 15: NA}),
        (signal(12, minimum=0, maximum=4000), {4000: None, 4001: OUT, 4095: NA}),
        # whole range: the last code alone is no value
        (signal(16, minimum=0, maximum=65535), {0xFE00: None, 0xFFFE: None, 0xFFFF: NA}),
        (signal(16), {0xFE00: None, 0xFFFF: NA}),
        (signal(7), {127: None}),
        (signal(64), {2**64 - 2: None, 2**64 - 1: NA}),
        (signal(16, is_signed=True), {-32768: NA, -32767: None, 32766: None, 32767: Reason.SATURATED}),
        (signal(16, is_signed=True, minimum=-9, maximum=9), {-32768: NA, -10: OUT, 10: OUT, 32767: Reason.SATURATED}),
        # 4095.8 is 4095.875 as printed: no code is lost to rounding
        (signal(16, is_signed=True, scale=0.125, minimum=-4096, maximum=4095.8), {32766: None, -32767: None}),
        (signal(16, scale=0.125, minimum=0, maximum=100.1), {801: None, 802: OUT}),
        (signal(16, scale=-0.5, offset=10, minimum=-10, maximum=10), {0: None, 40: None, 41: OUT, 0xFFFF: NA}),
        (signal(8, minimum=0, maximum=0), {0: None, 254: None, 255: NA}),
        (signal(8, choices={7: "SNA", 8: "Error", 9: "Ok"}), {6: None, 7: NA, 8: ERROR, 9: None}),
        (signal(32, is_float=True, minimum=0, maximum=0.1), {0.1: None, float(np.float32(0.1)): None, 0.11: OUT}),
        (signal(32, is_float=True, maximum=1), {-1e30: None, math.nan: Reason.NOT_FINITE, math.inf: Reason.NOT_FINITE}),
    ],
)
def test_codes(s: Signal, expected: dict[Any, Reason | None]) -> None:
    assert verdicts(s, list(expected)) == list(expected.values())


@pytest.mark.parametrize("limits", [{}, {"minimum": 0, "maximum": 0}, {"minimum": -125, "maximum": 2**32}])
@pytest.mark.parametrize(
    ("length", "expected"),
    [
        (8, {250: None, 251: RESERVED, 254: ERROR, 255: NA}),
        (16, {0xFAFF: None, 0xFB00: RESERVED, 0xFE00: ERROR, 0xFF00: NA}),
        (32, {0xFAFFFFFF: None, 0xFB000000: RESERVED, 0xFE000000: ERROR, 0xFF000000: NA}),
    ],
)
def test_top_codes_of_a_standard_group_are_no_values_whatever_range_the_dbc_has(limits, length, expected) -> None:
    """Engine torque of 129 %, in a DBC without ranges, is the code of an error."""
    channel = Channel("torque", "FL", "Eec1", "Torque", 1.0, 0.0, -math.inf, math.inf)
    torque = signal(length, offset=-125, **limits)
    torque.name = "Torque"
    message = Message(0x0CF00400, "Eec1", 8, [torque], is_extended_frame=True)
    database = Database([message])
    for code, reason in expected.items():
        admission = Admission([channel], database)
        admission.feed(0.0, message.frame_id, True, code.to_bytes(length // 8, "little").ljust(8, b"\0"))
        out = admission.take()
        assert len(out.columns["torque.FL"].t) == (reason is None)
        assert {why for _, why in out.refused} == ({reason} if reason else set())


@given(
    st.sampled_from([8, 12, 16, 24, 32]),
    st.booleans(),
    st.sampled_from([1, 0.1, 0.001, 0.125, -0.4, 1 / 3]),
    st.sampled_from([0, -40, 0.7]),
    st.data(),
)
def test_range_of_codes_is_kept_exactly(
    length: int, is_signed: bool, scale: float, offset: float, data: st.DataObject
) -> None:
    """Limits that are codes themselves: each code is admitted if and only if it lies between them."""
    first, last = (-(1 << length - 1), (1 << length - 1) - 1) if is_signed else (0, (1 << length) - 1)
    a, b, code = (data.draw(st.integers(first + 1, last - 1)) for _ in range(3))
    low, high = min(a, b), max(a, b)
    limits = sorted((low * scale + offset, high * scale + offset))
    if limits[0] == limits[1] == 0:
        return
    s = signal(length, is_signed=is_signed, scale=scale, offset=offset, minimum=limits[0], maximum=limits[1])
    for c in (low - 1, low, code, high, high + 1):
        assert (verdicts(s, [c])[0] is None) == (low <= c <= high), c


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("SNA", NA),
        ("Not available", NA),
        ("NotAvailable", NA),
        ("Signal_Not_Available", NA),
        ("n/a", NA),
        ("Not Installed", NA),
        ("Error", ERROR),
        ("Sensor_Error", ERROR),
        ("INVALID", ERROR),
        ("Fault", ERROR),
        ("Reserved", RESERVED),
        ("No error", None),
        ("NoFault", None),
        ("Error free", None),
        ("Valid", None),
        ("Available", None),
        ("Snail pace", None),
        ("Forward", None),
        ("Terror", None),
    ],
)
def test_names_of_codes(name: str, reason: Reason | None) -> None:
    assert meaning(name) is reason


def channel(**more: Any) -> Channel:
    values: dict[str, Any] = {"factor": 1.0, "offset": 0.0, "low": -math.inf, "high": math.inf} | more
    return Channel(quantity="draft", wheel="", message="M", signal="S", **values)


@pytest.mark.parametrize(
    ("length", "valid_values", "expected"),
    [
        (2, (1,), {0: Reason.NOT_VALID, 1: None, 2: ERROR, 3: NA}),
        (2, (1, 2), {1: None, 2: None, 3: NA}),
        (4, (3,), {3: None, 4: Reason.NOT_VALID, 14: ERROR, 15: NA}),
        (1, (1,), {0: Reason.NOT_VALID, 1: None}),
        (3, (1,), {7: Reason.NOT_VALID}),
    ],
)
def test_validity_signal(length: int, valid_values: tuple[int, ...], expected: dict[int, Reason | None]) -> None:
    raw = np.array(list(expected))
    verdict = judge_validity(
        channel(valid_signal="V", valid_values=valid_values), length, False, SignalColumn(raw, raw, None)
    )
    assert reasons(verdict) == list(expected.values())


def test_absent_validity_signal_vouches_for_nothing() -> None:
    raw = np.array([1, 1])
    column = SignalColumn(raw, raw, np.array([True, False]))
    verdict = judge_validity(channel(valid_signal="V", valid_values=(1,)), 2, False, column)
    assert reasons(verdict) == [None, Reason.NOT_VALID]


def test_implausible_only_where_nothing_else_is_wrong() -> None:
    verdict = np.zeros(4, dtype=np.uint8)
    verdict[3] = [*Reason].index(ERROR) + 1
    value = in_si(channel(factor=2.0, offset=1.0, low=0.0, high=5.0), np.array([0, 2, 3, 300]), verdict)
    assert value.tolist() == [1.0, 5.0, 7.0, 601.0]
    assert reasons(verdict) == [None, None, Reason.IMPLAUSIBLE, ERROR]
