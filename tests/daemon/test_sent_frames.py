"""`soilbus replay --frames`: our frames beside a recording are those that the live service sends."""

import itertools
import json
from collections import defaultdict
from pathlib import Path

import can
import pytest

from fakes import drive_messages
from soilbus.can.checksum import frame_checksum
from soilbus.can.dbc_files import output_database
from soilbus.can.log_writer import write_log
from soilbus.cli.main import main
from soilbus.offline.replay import read_log
from soilbus.offline.sent_frames import sent_frames
from soilbus.simulator.reference import TRACTOR, reference_configuration

DURATION = 16.0
DATABASE = output_database(reference_configuration())
Decoded = tuple[float, dict[str, object]]


def by_name(messages: list[can.Message]) -> dict[str, list[Decoded]]:
    """Time and values of each message of ours."""
    found: dict[str, list[Decoded]] = defaultdict(list)
    for message in messages:
        name = DATABASE.get_message_by_frame_id(message.arbitration_id).name
        found[name].append((message.timestamp, DATABASE.decode_message(message.arbitration_id, message.data)))
    return found


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with a drive, its JSON lines and our frames as the command writes them."""
    folder = tmp_path_factory.mktemp("frames")
    write_log(drive_messages(reference_configuration(), DURATION), folder / "drive.log")
    outputs = ["--json", str(folder / "out.jsonl"), "--frames", str(folder / "frames.blf")]
    assert main(["replay", "--config", str(TRACTOR), str(folder / "drive.log"), *outputs]) == 0
    return folder


@pytest.fixture(scope="module")
def sent(place) -> list[can.Message]:
    return list(can.LogReader(place / "frames.blf"))


def test_every_frame_decodes_with_the_right_checksum_and_counter(sent):
    counters: dict[int, list[int]] = defaultdict(list)
    for message in sent:
        assert message.data[7] == frame_checksum(message.arbitration_id, bytes(message.data), 7)
        counters[message.arbitration_id].append(message.data[6] >> 4)
    assert len(counters) == len(DATABASE.messages) - 2  # a vehicle of four wheels has no second four
    for counter in counters.values():
        assert counter == [i % 16 for i in range(len(counter))]


def test_the_frames_of_a_hop_say_what_the_json_line_of_that_time_says(place, sent):
    lines = [json.loads(line) for line in (place / "out.jsonl").read_text().splitlines()]
    frames = by_name(sent)
    units = {
        ("SoilStrength", "BearingPressure"): lambda line: line["bearing_pressure"]["value"] / 1e3,
        ("SoilStrength", "BearingPressureStd"): lambda line: line["bearing_pressure"]["std"] / 1e3,
        ("SoilFrictionAngle", "Value"): lambda line: line["soil"]["phi"]["value"] * 180.0 / 3.141592653589793,
        ("DraftCapability", "MaxDraft"): lambda line: line["traversability"]["max_draft"]["value"],
        ("TractionAdvice", "SlipForPullRear"): lambda line: line["capability"]["set_points"]["rear"]["pull"]["value"],
        ("WheelSinkage", "SinkageWheel3"): lambda line: line["sinkage"]["RL"] * 1e3,
    }
    for (name, signal), value in units.items():
        scale = DATABASE.get_message_by_name(name).get_signal_by_name(signal).scale
        assert len(frames[name]) == len(lines) >= 6
        for line, (t, values) in zip(lines, frames[name], strict=True):
            assert line["t"] <= t < line["t"] + 0.25
            assert values[signal] == pytest.approx(value(line), abs=0.51 * scale)
            assert values["Window"] == line["window"]
            assert values["Status"] == line["status"]


def test_fast_frames_keep_their_cycle_and_carry_the_decision_of_the_last_window(place, sent):
    lines = [json.loads(line) for line in (place / "out.jsonl").read_text().splitlines()]
    verdicts = by_name(sent)["Traversability"]
    gaps = [b - a for (a, _), (b, _) in itertools.pairwise(verdicts)]
    assert min(gaps) > 0.094
    assert max(gaps) < 0.13
    for line in lines:
        after = next(values for t, values in verdicts if t > line["t"] + 0.1)
        assert after["State"] == line["traversability"]["state"]
        assert after["Probability"] == pytest.approx(line["traversability"]["probability"], abs=0.01)
    assert {str(values["State"]) for t, values in verdicts if t < lines[0]["t"]} == {"unknown"}


def test_frames_of_soilbus_in_the_recording_are_not_taken_for_another_sender(place, tmp_path):
    heard, ours = list(read_log(place / "drive.log")), list(can.LogReader(place / "frames.blf"))
    for message in ours:
        message.channel = heard[0].channel  # one bus
    mixed = sorted([*heard, *ours], key=lambda m: m.timestamp)
    write_log(mixed, tmp_path / "mixed.log")
    again = by_name(list(sent_frames(reference_configuration(), [tmp_path / "mixed.log"])))
    assert {values["ForeignFrames"] for _, values in again["BusHealth"]} == {0}
    assert "go" in {str(values["State"]) for _, values in again["Traversability"]}
