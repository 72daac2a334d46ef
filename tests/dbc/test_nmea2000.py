"""The NMEA 2000 position: payloads and values as canboat's own tests have them."""

from pathlib import Path

import cantools
import numpy as np
import pytest

from soilbus.can.channels import Reason
from soilbus.can.decode import ColumnDecoder
from soilbus.can.j1939 import STANDARD_PGNS, pgn_of
from soilbus.can.validity import CodeRule, judge_codes

DATABASE = cantools.database.load_file(Path(__file__).resolve().parents[2] / "dbc/nmea2000.dbc", strict=True)
MESSAGE = DATABASE.get_message_by_name("PositionRapidUpdate")


def verdicts(payload: str) -> list[str]:
    """Why each coordinate is refused, "" where it is not."""
    columns = ColumnDecoder(MESSAGE, ["Latitude", "Longitude"]).columns(
        np.frombuffer(bytes.fromhex(payload), np.uint8).reshape(1, 8)
    )
    found = [
        judge_codes(CodeRule(MESSAGE.get_signal_by_name(name)), columns[name].raw, columns[name].physical)[0]
        for name in ("Latitude", "Longitude")
    ]
    return [str([*Reason][v - 1]) if v else "" for v in found]


def test_a_position_off_the_american_coast():
    assert MESSAGE.is_extended_frame
    assert pgn_of(MESSAGE.frame_id) == 129025
    assert pgn_of(MESSAGE.frame_id) in STANDARD_PGNS
    payload = "829f491743836cd2"
    decoded = MESSAGE.decode(bytes.fromhex(payload))
    assert (decoded["Latitude"], decoded["Longitude"]) == (pytest.approx(39.0700930), pytest.approx(-76.4640445))
    assert verdicts(payload) == ["", ""]


@pytest.mark.parametrize(
    ("payload", "reasons"),
    [
        ("feffff7ffeffff7f", ["error", "error"]),
        ("ffffff7fffffff7f", ["not_available", "not_available"]),
        ("00e9a43500d2496b", ["", ""]),  # 90 and 180 degrees
        ("01e9a43501d2496b", ["out_of_range", "out_of_range"]),
        ("00175bca002eb694", ["", ""]),  # -90 and -180
        ("ff165bcaff2db694", ["out_of_range", "out_of_range"]),
    ],
)
def test_codes_without_a_place(payload, reasons):
    assert verdicts(payload) == reasons


@pytest.mark.parametrize(
    ("message", "pgn", "signal", "payload", "value"),
    [
        ("Attitude", 127257, "Pitch", "00ff7fe803ff7fff", 0.1),
        ("Attitude", 127257, "Roll", "00ff7fff7f18fcff", -0.1),
        ("RateOfTurn", 127251, "Rate", "000048e801ffffff", 1.0),
        ("CourseAndSpeedRapidUpdate", 129026, "SpeedOverGround", "00fcffff8c00ffff", 1.4),
    ],
)
def test_what_an_inertial_or_satellite_receiver_sends(message, pgn, signal, payload, value):
    layout = DATABASE.get_message_by_name(message)
    assert pgn_of(layout.frame_id) == pgn
    assert pgn in STANDARD_PGNS
    assert layout.decode(bytes.fromhex(payload))[signal] == pytest.approx(value)
    for each in layout.signals:
        code = max(code for code, name in each.choices.items() if str(name) == "not_available")
        assert each.raw_to_scaled(code, decode_choices=False) > each.maximum
