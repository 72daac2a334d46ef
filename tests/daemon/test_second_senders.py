"""A second sender of an input and wrong checksums: what the service and `check --log` say of them."""

import copy
import json
import re

import can
import numpy as np
import pytest

from fakes import Bench, Notes, drive_messages
from soilbus.can.candump import frame_of
from soilbus.can.checksum import frame_checksum
from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.cli.main import main
from soilbus.sensors.survey import survey
from soilbus.simulator.reference import reference_configuration

CONFIG, DURATION = reference_configuration(["estimator.window=4"]), 10.0
MOTOR = load_databases(CONFIG).get_message_by_name("MotorFL").frame_id


@pytest.fixture(scope="module")
def recording() -> list[can.Message]:
    return drive_messages(CONFIG, DURATION)


def joined(recording: list[can.Message], first: float, last: float) -> list[can.Message]:
    """With frames of a second sender of a motor between these seconds: a counter of its own, a right checksum."""
    begin, forged = recording[0].timestamp, []
    motor = [m for m in recording if m.arbitration_id == MOTOR and first < m.timestamp - begin < last]
    for i, message in enumerate(motor):
        data = bytearray(message.data)
        data[0] ^= 0x40
        data[6] = data[6] & 0x0F | i * 3 % 16 << 4
        data[7] = frame_checksum(MOTOR, bytes(data), 7)
        forged.append(
            can.Message(timestamp=message.timestamp + 0.005, arbitration_id=MOTOR, data=data, channel=message.channel)
        )
    return sorted([*recording, *forged], key=lambda m: m.timestamp)


def damaged(recording: list[can.Message], share: float) -> list[can.Message]:
    """With wrong checksums in that share of the motor's frames."""
    rng, heard = np.random.default_rng(3), copy.deepcopy(recording)
    for message in heard:
        if message.arbitration_id == MOTOR and rng.random() < share:
            message.data[7] ^= 1
    return heard


def findings(heard: list[can.Message]) -> list[str]:
    """What `check --log` finds in it."""
    return [f.text for f in survey(CONFIG, load_databases(CONFIG), map(frame_of, heard)).findings]


def test_a_second_sender_of_an_input_ends_go_and_is_named(recording, caplog):
    bench = Bench(joined(recording, 6.5, 7.5), CONFIG)
    start = bench.clock.now
    bench.run(DURATION)
    said = {str(f["State"]) for f in bench.sent("Traversability", since=start + 7.0) if f["at"] < start + 10.4}
    assert said == {"unknown"}
    assert bench.sent("Traversability", since=start + 6.4)[0]["State"] == "go"
    status = [f for f in bench.sent("SoilbusStatus", since=start + 7.1) if f["at"] < start + 10.4]
    assert {(str(f["State"]), str(f["Reason"])) for f in status} == {("degraded", "input_rejected")}
    assert "input_rejected torque.FL (second_sender)" in caplog.text
    assert "frames of MotorFL are refused: the Counter does not go on by one: a second sender" in caplog.text


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_a_share_of_wrong_checksums_is_said_in_status_and_journal(recording, caplog, share):
    notifier = Notes()
    Bench(damaged(recording, share), CONFIG, notifier=notifier).run(DURATION)
    for text in (caplog.text, notifier.said):
        found = re.findall(r"(\d+)% of \d+ frames of MotorFL are refused: wrong Checksum: a second sender", text)
        assert float(found[-1]) == pytest.approx(100.0 * share, abs=6.0)


def test_a_good_bus_has_no_doubts(recording, caplog):
    notifier = Notes()
    Bench(recording, CONFIG, notifier=notifier).run(DURATION)
    assert "refused" not in notifier.said + caplog.text


@pytest.mark.parametrize("last", [4.0, 9.0])
def test_check_names_a_second_sender_of_any_share(recording, last):
    (text,) = (text for text in findings(joined(recording, 3.0, last)) if "wheel.FL.torque:" in text)
    assert "values of MotorFL.ShaftTorque do not count: the Counter does not go on by one: a second sender" in text


def test_replay_names_a_second_sender_in_its_windows_and_its_summary(recording, tmp_path, capsys):
    write_log(joined(recording, 2.0, 9.0), tmp_path / "drive.log")
    short = ["--set", "estimator.window=4", str(tmp_path / "drive.log"), "--json", str(tmp_path / "out")]
    assert main(["replay", "--config", "tractor", *short]) == 0
    said = capsys.readouterr().out
    assert re.search(r"^\d+% of \d+ frames of MotorFL are refused: .* a second sender", said, re.M)
    assert "torque.FL, torque_limit.FL: the counters do not go on by one: look for a second sender" in said
    for window in map(json.loads, (tmp_path / "out").read_text().splitlines()):
        assert window["status"] in ("degraded", "invalid")
        assert window["traversability"]["state"] != "go"
        assert window["reason"].startswith("input_rejected torque.FL (second_sender)")
        assert window["rejected"]["second_sender"] > 100


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_check_names_a_share_of_wrong_checksums(recording, share):
    text = next(text for text in findings(damaged(recording, share)) if "Checksum" in text)
    refused, of = map(int, re.search(r"(\d+) of (\d+) values of MotorFL", text).groups())
    assert refused / of == pytest.approx(share, abs=0.03)
    assert "a second sender or a bad connection" in text
