"""dbc/README.md, for the maker of a dashboard, says what the DBC and the service say."""

import re
from collections.abc import Iterator
from pathlib import Path

import cantools
import pytest

from soilbus.can.dbc_files import load_databases
from soilbus.can.publish import Publisher, ValueCodes
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.reference import reference_configuration

DBC = Path(__file__).resolve().parents[2] / "dbc"
TEXT = (DBC / "README.md").read_text(encoding="utf-8")
DATABASE = cantools.database.load_file(DBC / "soilbus.dbc", strict=True)
MESSAGES = {message.name: message for message in DATABASE.messages}
SIGNALS = {signal.name for message in DATABASE.messages for signal in message.signals}
PROTOCOL = ("Counter", "Checksum")


def rows(first_heading: str) -> Iterator[list[str]]:
    """Cells of the rows of the table whose first column has that heading, one table after the other."""
    for table in re.findall(rf"^ *\| {re.escape(first_heading)} \|.*\n(?: *\|.*\n)+", TEXT, re.M):
        for line in table.splitlines()[2:]:
            yield [cell.strip() for cell in line.strip().strip("|").split("|")]


def names_in(cell: str) -> list[str]:
    return re.findall(r"`(\w+)`", cell)


SENT = [row for row in rows("frame") if len(row) == 4]
TRUST = [row for row in rows("frame") if len(row) == 3]


def test_the_frames_are_those_of_the_dbc_with_identifier_and_cycle():
    cycle = {"1 s": 1000, "100 ms": 100, "hop": 1000}
    said = [(*names_in(name), int(number, 16), cycle[every]) for name, number, every, _ in SENT]
    assert said == [(m.name, m.frame_id, m.cycle_time) for m in sorted(MESSAGES.values(), key=lambda m: m.frame_id)]
    assert reference_configuration().estimator.hop == 1.0
    each_hop = {name for row in SENT if row[2] == "hop" for name in names_in(row[0])}
    assert each_hop == {name for name, m in MESSAGES.items() if "Each hop." in m.comment}


def test_each_frame_says_once_when_to_trust_it_and_what_to_do_when_it_stops():
    said = [name for row in TRUST for name in names_in(row[0])]
    assert sorted(said) == sorted(MESSAGES)
    assert all(trust and otherwise for _, trust, otherwise in TRUST)


def test_trust_by_status_is_asked_for_where_a_frame_has_a_status():
    for names, trust, _ in TRUST:
        for name in names_in(names):
            has_status = any(signal.name == "Status" for signal in MESSAGES[name].signals)
            assert ("`Status`" in trust) == has_status, name


def test_every_name_in_the_page_is_one_of_the_dbc():
    names = set(re.findall(r"`([A-Z][a-z]\w+)`", TEXT)) - {"GenMsgCycleTime", "Saturates"}
    of_tractor = {message.name for message in cantools.database.load_file(DBC / "tractor.dbc", strict=True).messages}
    known = SIGNALS | set(MESSAGES) | of_tractor
    assert names <= known, names - known
    assert {"TractionAdvice", "TractionLimits", "DemandForecast", "SoilClass", "Kind", "TimeLeft"} <= names


def test_codes_by_width_are_those_of_the_signals():
    table = {}
    for widths, *codes in rows("width"):
        columns = [[int(code, 0) for code in cell.split(",")] for cell in codes]
        table |= dict(zip(map(int, re.findall(r"\d+", widths)), zip(*columns, strict=True), strict=True))
    used = {s.length: s for m in DATABASE.messages for s in m.signals if s.name not in PROTOCOL}
    assert set(used) <= set(table)
    for length, (highest, error, _) in table.items():
        assert highest == error - 1 if length < 8 else highest + 1 == 0xFB << length - 8
    for length, signal in used.items():
        codes = ValueCodes(signal)
        assert codes.highest <= table[length][0]
        assert (codes.error, codes.not_available) == table[length][1:]


def test_defaults_in_the_text_are_those_of_the_configuration():
    config = reference_configuration()
    for said in (
        f"(`estimator.window`, {config.estimator.window:g} s)",
        f"`estimator.min_speed` ({config.estimator.min_speed:g} m/s)",
        f"`traversability.max_age` ({config.traversability.max_age:g} s)",
    ):
        assert said in TEXT


def test_the_worked_example_is_what_our_publisher_sends():
    example = re.search(r"^Worked example, the sixth `(\w+)` frame \((.*?)\):$", TEXT, re.M | re.S)
    said = dict(re.findall(r"`(\w+)` ([\w.]+)", example[2]))
    assert set(said) == {s.name for s in MESSAGES[example[1]].signals} - {"Checksum"}
    assert said.pop("Counter") == "5"
    values = {name: value if value.isalpha() else float(value) for name, value in said.items()}
    publisher = Publisher(DATABASE)
    frame = [publisher.frame(example[1], values) for _ in range(6)][-1]

    payload = bytes.fromhex(re.search(r"^payload +([0-9A-F ]+)$", TEXT, re.M)[1])
    assert int(re.search(r"^id +(.*)$", TEXT, re.M)[1], 16) == frame.arbitration_id
    assert payload == frame.data
    assert bytes.fromhex(re.search(r"^Checksum +(.*)$", TEXT, re.M)[1]) == payload[7:]
    decoded = DATABASE.decode_message(frame.arbitration_id, payload)
    assert {name: decoded[name] for name in values} == {
        name: value if isinstance(value, str) else pytest.approx(value) for name, value in values.items()
    }


def test_the_worked_checksum_is_right_bit_by_bit():
    covered = bytes.fromhex(re.search(r"^CRC over +(.*)$", TEXT, re.M)[1])
    payload = bytes.fromhex(re.search(r"^payload +([0-9A-F ]+)$", TEXT, re.M)[1])
    frame_id = int(re.search(r"^id +(.*)$", TEXT, re.M)[1], 16)
    assert covered == frame_id.to_bytes(4, "little") + payload[:7]
    assert sae_j1850(covered) == payload[7]
    assert sae_j1850(b"123456789") == int(re.search(r"check value of `123456789`: (0x\w\w)", TEXT)[1], 16)


def sae_j1850(data: bytes) -> int:
    """CRC-8 with the README's polynomial, start and final xor, a bit at a time."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1
    return crc ^ 0xFF


@pytest.mark.parametrize(("beyond", "breaks"), [(-1.0, 0), (1.0, 1)])
def test_a_recording_ends_with_the_silence_that_the_text_says(beyond, breaks):
    (said,) = re.findall(r"after more than (\d+) s without any", TEXT)
    config = reference_configuration()
    database, seen = load_databases(config), []
    admission = Pipeline(config, database).admission
    admission.at_break = lambda: seen.append("break")
    needed = database.get_message_by_name("MotorFL")
    for t in (1.7e9, 1.7e9 + float(said) + beyond):
        admission.feed(t, needed.frame_id, needed.is_extended_frame, bytes(needed.length))
    assert len(seen) == breaks
