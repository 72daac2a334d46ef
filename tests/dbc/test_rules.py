"""The rules that every signal of our DBC files keeps, and that other tools read them as we do."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import cantools
import numpy as np
import pytest
from cantools.database.can.c_source import camel_to_snake_case

DBC = Path(__file__).resolve().parents[2] / "dbc"
FILES = ("soilbus", "tractor", "axles")
WHOLE_RANGE = {"Counter", "Checksum"}  # protocol, not values


def load(name):
    return cantools.database.load_file(DBC / f"{name}.dbc", strict=True)


SIGNALS = [
    pytest.param(message, signal, id=f"{name}-{message.name}-{signal.name}")
    for name in FILES
    for message in load(name).messages
    for signal in message.signals
]


def codes_of_width(bits):
    """Greatest value, error and not-available code by the J1939-71 rule."""
    if bits >= 8:
        rest = bits - 8
        return (0xFB << rest) - 1, (0xFF << rest) - 1, (1 << bits) - 1
    return (1 << bits) - 3, (1 << bits) - 2, (1 << bits) - 1


def test_j1939_codes_of_common_widths():
    assert codes_of_width(16) == (0xFAFF, 0xFEFF, 0xFFFF)
    assert codes_of_width(8) == (0xFA, 0xFE, 0xFF)
    assert codes_of_width(2) == (1, 2, 3)


@pytest.mark.parametrize(("message", "signal"), SIGNALS)
def test_a_signal_starts_not_available_with_unit_and_comment_and_its_top_codes_are_named(message, signal):
    assert signal.raw_initial == (1 << signal.length) - 1
    assert signal.comment
    assert len(signal.comment) > 10
    if signal.unit:  # a physical value says which way is positive, or that it has no sign
        assert re.search(r"positive|negative", signal.comment), signal.comment
    assert not signal.is_signed
    assert not signal.is_float
    assert signal.minimum is not None
    assert signal.maximum is not None
    if signal.name in WHOLE_RANGE:
        assert (signal.minimum, signal.maximum) == (0, (1 << signal.length) - 1)
        return
    greatest, error, not_available = codes_of_width(signal.length)
    assert (signal.maximum - signal.offset) / signal.scale <= greatest + 1e-6
    assert (signal.minimum - signal.offset) / signal.scale >= -1e-6
    assert signal.choices[error] == "error"
    assert signal.choices[not_available] == "not_available"


@pytest.mark.parametrize("name", FILES)
def test_messages_are_ours_to_send(name):
    database = load(name)
    for message in database.messages:
        assert message.length == 8
        assert message.is_extended_frame
        assert message.comment
        assert message.cycle_time
        assert "VFrameFormat" in message.dbc.attributes
        pgn = message.frame_id >> 8 & 0xFFFF
        assert 0xFF00 <= pgn <= 0xFFFF or (name == "tractor" and pgn in (65097, 65267))


def test_no_identifier_is_used_twice():
    ids = [message.frame_id for name in FILES for message in load(name).messages]
    assert len(ids) == len(set(ids))


def test_generated_struct_members_are_no_words_of_c_or_cpp():
    words = "and auto bool break case catch char class const continue default delete do double else enum explicit "
    words += "export extern false float for friend goto if inline int long namespace new not operator or private "
    words += "protected public register return short signed sizeof static struct switch template this throw true try "
    words += "typedef typename union unsigned using virtual void volatile while xor"
    members = {camel_to_snake_case(s.name) for name in FILES for m in load(name).messages for s in m.signals}
    assert not members & set(words.split())


def test_fast_frames_are_fast_and_all_results_are_protected():
    messages = {message.name: message for message in load("soilbus").messages}
    fast = {name for name, message in messages.items() if message.cycle_time == 100}
    fast_ones = {"WheelSlip", "WheelSlip2", "Traversability", "TorqueDemand", "DemandForecast", "PresentDemand"}
    assert fast == fast_ones
    assert all(message.cycle_time == 1000 for name, message in messages.items() if name not in fast)
    for message in messages.values():
        places = {signal.name: (signal.start, signal.length) for signal in message.signals}
        assert (places["Counter"], places["Checksum"]) == ((52, 4), (56, 8)), message.name


def test_cleared_or_blank_traversability_never_reads_go():
    message = load("soilbus").get_message_by_name("Traversability")
    assert message.decode(bytes(8))["State"] == "unknown"
    assert message.decode(b"\xff" * 8)["State"] == "not_available"


def test_every_known_soil_has_its_code_in_the_order_of_the_table():
    from soilbus.terra.soils import KINDS

    kind = load("soilbus").get_message_by_name("SoilClass").get_signal_by_name("Kind")
    names = {int(code): str(name) for code, name in kind.choices.items()}
    assert names == dict(enumerate(("unknown", *KINDS))) | {254: "error", 255: "not_available"}
    assert kind.maximum == len(KINDS)


def test_soil_ranges_hold_every_known_soil():
    from soilbus.terra.soils import SOILS

    database = load("soilbus")
    in_frame = {
        "SoilCohesiveModulus": lambda s: s.k_c / 1e3,
        "SoilFrictionalModulus": lambda s: s.k_phi / 1e3,
        "SoilSinkageExponent": lambda s: s.n,
        "SoilFrictionAngle": lambda s: np.degrees(s.phi),
        "SoilCohesion": lambda s: s.c / 1e3,
        "SoilShearModulus": lambda s: s.K * 1e3,
    }
    for name, value in in_frame.items():
        signal = database.get_message_by_name(name).get_signal_by_name("Value")
        values = [value(soil) for soil in SOILS.values()]
        assert 2.0 * max(values) <= signal.maximum, name
        if name != "SoilCohesiveModulus":  # which is nothing beside k_phi where it is small
            assert signal.scale <= 0.015 * min(values), name


def c_program(name, database, readme):
    """Reads lines `id payload`, prints every signal's value; its checksum comes from the README."""
    cases = []
    for message in database.messages:
        m = f"{name}_{camel_to_snake_case(message.name)}"
        prints = "".join(
            f'printf(" %.17g %d", {m}_{s}_decode(v.{s}), {m}_{s}_is_in_range(v.{s}));'
            for s in (camel_to_snake_case(x.name) for x in message.signals)
        )
        unpack = f"struct {m}_t v; if ({m}_unpack(&v, data, 8)) return 1;"
        cases.append(f"case 0x{message.frame_id:x}u: {{ {unpack} {prints} break; }}")
    return f"""
#include <stdio.h>
#include "{name}.h"
{readme}
int main(void) {{
    unsigned id, byte;
    uint8_t data[8];
    while (scanf("%x", &id) == 1) {{
        for (int i = 0; i < 8; i++) {{ if (scanf("%x", &byte) != 1) return 1; data[i] = (uint8_t)byte; }}
        printf("%u", (unsigned)soilbus_checksum(id, data));
        switch (id) {{ {" ".join(cases)} default: return 1; }}
        printf("\\n");
    }}
    return 0;
}}
"""


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
@pytest.mark.parametrize("name", ["soilbus", "tractor"])
def test_generated_c_code_compiles_and_decodes_as_cantools(name, tmp_path):
    from soilbus.can.checksum import frame_checksum

    database = load(name)
    generate = [sys.executable, "-m", "cantools", "generate_c_source", str(DBC / f"{name}.dbc")]
    subprocess.run(generate, cwd=tmp_path, check=True, capture_output=True)
    readme = re.search(r"```c\n(.*?)```", (DBC / "README.md").read_text(encoding="utf-8"), re.S)[1]
    (tmp_path / "main.c").write_text(c_program(name, database, readme), encoding="utf-8")
    gcc = ["gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", f"{name}.c", "main.c", "-o", "decode"]
    subprocess.run(gcc, cwd=tmp_path, check=True)

    rng = np.random.default_rng(5)
    cases = [(message, rng.bytes(8)) for message in database.messages for _ in range(20)]
    lines = "".join(f"{message.frame_id:x} {data.hex(' ')}\n" for message, data in cases)
    output = subprocess.run([tmp_path / "decode"], input=lines, text=True, capture_output=True, check=True).stdout
    for (message, data), line in zip(cases, output.splitlines(), strict=True):
        crc, *said = line.split()
        values, in_range = said[::2], said[1::2]
        assert int(crc) == frame_checksum(message.frame_id, data, 7)
        expected = message.decode(data, decode_choices=False)
        raw = message.decode(data, decode_choices=False, scaling=False)
        for signal, value, is_value in zip(message.signals, values, in_range, strict=True):
            ends = (round((end - signal.offset) / signal.scale) for end in (signal.minimum, signal.maximum))
            low, high = sorted(ends)
            assert (is_value == "1") == (low <= raw[signal.name] <= high), signal.name
            assert float(value) == pytest.approx(expected[signal.name], rel=1e-12, abs=1e-12), signal.name


def test_every_reason_of_a_refusal_has_its_code():
    from soilbus.can.channels import Reason

    of_window = load("soilbus").get_message_by_name("WindowQuality").get_signal_by_name("RejectedReason")
    names = [str(of_window.choices[code]) for code in range(int(of_window.maximum) + 1)]
    of_reason = {
        Reason.NOT_AVAILABLE: "no_value", Reason.ERROR: "sensor_error", Reason.SECOND_SENDER: "bad_counter"
    }  # fmt: skip
    assert names == ["none", *dict.fromkeys(of_reason.get(reason, str(reason)) for reason in Reason), "outlier"]
    assert set(of_window.choices) == {*range(len(names)), 254, 255}
