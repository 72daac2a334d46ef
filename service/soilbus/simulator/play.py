"""What `soilbus simulate` drives, and its frames sent in real time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence

import can

from soilbus.simulator.course import NORTHWARD, Course
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS
from soilbus.words import did_you_mean

_USUAL_SPEED = Swing(1.0, 1.8)
"""Ground speed [m/s] where none is given."""


def scenario_over(
    soils: Sequence[str],
    duration: float,
    course: Course = NORTHWARD,
    draft: float | None = None,
    grade: float = 0.0,
    speed: float | None = None,
    vehicle_seed: int | None = None,
) -> Scenario:
    """Return a scenario over several soils, each for an equal part of the time; KeyError for an unknown one.

    Nobody lifts the implement of a given draft [N]; without one slip sweeps from 0.05 to 0.40. The grade is rise over
    run. Without a speed [m/s] it swings from 1.0 to 1.8. `vehicle_seed` picks true mass and sensor gains.
    """
    for name in soils:
        if name not in SOILS:
            raise KeyError(f"no soil is named {name}{did_you_mean(name, SOILS)}; known: {', '.join(SOILS)}")
    swing = _USUAL_SPEED if speed is None else Swing(speed, speed)
    length = duration * (swing.low + swing.high) / 2.0 / len(soils)
    return Scenario(
        duration,
        tuple(Patch(i * length, name) for i, name in enumerate(soils)),
        swing,
        draft=None if draft is None else Swing(draft, draft),
        slip=Swing(0.05, 0.40) if draft is None else None,
        lift_slip=None,
        slope=((0.0, math.atan(grade)),),
        course=course,
        drawn_mass=vehicle_seed is not None,
        vehicle_seed=vehicle_seed,
    )


def send_in_time(messages: Iterable[can.Message], send: Callable[[can.Message], None]) -> None:
    """Send messages, in the order of their stamps, spaced as these are."""
    first, begin = math.nan, time.monotonic()
    for message in messages:
        first = message.timestamp if math.isnan(first) else first
        ahead = message.timestamp - first - (time.monotonic() - begin)
        if ahead > 0.0005:
            time.sleep(ahead)
        send(message)
