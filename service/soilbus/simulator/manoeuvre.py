"""A manoeuvre: slip, ground speed, load from side to side and slope as a table of times, to drive and to keep.

{"t": [s], "slip": [1], "speed": [m/s], "side_load": [1], "slope": [rad]}      lists of one length, lines between
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from soilbus.simulator.scenario import Profile, Scenario

__all__ = ["LARGEST", "Manoeuvre", "of_json"]

COLUMNS = ("slip", "speed", "side_load", "slope")
"""What a manoeuvre prescribes at its times."""
LARGEST = 1 << 22
"""Bytes of a file that may be a manoeuvre."""
RANGES = {
    "t": (0.0, 86_400.0), "slip": (-1.0, 1.0), "speed": (0.05, 20.0), "side_load": (-1.0, 1.0), "slope": (-0.6, 0.6),
}  # fmt: skip
"""What a table from a file may hold: a day, what slip and a moved share of a load are, slopes that `--slope` takes."""


@dataclass(frozen=True, slots=True)
class Manoeuvre:
    """Manoeuvre: values at times [s] that ascend from 0, with straight lines between them, and words on what varies.

    The slip is common to the driven wheels, the speed that over ground [m/s]; `side_load` is the share of an axle's
    load that a side slope moves to its left wheel, a slope [rad] is positive uphill.
    """

    t: tuple[float, ...]
    slip: tuple[float, ...]
    speed: tuple[float, ...]
    side_load: tuple[float, ...]
    slope: tuple[float, ...]
    words: str

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.t[-1]

    def over(self, scenario: Scenario, nothing_towed: bool = False) -> Scenario:
        """Return a scenario in which the manoeuvre is driven on the ground of another."""
        t, speed = np.array(self.t), np.array(self.speed)
        distance = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2.0 * np.diff(t))])
        slope = ((0.0, 0.0),) if nothing_towed else tuple(zip(distance.tolist(), self.slope, strict=True))
        return replace(
            scenario,
            duration=self.duration,
            speed=Profile(self.t, self.speed),
            slip=Profile(self.t, self.slip),
            draft=None,
            side_shift=Profile(self.t, self.side_load),
            slope=slope,
        )

    def as_json(self) -> dict[str, Any]:
        """Return plain objects, which of_json() reads."""
        return asdict(self)


def of_json(text: str) -> Manoeuvre:
    """Return a manoeuvre from its JSON, or from the `manoeuvre` of a diagnosis; ValueError where there is none."""
    try:
        document = json.loads(text)
    except ValueError:
        raise ValueError("no manoeuvre in it: it is no JSON") from None
    table = document.get("manoeuvre", document) if isinstance(document, Mapping) else None
    columns = ("t", *COLUMNS)
    if not isinstance(table, Mapping) or not all(isinstance(table.get(name), list) for name in columns):
        raise ValueError(f"no manoeuvre in it: lists {', '.join(columns)}")
    rows = {name: tuple(_number(x, name) for x in table[name]) for name in columns}
    t = rows["t"]
    if {len(row) for row in rows.values()} != {len(t)} or len(t) < 2 or any(b <= a for a, b in pairwise(t)):
        raise ValueError("lists of a manoeuvre are of one length, at ascending times")
    return Manoeuvre(**rows, words=str(table.get("words", "")))


def _number(value: object, column: str) -> float:
    low, high = RANGES[column]
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{column} of a manoeuvre: {value!r} is not a number from {low:g} to {high:g}")
    return float(value)
