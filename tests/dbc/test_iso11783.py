"""The standard messages: identifiers, scaling and value codes as the public tables have them."""

from pathlib import Path

import cantools
import pytest

from soilbus.can.j1939 import STANDARD_PGNS, pgn_of

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
        for name, value in message.decode(b"\xff" * 8).items():
            assert value > message.get_signal_by_name(name).maximum
