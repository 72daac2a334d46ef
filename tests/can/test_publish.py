"""Results -> frames: what cannot be sent is never sent as a value, and nothing wraps."""

import math
from pathlib import Path

import cantools
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soilbus.can.publish import Publisher, ValueCodes

DBC = Path(__file__).resolve().parents[2] / "dbc" / "soilbus.dbc"
DATABASE = cantools.database.load_file(DBC)
SENT = [
    (message, signal)
    for message in DATABASE.messages
    for signal in message.signals
    if signal.name not in ("Counter", "Checksum")
]
NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True), st.floats(-2.0, 2.0), st.floats(-1e5, 1e5), st.integers(-300, 300)
)


def decoded(frame):
    return DATABASE.decode_message(frame.arbitration_id, frame.data)


def saturates(signal):
    return "Saturates" in signal.dbc.attributes


@given(st.data())
def test_every_value_comes_back_within_resolution_or_as_a_code(data):
    message, signal = data.draw(st.sampled_from(SENT))
    inside = st.floats(float(signal.minimum), float(signal.maximum))
    value = data.draw(st.one_of(NUMBERS, inside))
    back = decoded(Publisher(DATABASE).frame(message.name, {signal.name: value}))
    got, half = back[signal.name], signal.scale / 2.0 * (1.0 + 1e-9)
    if not math.isfinite(value):
        assert got == "not_available"
    elif signal.minimum <= value <= signal.maximum:
        named = {str(name): code for code, name in (signal.choices or {}).items()}
        number = named[str(got)] * signal.scale + signal.offset if str(got) in named else float(got)
        assert abs(number - value) <= half
    elif value > signal.maximum + half and saturates(signal):
        assert float(got) == pytest.approx(float(signal.maximum))
    elif not signal.minimum - half <= value <= signal.maximum + half:
        assert got == "error"
    others = {k: v for k, v in back.items() if k not in (signal.name, "Counter", "Checksum")}
    assert all(other == "not_available" for other in others.values()), others


@pytest.mark.parametrize("value", [None, math.nan, math.inf, -math.inf, np.float64("nan")])
def test_what_is_no_number_is_not_available(value):
    publisher = Publisher(DATABASE)
    assert all(decoded(publisher.frame(m.name, {s.name: value}))[s.name] == "not_available" for m, s in SENT)


def test_ends_of_the_range_are_values_and_beyond_is_an_error():
    publisher = Publisher(DATABASE)

    def slip(x):
        return decoded(publisher.frame("WheelSlip", {"SlipWheel2": x}))["SlipWheel2"]

    assert slip(1.0) == 1.0
    assert slip(-1.0) == -1.0
    assert slip(1.0002) == 1.0  # rounds to the end
    assert slip(1.0003) == "error"
    assert slip(-1.0003) == "error"
    assert slip(1e300) == "error"
    assert slip(-1e300) == "error"


def test_standard_deviations_stay_at_the_top_but_never_go_below():
    publisher = Publisher(DATABASE)

    def std(x):
        return decoded(publisher.frame("SoilStrength", {"BearingPressureStd": x}))["BearingPressureStd"]

    assert std(1e9) == 3212.0
    assert std(-1.0) == "error"


@pytest.mark.parametrize("message", [m.name for m in DATABASE.messages])
def test_counter_goes_up_by_one_in_each_message_alone(message):
    publisher = Publisher(DATABASE)
    other = next(m.name for m in DATABASE.messages if m.name != message)
    counters = []
    for i in range(100):
        counters.append(decoded(publisher.frame(message, {}))["Counter"])
        if i % 3 == 0:
            publisher.frame(other, {})
    assert counters == [i % 16 for i in range(100)]


def test_a_refused_value_does_not_use_up_a_counter():
    publisher = Publisher(DATABASE)
    with pytest.raises(ValueError, match=r"Traversability\.State: 'maybe' is not in the value table"):
        publisher.frame("Traversability", {"State": "maybe"})
    assert decoded(publisher.frame("Traversability", {}))["Counter"] == 0


