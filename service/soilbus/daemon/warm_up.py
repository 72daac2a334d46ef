"""Warm-up: a few windows are solved before anything depends on how long a window takes.

    slip(t) between 0.10 and 0.40, one period a window;   side load share 0.15 sin(4 pi t / window)
    load, pull, torque, sinkage = wheel-soil model at the prior's medians;   draft = sum of the wheels' pulls

The first pass through any code takes several times as long as later ones: memory comes page by page from the kernel,
caches are empty. The samples come from the wheel-soil model with the sensors' noise; results and frames are dropped.
"""

from __future__ import annotations

import zlib

import numpy as np
from cantools.database.can import Database

from soilbus.arrays import Array
from soilbus.can.channels import Channel, Column, Decoded
from soilbus.can.publish import Publisher
from soilbus.config.model import Config
from soilbus.estimation.assembly import delays_of, effects_of, model_of
from soilbus.estimation.instrumentation import ROLLING_SLIP, channel_value
from soilbus.estimation.window import Rig, pairs
from soilbus.pipeline.outputs import hop_frames
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.terra.effects.steady import CompletedModel, Wheel
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.vehicle import axle_loads
from soilbus.terra.wheel import Soil, state_on

WINDOWS = 3
"""The first one searches for the soil, later ones follow it."""
SAMPLE_RATE = 50.0
"""Samples of each channel a second [Hz]: frames every 20 ms, as motor controllers send them."""
GROUND_SPEED = 1.5
"""Ground speed [m/s]: that of ploughing."""
SLIP_RANGE = 0.10, 0.40
"""Least and greatest slip, once in each window: from easy work to where pull hardly grows any more."""
SIDE_LOAD_SHARE = 0.15
"""Share of a wheel's load that passes to its mate and back, twice in each window: a side slope of 9 degrees.  Where no
load swings, depths are alike and k_c and k_phi hardly separate: a window takes five times as long."""
FIXED_POINT_ROUNDS = 5
"""Fixed-point rounds between draft and wheel loads, and to the loads that effects leave: both within a few per cent."""


def warm_up(config: Config, database: Database, ours: Database) -> list[WindowResult]:
    """Rehearse with a pipeline and a publisher that are then thrown away.

    Returns
    -------
    The windows' results.

    Raises
    ------
    ValueError
        The configuration has no vehicle, or no wheel with torque, speed and load.
    """
    pipeline, publisher = Pipeline(config, database), Publisher(ours)
    settings, intake = config.estimator, pipeline.intake
    t = np.arange(0.0, settings.window + (WINDOWS - 1) * settings.hop, 1.0 / SAMPLE_RATE)
    truth, late = _driven(config, intake.rig, t), delays_of(config)
    columns = {
        c.name: _measured(c, t, truth, intake.rig, late)
        for c in intake.channels
        if c.quantity in truth and (not c.wheel or c.name in intake.rig.channels or c.wheel in intake.rig.wheels)
    }
    results: list[WindowResult] = []
    for since in np.arange(0.0, t[-1], settings.hop):
        now = (t >= since) & (t < since + settings.hop)
        intake.add(Decoded({name: Column(c.t[now], c.value[now]) for name, c in columns.items()}))
        results += pipeline.advance(since + settings.hop)
    for result in results:
        for message, values in hop_frames(result):
            publisher.frame(message, values)
    return results


def _driven(config: Config, rig: Rig, t: Array) -> dict[str, Array]:
    """Each quantity without noise, SI, (W, N) or (N,), at the times t [s] (N,)."""
    if rig.chassis is None or not rig.wheels:
        raise ValueError("a rehearsal needs a [vehicle] with wheels that have torque, speed and load")
    phase = 2.0 * np.pi * t / config.estimator.window
    slip = SLIP_RANGE[0] + (SLIP_RANGE[1] - SLIP_RANGE[0]) * (1.0 - np.cos(phase)) / 2.0
    slip = np.where(rig.drives[:, None], slip, ROLLING_SLIP)
    radius, width, rear = rig.radius[:, None], rig.width[:, None], ~rig.front[:, None]
    share = np.ones((len(rear), len(t))) / np.where(rear, rear.sum(), (~rear).sum())
    share[pairs(rig)] *= 1.0 + SIDE_LOAD_SHARE * np.stack([np.sin(2.0 * phase), -np.sin(2.0 * phase)])[:, None]
    model = CompletedModel.of(model_of(config), effects_of(config), GROUND_SPEED)
    state = state_on(Soil(*(prior.value for prior in config.soil_prior.values())), np.nan, slip, radius, width)
    draft, ratio = np.zeros(len(t)), np.ones(share.shape)
    for _ in range(FIXED_POINT_ROUNDS):
        of_front, of_rear = axle_loads(rig.chassis, draft, 0.0, 0.0)
        load = np.where(rear, of_rear, of_front) * share
        state = state._replace(entry_angle=entry_angle_for_load(load * ratio, state, model.model))
        carried, pull, torque = model.forces(state, rear, load)
        draft, ratio = pull.sum(axis=0), ratio * load / carried
    depth = model.sinkage(state.entry_angle, Wheel(radius, width, rear, load))
    speed, still = GROUND_SPEED / (radius * (1.0 - slip)), np.zeros(len(t))
    if rig.towing == "never":
        draft = still
    return {
        "torque": torque, "torque_limit": np.full_like(torque, 2.0 * torque.max()), "load": carried,
        "speed": speed, "motor_speed": speed, "sinkage": depth,
        "ground_speed": np.full(len(t), GROUND_SPEED), "draft": draft, "pitch": still, "acceleration": still,
        "yaw_rate": still, "roll": still, "steering_angle": still, "differential_lock": still,
    }  # fmt: skip


def _measured(channel: Channel, t: Array, truth: dict[str, Array], rig: Rig, late: dict[str, float]) -> Column:
    """Samples of one channel with the noise of its sensor, stamped as late as they come."""
    value = truth[channel.quantity]
    if channel.wheel:
        value = channel_value(rig, channel.quantity, channel.wheel, value)
    noise = rig.noise.get(channel.quantity, rig.noise["speed"])
    sd = np.sqrt(noise.absolute**2 + (noise.relative * value) ** 2 + (noise.of_mean * np.abs(value).mean()) ** 2)
    rng = np.random.default_rng(zlib.crc32(channel.name.encode()))
    return Column(t + channel.delay + late.get(channel.quantity, 0.0), value + sd * rng.standard_normal(len(t)))
