"""One window as the checks of plausibility see it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.window import Rig, Window, turning
from soilbus.terra.vehicle import slip_ratio

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SUSTAINED = 1.0
"""Seconds for which a contradiction must last."""
DEVIATIONS = 5.0
"""Standard deviations by which a change must stand out of the noise to count as one."""
FALSE_SLIP = 0.12
"""Slip that a wrong rolling radius may feign: four of its standard deviations in `terra.effects`."""


class Resolution(NamedTuple):
    """Step [SI] between two readings of a channel (0: none), and whether it reads 0 at rest or without load."""

    step: float
    rests_at_zero: bool


class Scene(NamedTuple):
    """One window as the checks see it: bins of length `bin` [s]; driving (N,), slip and traction (N, W).

    traction is torque over load and radius; both are nan where unknown, slip also where the vehicle
    does not drive straight on.  motor_speed [rad/s] (N, W) is at the wheel's side of the gear.
    """

    window: Window
    rig: Rig
    bin: float
    driving: Mask
    slip: Array
    traction: Array
    motor_speed: Array
    resolution: Mapping[str, Resolution]

    @property
    def sustained(self) -> int:
        """Bins for which a contradiction must last."""
        return max(round(SUSTAINED / self.bin), 1)


def scene_of(
    window: Window,
    rig: Rig,
    min_speed: float,
    max_turn: float,
    bin_length: float,
    resolution: Mapping[str, Resolution],
    motor_speed: Array,
) -> Scene:
    """What the checks need of a window."""
    driving = (window.ground_speed > min_speed) & ~turning(window, rig, max_turn)
    ground = np.where(driving, window.ground_speed, np.nan)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        traction = np.where(window.load > 0.0, window.torque / (rig.radius * window.load), np.nan)
    slip = slip_ratio(rig.radius, window.speed, ground)
    return Scene(window, rig, bin_length, driving, slip, traction, motor_speed, resolution)