def bitwise_crc(data):
    """CRC-8 SAE J1850 by polynomial division, one bit at a time."""
    register = 0xFF
    for byte in data:
        for bit in range(7, -1, -1):
            feedback = (register >> 7) ^ (byte >> bit & 1)
            register = register << 1 & 0xFF ^ (0x1D if feedback else 0)
    return register ^ 0xFF


@given(st.sampled_from(DATABASE.messages), st.lists(st.floats(0.0, 1.0), min_size=1, max_size=8))
def test_checksum_covers_identifier_and_payload(message, values):
    names = [s.name for m, s in SENT if m is message]
    frame = Publisher(DATABASE).frame(message.name, dict(zip(names, values, strict=False)))
    assert frame.extended
    assert frame.arbitration_id == message.frame_id
    assert frame.data[7] == bitwise_crc(frame.arbitration_id.to_bytes(4, "little") + frame.data[:7])


def test_reserved_bits_are_ones():
    data = Publisher(DATABASE).frame("SoilbusStatus", {"State": "starting", "Window": 0}).data
    assert data[0] == 0xF0
    assert data[4] == 0xFF
    assert data[6] & 0x0F == 0x0F


@pytest.mark.parametrize(
    ("message", "values", "error"),
    [
        ("NoSuchFrame", {}, KeyError),
        ("WheelSlip", {"SlipWheel9": 0.1}, KeyError),
        ("WheelSlip", {"Counter": 3}, KeyError),
        ("WheelSlip", {"Checksum": 3}, KeyError),
        ("WheelSlip", {"SlipWheel1": "fast"}, ValueError),
        ("WheelSlip", {"SlipWheel1": [0.1]}, TypeError),
    ],
)
def test_wrong_use_is_an_error(message, values, error):
    with pytest.raises(error):
        Publisher(DATABASE).frame(message, values)


def test_identifiers_are_those_of_the_edited_dbc(tmp_path):
    moved = DBC.read_text(encoding="utf-8").replace(str(0x80000000 | 0x18FF649A), str(0x80000000 | 0x0CFFA021))
    frame = Publisher(cantools.database.load_string(moved, "dbc")).frame("Traversability", {"State": "go"})
    assert frame.arbitration_id == 0x0CFFA021
    assert frame.data[7] == bitwise_crc(bytes.fromhex("21a0ff0c") + frame.data[:7])


FOREIGN = """VERSION ""
BU_: A
BO_ 100 M: 8 A
 SG_ Plain : 7|16@0- (0.05,0) [-1638.4|1638.35] "" A
 SG_ Ranged : 16|16@1+ (1,0) [0|64255] "" A
 SG_ Free : 32|16@1+ (1,0) [0|0] "" A
 SG_ Falling : 48|8@1+ (-1,100) [-50|100] "" A
"""


def test_codes_of_a_foreign_dbc_follow_the_habits_of_the_field():
    message = cantools.database.load_string(FOREIGN, "dbc").messages[0]
    codes = {signal.name: ValueCodes(signal) for signal in message.signals}
    assert codes["Plain"].code(None) == -32768
    assert codes["Plain"].code(-1638.35) == -32767
    assert (codes["Plain"].lowest, codes["Plain"].highest) == (-32767, 32767)
    assert codes["Plain"].code(2000.0) == -32768  # no error code in a signed signal
    assert (codes["Ranged"].code(None), codes["Ranged"].code(64256)) == (65535, 0xFE00)
    assert codes["Free"].code(65534) == 65534
    assert codes["Free"].code(65535) == 65535
    assert (codes["Falling"].code(100), codes["Falling"].code(-50), codes["Falling"].code(None)) == (0, 150, 255)


@given(st.sampled_from(SENT), st.lists(NUMBERS, min_size=1, max_size=20))
def test_columns_and_single_values_get_the_same_codes(sent, values):
    codes = ValueCodes(sent[1])
    column = codes.column(np.array(values, float))
    assert column.tolist() == [codes.code(float(value)) for value in values]
