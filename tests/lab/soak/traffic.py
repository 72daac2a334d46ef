"""Endless traffic of one tractor: a truth that repeats, sensors whose noise never does."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice
from multiprocessing import get_context
from multiprocessing.connection import Connection

import can
import numpy as np

from soilbus.config.model import Config
from soilbus.simulator.drive import Drive, drive
from soilbus.simulator.frames import START_TIME, frames
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.simulator.sensors import channel_rng, measure, sensors

SOIL = "loam"
LAP = 160.0
"""Length of the truth [s]; its frames at 50 Hz are a multiple of 16, so that counters run on."""


BATCH = 2000


def traffic_beside(config: Config, seed: int) -> Iterator[can.Message]:
    """As `traffic`, made in another process: a lap's arrays are larger than all that the service keeps in ours."""
    context = get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(theirs, config, seed), daemon=True)
    process.start()
    theirs.close()
    try:
        while True:
            for t, identifier, extended, data in ours.recv():
                yield can.Message(timestamp=t, arbitration_id=identifier, is_extended_id=extended, data=data)
    finally:
        process.terminate()
        process.join()


def _send(pipe: Connection, config: Config, seed: int) -> None:
    messages = traffic(config, seed)
    while True:
        pipe.send([(m.timestamp, m.arbitration_id, m.is_extended_id, m.data) for m in islice(messages, BATCH)])


def traffic(config: Config, seed: int) -> Iterator[can.Message]:
    """Frames of the configured vehicle under draft on loam, lap after lap, for ever.

    Each sensor has one gain error for good and new noise in each lap.
    """
    scenario = Scenario(LAP, (Patch(0.0, SOIL),), draft=Swing(1500.0, 5000.0))
    driven = _with_gains(drive(config, scenario, seed), config, seed)
    without_gains = config.model_copy(update={"noise": config.noise.scaled(0.0, "gain")})
    for lap in count():
        of_lap = int(np.random.SeedSequence([seed, lap]).generate_state(1)[0])
        recording = Recording(driven.columns, measure(driven, without_gains, of_lap), seed)
        yield from frames(recording, config, start=START_TIME + lap * LAP)


def _with_gains(driven: Drive, config: Config, seed: int) -> Drive:
    columns = dict(driven.columns)
    for quantity, wheel, *_ in sensors(config):
        noise = getattr(config.noise, quantity, None)
        if noise is not None:
            name = f"{quantity}.{wheel}" if wheel else quantity
            columns[name] = columns[name] * (1.0 + noise.gain * channel_rng(seed, f"gain of {name}").standard_normal())
    return replace(driven, columns=columns)
