"""Where the field recordings are, and how to read them."""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from pathlib import Path

import pytest
from cantools.database.can import Database

from soilbus.config.file import parse_config
from soilbus.config.model import Config


def _shared_field() -> Path:
    for folder in Path(__file__).resolve().parents:
        if (folder / "shared" / "field" / "field.dbc").is_file():
            return folder / "shared" / "field"
    return Path("shared/field")


FIELD = _shared_field()
needs_field = pytest.mark.skipif(not FIELD.is_dir(), reason="the field recordings (../shared/field) are not here")


def field_database() -> Database:
    """The field vehicle's DBC."""
    database = Database()
    database.add_dbc_string((FIELD / "field.dbc").read_text(encoding="ascii"))
    return database


def frames_of(path: str | Path) -> Iterator[tuple[float, int, bool, bytes]]:
    """Time [s], identifier, extended, payload of each line of a gzipped candump file."""
    with gzip.open(path, "rt", encoding="ascii") as lines:
        for line in lines:
            stamp, _, frame = line.split()
            identifier, _, data = frame.partition("#")
            yield float(stamp[1:-1]), int(identifier, 16), len(identifier) == 8, bytes.fromhex(data)


def field_config() -> Config:
    """Every signal of the field vehicle mapped to its role."""
    corners = {"FL": ("front", 0.50, 0.26), "FR": ("front", 0.50, 0.26), "RL": ("rear", 0.62, 0.38)}
    corners["RR"] = corners["RL"]
    wheels = [
        {
            "name": name,
            "axle": axle,
            "radius": radius,
            "width": width,
            "gear_ratio": 24.0,
            "torque": f"Mcu{name}.ShaftTorque",
            "speed": f"WheelSpeeds.{name}",
            "load": f"AxleLoads.{name}",
            "sinkage": f"RideHeight.Sink{name}",
        }
        for name, (axle, radius, width) in corners.items()
    ]
    return parse_config(
        {
            "dbc": {"input": ["field.dbc"]},
            "vehicle": {"mass": 2300.0, "wheelbase": 1.95, "cg_ahead_of_rear_axle": 0.95, "cg_height": 0.75},
            "wheel": wheels,
            "signals": {
                "ground_speed": "GroundBasedSpeedAndDistance.GroundBasedMachineSpeed",
                "draft": {"signal": "DrawbarPin.Draft", "valid": "Valid"},
                "pitch": "Attitude.Pitch",
                "acceleration": "Attitude.LongAccel",
            },
        },
        folder=FIELD,
    )
