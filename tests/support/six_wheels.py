"""A machine of 3600 kg with three axles, a motor at each of its six wheels, and load cells or none."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from soilbus.config.file import machine, parse_config
from soilbus.config.model import Config

MIDDLE = 1.5
"""Distance of the middle axle ahead of the rear one [m], of 2.4 m between the first and the last."""
PLACES = {"front": 2.4, "middle": MIDDLE, "rear": 0.0}


def six_wheels(cells: bool = True, axle: list[dict[str, Any]] | None = None, motors: bool = True) -> Config:
    """Its configuration, signals of names that no DBC has."""
    raw = tomllib.loads(machine("tractor").read_text(encoding="utf-8"))
    raw["vehicle"] = {
        "mass": 3600.0, "wheelbase": 2.4, "cg_ahead_of_rear_axle": 1.25, "cg_height": 0.8, "hitch_height": 0.5,
    }  # fmt: skip
    raw["axle"] = [{"name": "middle", "ahead_of_rear_axle": MIDDLE}] if axle is None else axle
    raw["wheel"] = []
    for name, letter in (("front", "F"), ("middle", "M"), ("rear", "R")):
        for wheel in (letter + side for side in "LR"):
            of_wheel = {"name": wheel, "axle": name, "radius": 0.52, "width": 0.36, "speed": f"Speeds.{wheel}"}
            of_motor = {"gear_ratio": 28.0, "max_torque": 2600.0, "torque": f"Motor{wheel}.Torque"}
            raw["wheel"].append(of_wheel | (of_motor if motors else {}) | ({"load": f"Loads.{wheel}"} if cells else {}))
    raw["estimator"] = {} if cells else {"max_bearing_std": 0.2}
    return parse_config(raw, folder=Path())
