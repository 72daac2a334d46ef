"""Frames carry the sensor series within their resolution, through logs of every format."""

import cantools
import numpy as np
import pytest

from soilbus.can.checksum import frame_checksum
from soilbus.can.dbc_files import load_databases
from soilbus.can.mapping import channels_of
from soilbus.config.file import load_config, parse_config
from soilbus.simulator.frames import START_TIME, encoded, frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import TRACTOR
from soilbus.simulator.scenario import demo, excited

CONFIG = load_config(TRACTOR)
DATABASE = load_databases(CONFIG)
PROTECTED = {"MotorFL", "MotorFR", "MotorRL", "MotorRR", "RideHeight", "Attitude", "DrawbarPin"}


@pytest.fixture(scope="module")
def recording():
    return simulate(CONFIG, demo(12.0), seed=5)


@pytest.fixture(scope="module")
def messages(recording):
    return list(frames(recording, CONFIG))


def by_name(messages, database=DATABASE):
    groups = {}
    for message in messages:
        groups.setdefault(database.get_message_by_frame_id(message.arbitration_id).name, []).append(message)
    return groups


def test_every_channel_decodes_to_its_column_within_half_a_bit(recording, messages):
    groups = by_name(messages)
    for channel in channels_of(CONFIG, DATABASE):
        signal = DATABASE.get_message_by_name(channel.message).get_signal_by_name(channel.signal)
        column = recording.channels[channel.name]
        decoded = [DATABASE.decode_message(m.arbitration_id, m.data)[channel.signal] for m in groups[channel.message]]
        si = channel.factor * np.array(decoded, float) + channel.offset
        half = abs(channel.factor) * signal.scale / 2.0
        assert si == pytest.approx(column.value, abs=half * (1.0 + 1e-9)), channel.name


def test_each_message_keeps_its_cycle_time_with_little_jitter(messages):
    groups = by_name(messages)
    assert set(groups) == {message.name for message in DATABASE.messages if "CONTROL" not in message.senders}
    stamps = [message.timestamp for message in messages]
    assert stamps == sorted(stamps)
    assert START_TIME <= stamps[0] < START_TIME + 0.002
    phases = []
    for name, group in groups.items():
        cycle = DATABASE.get_message_by_name(name).cycle_time / 1000.0
        late = np.array([m.timestamp for m in group]) - START_TIME - cycle * np.arange(len(group))
        assert late.min() >= 0.0
        assert np.ptp(late) < 1.01e-3
        assert late.max() < 0.02
        assert np.ptp(late) > 0.8e-3
        phases.append(late.min())
    assert len({round(phase, 4) for phase in phases}) == len(phases)


def test_counters_run_and_checksums_hold(messages):
    groups = by_name(messages)
    for name in PROTECTED:
        counters = [DATABASE.decode_message(m.arbitration_id, m.data)["Counter"] for m in groups[name]]
        assert counters == [i % 16 for i in range(len(counters))], name
        assert all(m.data[7] == frame_checksum(m.arbitration_id, bytes(m.data), 7) for m in groups[name])


def test_what_a_vehicle_sends_beside_the_mapped_signals(recording, messages):
    groups = by_name(messages)
    ground = [DATABASE.decode_message(m.arbitration_id, m.data) for m in groups["GroundBasedSpeedAndDistance"]]
    distance = [x["GroundBasedMachineDistance"] for x in ground]
    assert distance == pytest.approx(recording.truth["distance"][::2], abs=5.1e-4)
    assert {str(x["GroundBasedMachineDirection"]) for x in ground} == {"forward"}
    motor = [DATABASE.decode_message(m.arbitration_id, m.data) for m in groups["MotorRL"]]
    rpm = recording.truth["speed.RL"] * 24.0 * 60.0 / (2.0 * np.pi)
    assert [x["ShaftSpeed"] for x in motor] == pytest.approx(rpm, abs=0.0626)
    assert {str(x["State"]) for x in motor} == {"not_available"}
    assert {x["TorqueLimit"] for x in motor} == {100.0}
    assert {m.data[2] & 3 for m in groups["DrawbarPin"]} == {1}


