"""Warm-up: a few windows are solved before anything depends on how long a window takes.

    frames of `modelled_drive` with the sensors' noise -> Pipeline -> Publisher -> nothing

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
from soilbus.estimation.assembly import delays_of
from soilbus.estimation.instrumentation import channel_value
from soilbus.estimation.window import Rig
from soilbus.pipeline.modelled_drive import modelled_drive
from soilbus.pipeline.outputs import hop_frames
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult

WINDOWS = 3
"""The first one searches for the soil, later ones follow it."""
SAMPLE_RATE = 50.0
"""Samples of each channel a second [Hz]: frames every 20 ms, as motor controllers send them."""


def warm_up(config: Config, database: Database, ours: Database) -> list[WindowResult]:
    """Return the windows of a modelled drive, run through pipeline and publisher to make the first real one fast.

    ValueError where the configuration has no vehicle, or no wheel with torque, speed and load.
    """
    pipeline, publisher = Pipeline(config, database), Publisher(ours)
    settings, intake = config.estimator, pipeline.intake
    t = np.arange(0.0, settings.window + (WINDOWS - 1) * settings.hop, 1.0 / SAMPLE_RATE)
    truth, late = modelled_drive(config, intake.rig, t), delays_of(config)
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


def _measured(channel: Channel, t: Array, truth: dict[str, Array], rig: Rig, late: dict[str, float]) -> Column:
    """Samples of one channel with the noise of its sensor, stamped as late as they come."""
    value = truth[channel.quantity]
    if channel.wheel:
        value = channel_value(rig, channel.quantity, channel.wheel, value)
    noise = rig.noise.get(channel.quantity, rig.noise["speed"])
    sd = np.sqrt(noise.absolute**2 + (noise.relative * value) ** 2 + (noise.of_mean * np.abs(value).mean()) ** 2)
    rng = np.random.default_rng(zlib.crc32(channel.name.encode()))
    return Column(t + channel.delay + late.get(channel.quantity, 0.0), value + sd * rng.standard_normal(len(t)))
