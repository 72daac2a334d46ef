"""The standard messages: identifiers, scaling and value codes as the public tables have them."""

import itertools
import re
from pathlib import Path

import cantools
import numpy as np
import pytest

from soilbus.can.admission import Admission, hears_any_source
from soilbus.can.dbc_files import load_databases
from soilbus.can.decode import ColumnDecoder
from soilbus.can.j1939 import STANDARD_PGNS, pgn_of
from soilbus.can.mapping import channels_of
from soilbus.config.file import parse_config

DBC = Path(__file__).resolve().parents[2] / "dbc/iso11783.dbc"


@pytest.mark.parametrize(
    ("message", "pgn", "signal", "data", "value"),
    [
        ("GroundBasedSpeedAndDistance", 65097, "GroundBasedMachineSpeed", "D606230000000000", 1.750),
        ("WheelBasedSpeedAndDistance", 65096, "WheelBasedMachineDistance", "FFFFE8030000FFFF", 1.0),
        ("RearHitchStatus", 65093, "RearDraft", "FFFFFF007DFFFFFF", 0.0),
        ("FrontHitchStatus", 65094, "FrontDraft", "FFFFFF647EFFFFFF", 3560.0),
        ("CruiseControlVehicleSpeed", 65265, "WheelBasedVehicleSpeed", "FF0001FFFFFFFFFF", 1.0),
        ("VehiclePosition", 65267, "Latitude", "B2A86B9CFFFFFFFF", 52.4301234),
        ("VehiclePosition", 65267, "Longitude", "FFFFFFFF412AFC7B", -1.9876543),
        ("ElectronicEngineController1", 61444, "ActualEnginePercentTorque", "FFFFB54038FFFFFF", 56.0),
        ("ElectronicEngineController1", 61444, "EngineSpeed", "FFFFB54038FFFFFF", 1800.0),
        ("VehicleDynamicStabilityControl2", 61449, "YawRate", "FFFFFF709DFFFFFF", 40304 / 8192 - 3.92),
        ("VehicleDynamicStabilityControl2", 61449, "LongitudinalAcceleration", "FFFFFFFFFFFFFF87", 1.0),
        ("SlopeSensorInformation", 61459, "PitchAngle", "F486FFFFFFFFFFFF", 5.096),
        ("SlopeSensorInformation2", 61481, "PitchAngleExtendedRange", "00807FFFFFFFFFFF", 5.0),
        ("AngularRateInformation", 61482, "YawRateExtendedRange", "FFFFFFFF007EFFFF", 2.0),
        ("AccelerationSensor", 61485, "LongitudinalAccelerationExtendedRange", "FFFF647EFFFFFFFF", 3.56),
        ("VehicleWeight", 65258, "AxleWeight0", "0FA00FFFFFFFFFFF", 2000.0),
        ("VehicleWeight", 65258, "AxleWeight1", "11A00FFFFFFFFFFF", 2000.0),
    ],
)
def test_values(message, pgn, signal, data, value):
    layout = cantools.database.load_file(DBC, strict=True).get_message_by_name(message)
    assert layout.is_extended_frame
    assert pgn_of(layout.frame_id) == pgn
    assert pgn in STANDARD_PGNS
    assert layout.decode(bytes.fromhex(data))[signal] == pytest.approx(value)


def test_not_available_codes_lie_outside_every_range():
    for message in cantools.database.load_file(DBC, strict=True).messages:
        for signal in message.signals:
            assert signal.raw_to_scaled((1 << signal.length) - 1, decode_choices=False) > signal.maximum


def test_an_axle_is_weighed_by_its_own_frames_alone():
    message = cantools.database.load_file(DBC, strict=True).get_message_by_name("VehicleWeight")
    columns = ColumnDecoder(message, ["AxleWeight0", "AxleWeight1"]).columns(
        np.array([[location, 0xA0, 0x0F, *[0xFF] * 5] for location in (0x0F, 0x10, 0x1F, 0x20, 0xFF)], np.uint8)
    )
    assert columns["AxleWeight0"].present.tolist() == [True, False, False, False, False]
    assert columns["AxleWeight1"].present.tolist() == [False, True, True, False, False]


ROWS = [
    (role, signal, int(row[3]))
    for line in (DBC.parent / "README.md").read_text(encoding="utf-8").splitlines()
    if len(row := line.split("|")) == 6 and row[3].strip().isdecimal()
    for role, signal in zip(
        itertools.cycle(re.findall(r"`(\w+)`", row[1])), re.findall(r"`(\w+\.\w+)`", row[2]), strict=False
    )
]
"""Role, signal and parameter group of the page's table."""
VEHICLE = {"mass": 2000.0, "wheelbase": 2.0, "cg_ahead_of_rear_axle": 1.0, "cg_height": 0.7}
WHEEL = {"name": "W", "axle": "front", "radius": 0.5, "width": 0.3}


@pytest.mark.parametrize(("role", "signal", "pgn"), ROWS)
def test_a_signal_of_the_pages_table_can_be_mapped_as_it_stands(role, signal, pgn):
    mapped = {"signal": signal} | ({"reference_torque": 1000.0} if role == "torque" else {})
    raw = {"dbc": {"input": ["iso11783.dbc", "nmea2000.dbc"]}, "vehicle": VEHICLE, "wheel": [WHEEL]}
    if role in ("torque", "motor_speed", "load"):
        raw["axle"] = [{"name": "front", role: mapped}]
    elif role == "speed":
        raw["wheel"] = [WHEEL | {role: mapped}]
    else:
        other = {"latitude": "longitude", "longitude": "latitude"}.get(role)
        raw["signals"] = {role: mapped} | ({other: "PositionRapidUpdate." + other.title()} if other else {})
    config = parse_config(raw, folder=Path())
    database = load_databases(config)
    assert signal in {f"{c.message}.{c.signal}" for c in channels_of(config, database)}
    message = database.get_message_by_name(signal.partition(".")[0])
    assert pgn_of(message.frame_id) == pgn
    assert hears_any_source(message, database)


def test_the_table_has_every_role_that_a_standard_signal_can_fill():
    assert {role for role, _, _ in ROWS} >= {"ground_speed", "draft", "torque", "load", "pitch", "yaw_rate", "latitude"}
    assert len(ROWS) > 20


def test_an_engines_percentage_is_a_torque_of_the_axle_whatever_its_address():
    torque = {"signal": "ElectronicEngineController1.ActualEnginePercentTorque", "reference_torque": 1250.0}
    raw = {"dbc": {"input": ["iso11783.dbc"]}, "vehicle": VEHICLE, "wheel": [WHEEL]}
    config = parse_config(raw | {"axle": [{"name": "both", "gear_ratio": 20.0, "torque": torque}]}, folder=Path())
    database = load_databases(config)
    (channel,) = channels_of(config, database)
    admission = Admission([channel], database)
    for n, payload in enumerate(("FFFFA54038FFFFFF", "FFFFFFFFFFFFFFFF", "FFFF694038FFFFFF")):
        admission.feed(0.02 * n, 0x0CF00405, True, bytes.fromhex(payload))
    column = admission.take().columns[channel.name]
    assert column.value.tolist() == pytest.approx([0.40 * 1250.0 * 20.0, -0.20 * 1250.0 * 20.0])  # 255: not available