def test_what_is_not_known_is_not_available():
    raw = CONFIG.model_dump(exclude={"folder"}, exclude_none=True)
    del raw["wheel"][0]["max_torque"]
    unlimited = parse_config(raw)
    short = simulate(unlimited, excited("loam", 1.0), seed=1)
    group = by_name(frames(short, unlimited))["MotorFL"]
    limits = {str(DATABASE.decode_message(m.arbitration_id, m.data)["TorqueLimit"]) for m in group}
    assert limits == {"not_available"}


FOREIGN = """VERSION ""
BU_: A
BO_ 100 Mixed: 8 A
 SG_ Big : 7|16@0- (0.05,0) [-1638.4|1638.35] "N.m" A
 SG_ Across : 19|11@0+ (1,0) [0|0] "" A
 SG_ Little : 33|13@1- (2,-7) [0|0] "" A
 SG_ Last : 56|8@1+ (1,0) [0|0] "" A
"""


def test_packing_equals_cantools_in_both_byte_orders():
    message = cantools.database.load_string(FOREIGN, "dbc").messages[0]
    rng = np.random.default_rng(8)
    codes = {}
    for signal in message.signals:
        low = -(1 << signal.length - 1) if signal.is_signed else 0
        codes[signal.name] = rng.integers(low, low + (1 << signal.length), 200)
    payload = encoded(message, codes)
    for i in range(200):
        raw = {name: int(column[i]) for name, column in codes.items()}
        assert bytes(payload[i]) == message.encode(raw, scaling=False, padding=True, strict=False)


FOREIGN_VEHICLE = """VERSION ""
BU_: A
BO_ 256 Mcu: 8 A
 SG_ Torque : 7|16@0- (0.05,0) [-1638.4|1638.35] "N.m" A
 SG_ ShaftSpeed : 23|16@0- (0.125,0) [-4096|4095.875] "rpm" A
BO_ 257 Chassis: 8 A
 SG_ Kmh : 0|16@1+ (0.01,0) [0|250] "km/h" A
 SG_ Load : 16|16@1+ (0.01,0) [0|600] "kN" A
 SG_ Radar : 32|16@1+ (0.01,0) [0|250] "km/h" A
"""


def test_units_gears_and_slower_channels_of_a_foreign_dbc(tmp_path):
    (tmp_path / "other.dbc").write_text(FOREIGN_VEHICLE, encoding="utf-8")
    raw = CONFIG.model_dump(exclude={"folder"}, exclude_none=True)
    raw["dbc"]["input"] = ["other.dbc"]
    for wheel in raw["wheel"]:
        for role in ("torque", "speed", "load", "sinkage", "torque_limit"):
            del wheel[role]
    raw["wheel"][2] |= {"torque": "Mcu.Torque", "speed": "Chassis.Kmh", "load": "Chassis.Load"}
    raw["signals"] = {"ground_speed": "Chassis.Radar"}
    config = parse_config(raw, folder=tmp_path)
    recording = simulate(config, excited("loam", 4.0), seed=1)
    database = load_databases(config)
    groups = by_name(frames(recording, config), database)
    chassis = [database.decode_message(257, m.data) for m in groups["Chassis"]]
    torque = [database.decode_message(256, m.data)["Torque"] for m in groups["Mcu"]]
    channels = recording.channels
    assert torque == pytest.approx(channels["torque.RL"].value / 24.0, abs=0.0251)
    assert [x["Kmh"] for x in chassis] == pytest.approx(channels["speed.RL"].value * 0.62 * 3.6, abs=0.00501)
    assert [x["Load"] for x in chassis] == pytest.approx(channels["load.RL"].value / 1e3, abs=0.00501)
    held = np.repeat(channels["ground_speed"].value, 2) * 3.6  # 25 Hz in a 50 Hz frame
    assert [x["Radar"] for x in chassis] == pytest.approx(held, abs=0.00501)
