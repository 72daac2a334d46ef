"""Positions on the bus: mapping, units, time-outs, and the two standard frames from any source."""

import math
from pathlib import Path

import numpy as np
import pytest

from soilbus.can.admission import Admission
from soilbus.can.dbc_files import load_databases
from soilbus.can.mapping import channels_of
from soilbus.config.file import parse_config
from soilbus.config.model import ConfigError

DBC = """VERSION ""
BU_: X
BO_ 256 Gnss: 8 X
 SG_ Lat : 0|32@1- (1e-07,0) [-90|90] "deg" X
 SG_ West : 32|32@1- (1e-07,0) [-180|180] "deg" X
BO_ 257 Other: 8 X
 SG_ Bare : 0|32@1- (1e-07,0) [-90|90] "" X
 SG_ Rad : 32|32@1- (1e-09,0) [-2|2] "rad" X
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 4000;
"""


def mapped(folder: Path, latitude, longitude, dbc: str = "a.dbc"):
    (folder / "a.dbc").write_text(DBC, encoding="utf-8")
    signals = {"latitude": latitude, "longitude": longitude}
    config = parse_config({"dbc": {"input": [dbc]}, "signals": signals}, folder=folder)
    database = load_databases(config)
    return {c.name: c for c in channels_of(config, database)}, database


def test_any_dbc_in_degrees_or_radians_and_a_west_positive_longitude(tmp_path):
    west = {"signal": "Gnss.West", "sign": -1}
    channels, _ = mapped(tmp_path, "Other.Rad", west)
    assert channels["latitude"].factor == 1.0
    assert channels["longitude"].factor == pytest.approx(-math.pi / 180.0)
    assert channels["latitude"].high == pytest.approx(math.pi / 2.0)
    assert channels["longitude"].high == pytest.approx(math.pi)


def test_time_outs_follow_the_cycle_of_a_slow_receiver_and_the_configuration_first(tmp_path):
    channels, _ = mapped(tmp_path, "Gnss.Lat", {"signal": "Gnss.West", "timeout": 3.0})
    assert channels["latitude"].timeout == 6.0
    assert channels["longitude"].timeout == 3.0
    assert mapped(tmp_path, "Other.Rad", "Gnss.West")[0]["latitude"].timeout == 2.0  # no cycle told
    vehicle = mapped(tmp_path, "VehiclePosition.Latitude", "VehiclePosition.Longitude", "iso11783.dbc")[0]
    assert vehicle["latitude"].timeout == 7.5


@pytest.mark.parametrize(
    ("signals", "fault"),
    [
        ({"latitude": "Gnss.Lat"}, "signals: a position needs both latitude and longitude"),
        ({"latitude": "Other.Bare", "longitude": "Gnss.West"}, "Bare has no unit: write deg or rad in the DBC"),
        ({"latitude": "Gnss.Lat", "longitude": "Gnss.Lat"}, "Gnss.Lat is already mapped to signals.latitude"),
    ],
)
def test_one_clear_line_for_a_fault(tmp_path, signals, fault):
    (tmp_path / "a.dbc").write_text(DBC, encoding="utf-8")
    raw = {"dbc": {"input": ["a.dbc"]}, "signals": signals}
    with pytest.raises(ConfigError) as error:
        channels_of(config := parse_config(raw, folder=tmp_path), load_databases(config))
    assert len(error.value.faults) == 1
    assert fault in error.value.faults[0]


def test_the_corners_of_the_map_are_on_it(tmp_path):
    channels, database = mapped(
        tmp_path, "PositionRapidUpdate.Latitude", "PositionRapidUpdate.Longitude", "nmea2000.dbc"
    )
    admission = Admission(channels.values(), database)
    for t, (latitude, longitude) in enumerate(((90.0, 180.0), (-90.0, -180.0))):
        codes = (round(latitude * 1e7), round(longitude * 1e7))
        admission.feed(float(t), 0x09F80101, True, b"".join(code.to_bytes(4, "little", signed=True) for code in codes))
    decoded = admission.take()
    assert np.degrees(decoded.columns["latitude"].value) == pytest.approx([90.0, -90.0])
    assert np.degrees(decoded.columns["longitude"].value) == pytest.approx([180.0, -180.0])
