"""What the vehicle adds: rolling radii, a drive line that takes torque, slopes and masses not accounted for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from soilbus.terra.dual import value_of
from soilbus.terra.effects.along import curve_of, instants, mean_height, share_of_way, stretches, through_knots
from soilbus.terra.effects.effect import Effect, OnSoil, Parameter, Surroundings, Values
from soilbus.terra.vehicle import GRAVITY
from soilbus.terra.wheel import WheelModel, WheelState

REFERENCE_RATE = 2.5
"""Wheel speed [rad/s] at which a friction that falls with speed is what share and drag say."""
_LEAST_RATE = 0.1


def _drive_line(torque: Any, around: Surroundings, values: Values) -> Any:
    """At the motor: T + ((share |T| + drag) (|omega| / omega_0)^-fading + viscous |omega|), as it turns."""
    speed = around.wheel_speed
    way = np.where(speed < 0.0, -1.0, 1.0)
    faster = np.maximum(np.abs(speed), _LEAST_RATE) / REFERENCE_RATE
    friction = (values["share"] * np.abs(torque) + values["drag"]) * np.exp(-values["fading"] * np.log(faster))
    return torque + way * friction + values["viscous"] * speed


DRIVETRAIN_LOSS = Effect(
    name="drivetrain_loss",
    physics="Gears and bearings between motor and wheel take torque that never reaches the ground.",
    source="loss in proportion to load, a drag without load, churning with speed: Niemann & Winter,"
    " Maschinenelemente 2 (2003); friction that falls with speed as the film of oil builds up: Stribeck 1902;"
    " ISO/TR 14179-1:2001",
    tells="wheels turning off the ground (the drag alone), or torque cells at the wheels",
    parameters=(
        Parameter("share", "1", 0.0, 0.06, 0.0, 0.4),
        Parameter("drag", "N m", 0.0, 20.0, 0.0, 400.0),
        Parameter("viscous", "N m s", 0.0, 5.0, 0.0, 200.0),
        Parameter("fading", "1", 0.0, 0.3, 0.0, 1.5, starts=(0.6,)),
    ),
    torque=_drive_line,
    ruled_out="a torque cell between gear and wheel reads what reaches the wheel",
)

SLOPE_KNOTS = 24
"""One every seven metres of a drive of two minutes: fields undulate over twenty and more."""


def _unmeasured_slope(around: Surroundings, values: Values) -> Any:
    """m g sin of a slope that changes smoothly between knots."""
    departures = [0.0, *(values[f"slope_{i}"] for i in range(1, SLOPE_KNOTS))]
    slope = values["slope_0"] + through_knots(instants(share_of_way(around)), departures)
    return around.mass * GRAVITY * np.sin(slope)


GRADE = Effect(
    name="grade",
    physics="The field is not level, and gravity holds back or pushes, and no sensor shows it.",
    source="weight along the slope, m g sin(slope): Wong 2008, ch. 3; natural cubic spline between knots",
    tells="driving both ways on the slope, or a pitch sensor with its zero set on level ground; a slope that never"
    " changes, and is the same on every field, is a draft offset",
    parameters=(
        Parameter("slope_0", "rad", 0.0, 0.03, -0.3, 0.3),
        *curve_of("slope", "rad", range(1, SLOPE_KNOTS), SLOPE_KNOTS - 1, 0.03, 0.3),
    ),
    resistance=_unmeasured_slope,
    of_record=True,
)


def _pitch_error(around: Surroundings, values: Values) -> Any:
    """m g sin of what a pitch sensor leaves out: its zero, and a curve along the way that is zero on the mean."""
    heights = [values[f"slope_{i}"] for i in range(SLOPE_KNOTS)]
    slope = values["pitch_offset"] + through_knots(instants(share_of_way(around)), heights) - mean_height(heights)
    return around.mass * GRAVITY * np.sin(slope)


GRADE_BESIDE_PITCH = replace(
    GRADE,
    physics="The pitch sensor is not at zero on level ground, or leaves out how the field rises and falls: gravity"
    " holds back or pushes by the difference.",
    source="weight along the slope, m g sin(slope): Wong 2008, ch. 3; an inclinometer's zero and its mounting are"
    " taken to be right to 0.3 deg, and never off by more than three times that",
    parameters=(
        Parameter("pitch_offset", "rad", 0.0, 0.005, -0.015, 0.015, of_vehicle=True),
        *curve_of("slope", "rad", range(SLOPE_KNOTS), SLOPE_KNOTS - 1, 0.03, 0.3),
    ),
    resistance=_pitch_error,
)
"""The same where the pitch is measured: a slope that never changes is then an offset of that sensor, and no more."""


def _true_radius(state: WheelState, model: WheelModel, around: Surroundings, values: Values) -> OnSoil:
    """r (1 + error), and the slip that follows from it at the same V and omega."""
    rear = np.asarray(around.rear, float)
    scale = 1.0 + values["front"] * (1.0 - rear) + values["rear"] * rear
    return state._replace(radius=state.radius * scale, slip=1.0 - (1.0 - state.slip) / scale), model


ROLLING_RADIUS = Effect(
    name="rolling_radius",
    physics="The tyres are not of the radius written down: worn, or others fitted; so slip is not what it seems.",
    source="slip 1 - V/(r omega): Wong 2008, ch. 1",
    tells="rolling free without draft or torque on firm ground: slip must then be nearly zero; a sinkage sensor",
    parameters=(Parameter("front", "1", 0.0, 0.03, -0.15, 0.15), Parameter("rear", "1", 0.0, 0.03, -0.15, 0.15)),
    wheel=_true_radius,
    of_tyre=True,
    ruled_out="a rigid wheel is not worn or inflated: its radius is what a ruler says",
)


def _moving_mass(around: Surroundings, values: Values) -> Any:
    """mass_share m a."""
    return values["mass_share"] * around.mass * instants(around.acceleration)


def _spinning_wheels(torque: Any, around: Surroundings, values: Values) -> Any:
    """T + wheel_inertia d omega / dt; the rate is other instants' as much as its own, which hardly counts in it."""
    t = instants(around.t)
    speed = np.broadcast_to(value_of(around.wheel_speed), np.shape(torque))
    rate = np.zeros(speed.shape)
    for run in stretches(t):
        if len(run) >= 3:
            rate[run] = np.gradient(speed[run], t[run], axis=0)
    return torque + values["wheel_inertia"] * rate


INERTIA = Effect(
    name="inertia",
    physics="Speeding up takes force and torque that go into moving masses and spinning wheels, not into the ground.",
    source="rotating and towed masses beside m a: Mitschke & Wallentowitz, Dynamik der Kraftfahrzeuge (2014)",
    tells="speeding up and slowing down sharply on the same ground, an accelerometer",
    parameters=(
        Parameter("mass_share", "1", 0.0, 0.5, -1.0, 3.0),
        Parameter("wheel_inertia", "kg m^2", 0.0, 20.0, 0.0, 400.0),
    ),
    torque=_spinning_wheels,
    resistance=_moving_mass,
)
