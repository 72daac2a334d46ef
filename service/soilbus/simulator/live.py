"""The simulated tractor on a bus, step by step: it drives by commands, and its frames go out in real time.

commands -> one step of the drive -> readings -> frames, sent while the next step is computed
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, MutableSequence
from queue import Queue

import can

from soilbus.can.bus import bus_fault, open_bus
from soilbus.config.model import Config
from soilbus.simulator.commands import Commands
from soilbus.simulator.drive import Command, Drive, steps
from soilbus.simulator.frames import Encoder
from soilbus.simulator.play import send_in_time
from soilbus.simulator.scenario import Scenario
from soilbus.simulator.sensors import Instruments

__all__ = ["drive_live", "driven_frames"]

MAX_FRAMES_PER_STEP = 1000
"""Frames that are looked at in a step: those of a full bus of 500 kbit/s in 0.25 s."""
Step = tuple[Drive, list[can.Message]]


def driven_frames(
    config: Config, scenario: Scenario, seed: int, commanded: Callable[[float], Command]
) -> Iterator[Step]:
    """Yield a drive with its frames, step by step (see `drive.steps`)."""
    instruments, encoder = Instruments(config, seed, scenario.vehicle_seed), Encoder(config, seed)
    for done in steps(config, scenario, seed, commanded=commanded):
        frames: list[can.Message] = []
        if len(done.columns["t"]):
            frames = list(encoder.frames(instruments.measure(done), done.columns))
        yield done, frames


def drive_live(config: Config, scenario: Scenario, seed: int, driven: MutableSequence[Drive]) -> float:
    """Drive on the configured bus in real time, by the commands on it; return the system time [s] of the start.

    `driven` takes the true values of each step before its frames are sent; their times t [s] count from the start.

    Raises
    ------
    BusError
        The bus cannot be opened, or goes away.
    SimulationError, KeyError, ConfigError
        As `drive.drive`.
    """
    commands, settings = Commands(config), config.bus.model_dump()

    def messages(made: Iterator[Step]) -> Iterator[can.Message]:
        for done, frames in made:
            driven.append(done)
            yield from frames

    with open_bus(settings) as bus:  # without filters: python-can's own would end a look at the first other frame

        def commanded(t: float) -> Command:
            for _ in range(MAX_FRAMES_PER_STEP):
                if (frame := bus.recv(0.0)) is None:
                    break
                commands.take(frame, time.monotonic())
            return commands.at(time.monotonic())

        begin = time.time()
        try:
            send_in_time(messages(_ahead(driven_frames(config, scenario, seed, commanded))), bus.send)
        except (can.CanError, OSError) as error:
            raise bus_fault(settings, error) from None
    return begin


def _ahead(made: Iterator[Step]) -> Iterator[Step]:
    """The same, each made by a thread while the one before is used."""
    ready: Queue[Step | Exception | None] = Queue(maxsize=1)

    def make() -> None:
        try:
            for one in made:
                ready.put(one)
            ready.put(None)
        except Exception as error:
            ready.put(error)

    threading.Thread(target=make, daemon=True).start()
    while (one := ready.get()) is not None:
        if isinstance(one, Exception):
            raise one
        yield one
