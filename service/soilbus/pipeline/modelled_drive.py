"""A drive by the wheel-soil model at the prior's medians, for what must be known before any data.

    slip(t) between 0.10 and 0.40, one period a window;   side load share 0.15 sin(4 pi t / window)
    load, pull, torque, sinkage = wheel-soil model at the prior's medians;   draft = sum of the wheels' pulls
    T(s) = 0 gives the slip of a wheel that is not driven

The daemon warms up on it; `soilbus check` says by it what a load cell that is not there costs.
"""

from __future__ import annotations

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.estimation.assembly import effects_of, model_of
from soilbus.estimation.window import Rig, pairs
from soilbus.terra.effects.steady import CompletedModel, Wheel
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.vehicle import GRAVITY, wheel_loads
from soilbus.terra.wheel import Soil, state_on

GROUND_SPEED = 1.5
"""Ground speed [m/s]: that of ploughing."""
SLIP_RANGE = 0.10, 0.40
"""Least and greatest slip of driven wheels, once in each window: from easy work to where pull hardly grows any more."""
SIDE_LOAD_SHARE = 0.15
"""Share of a wheel's load that passes to its mate and back, twice in each window: a side slope of 9 degrees.  Where no
load swings, depths are alike and k_c and k_phi hardly separate: a window takes five times as long."""
FIXED_POINT_ROUNDS = 5
"""Fixed-point rounds between draft and wheel loads, and to the loads that effects leave: both within a few per cent."""
SLIP_STEP = 1e-4
"""Step of slip of the finite difference by which a free wheel's torque becomes zero."""


def modelled_drive(config: Config, rig: Rig, t: Array) -> dict[str, Array]:
    """Return each quantity without noise at the times t [s] (N,): SI, (W, N) of wheels, (N,) of the vehicle.

    Wheels that are not driven roll.  ValueError where there is no vehicle, or no wheel of which a torque is measured.
    """
    if rig.chassis is None or not rig.wheels:
        raise ValueError("a drive needs a [vehicle] with wheels whose torque is measured")
    phase = 2.0 * np.pi * t / config.estimator.window
    slip = SLIP_RANGE[0] + (SLIP_RANGE[1] - SLIP_RANGE[0]) * (1.0 - np.cos(phase)) / 2.0
    length = 0.0 if rig.lengths is None else rig.lengths[:, None]
    rolling = np.where(np.asarray(length) > 0.0, 0.0, rig.options.measurements.rolling_slip)
    slip = np.where(rig.drives[:, None], slip, rolling)
    radius, width, rear = rig.radius[:, None], rig.width[:, None], ~rig.front[:, None]
    share = np.ones((len(rear), len(t)))
    share[pairs(rig)] *= 1.0 + SIDE_LOAD_SHARE * np.stack([np.sin(2.0 * phase), -np.sin(2.0 * phase)])[:, None]
    model = CompletedModel.of(model_of(config), effects_of(config), GROUND_SPEED)
    state = state_on(Soil(*(prior.value for prior in config.soil_prior.values())), np.nan, slip, radius, width, length)
    still = np.zeros(len(t))
    draft, pitch, ratio = still, still, np.ones(share.shape)
    for _ in range(FIXED_POINT_ROUNDS):
        load = wheel_loads(rig.chassis, rig.ahead, draft, pitch, 0.0) * share
        state = state._replace(entry_angle=entry_angle_for_load(load * ratio, state, model.model))
        carried, pull, torque = model.forces(state, rear, load)
        ratio = ratio * load / carried
        if rig.towing == "never":  # slopes take the pull
            pitch = np.arcsin(np.clip(pull.sum(axis=0) / (rig.chassis.mass * GRAVITY), -1.0, 1.0))
        else:
            draft = pull.sum(axis=0)
        if not rig.drives.all():
            by_slip = (model.forces(state._replace(slip=state.slip + SLIP_STEP), rear, load)[2] - torque) / SLIP_STEP
            rolled = np.clip(slip - torque / by_slip, -rig.options.measurements.max_rolling_skid, 0.0)
            slip = np.where(rig.drives[:, None], slip, rolled)
            state = state._replace(slip=slip)
    depth = model.sinkage(state.entry_angle, Wheel(radius, width, rear, load))
    speed = GROUND_SPEED / (radius * (1.0 - slip))
    acceleration = GRAVITY * np.sin(pitch) if rig.specific_force else still
    return {
        "torque": torque, "torque_limit": np.full_like(torque, 2.0 * torque.max()), "load": carried,
        "speed": speed, "motor_speed": speed, "sinkage": depth,
        "ground_speed": np.full(len(t), GROUND_SPEED), "draft": draft, "pitch": pitch, "acceleration": acceleration,
        "yaw_rate": still, "roll": still, "steering_angle": still, "differential_lock": still,
    }  # fmt: skip
