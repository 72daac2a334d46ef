"""dbc/sample.log is a minute of our frames, and the C reader of dbc/README.md reads it as cantools does."""

import subprocess
from collections import defaultdict
from pathlib import Path

import can
import cantools
import pytest

from soilbus.can.checksum import frame_checksum

DBC = Path(__file__).resolve().parents[2] / "dbc"
DATABASE = cantools.database.load_file(DBC / "soilbus.dbc", strict=True)
LEAST_FIRST = ("unknown", "no_go", "caution", "go")
SAMPLE = list(can.LogReader(DBC / "sample.log"))


def read(program: Path, log: str) -> list[str]:
    return subprocess.run([program], input=log, text=True, capture_output=True, check=True).stdout.splitlines()


def test_the_sample_is_a_minute_of_every_frame_of_a_vehicle_with_four_wheels():
    assert SAMPLE[-1].timestamp - SAMPLE[0].timestamp == pytest.approx(60.0, abs=1.0)
    assert (DBC / "sample.log").stat().st_size < 250_000
    counters: dict[str, list[int]] = defaultdict(list)
    for message in SAMPLE:
        name = DATABASE.get_message_by_frame_id(message.arbitration_id).name
        assert message.data[7] == frame_checksum(message.arbitration_id, bytes(message.data), 7)
        counters[name].append(message.data[6] >> 4)
    assert counters.keys() == {m.name for m in DATABASE.messages} - {"WheelSlip2", "WheelSinkage2"}
    for name, counter in counters.items():
        assert counter == [i % 16 for i in range(len(counter))], name


def test_the_reader_says_what_cantools_decodes(verdict_reader):
    verdicts = [
        (message.timestamp, str(DATABASE.decode_message(message.arbitration_id, message.data)["State"]))
        for message in SAMPLE
        if message.arbitration_id == DATABASE.get_message_by_name("Traversability").frame_id
    ]
    shown, before = [], "unknown"
    for i, (t, state) in enumerate(verdicts):  # go and caution only as the last five say them
        of_five = [said for _, said in verdicts[max(i - 4, 0) : i + 1]]
        now = state if state in LEAST_FIRST[:2] else min(of_five, key=LEAST_FIRST.index)
        shown += [f"{t:.6f} {now}"] if now != before else []
        before = now
    changes = shown
    assert {change.split()[1] for change in changes} >= {"go", "caution", "no_go"}
    assert read(verdict_reader, (DBC / "sample.log").read_text()) == [*changes, f"{len(verdicts)} good, 0 refused"]


def test_the_reader_refuses_what_is_broken_or_repeated_and_forgets_what_is_stale(verdict_reader):
    ident = DATABASE.get_message_by_name("Traversability").frame_id

    def line(t: float, counter: int, spoil: int = 0, length: int = 8) -> str:
        data = bytes([0x33, 0x28, 0xFF, 4, 4, 7, 0x0F | counter << 4])
        crc = frame_checksum(ident, data + b"\0", 7)
        return f"({t:.6f}) can0 {ident:08X}#{(data + bytes([crc ^ spoil]))[:length].hex().upper()}\n"

    other = "(2.000000) can0 123#00\n"
    row = "".join(line(0.5 + 0.1 * i, 12 + i & 15) for i in range(6))
    bad = line(1.1, 1) + line(1.2, 2, spoil=1) + line(1.25, 2, length=7) + other
    again = "".join(line(2.1 + 0.1 * i, 2 + i) for i in range(6))
    assert read(verdict_reader, row + bad + again) == [
        "1.000000 go",
        "2.000000 unknown",
        "2.600000 go",
        "12 good, 3 refused",
    ]
