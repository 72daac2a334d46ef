"""Play a recording: onto a bus in real time, or into a log."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import can

from soilbus.can.bus import bus_fault, open_bus
from soilbus.can.log_writer import write_log
from soilbus.config.model import Config
from soilbus.simulator.course import NORTHWARD, Course
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS
from soilbus.words import did_you_mean

_ASSUMED_SPEED = 1.4
"""Ground speed [m/s] by which time becomes distance: the middle of a scenario's default speeds."""


def scenario_over(soils: Sequence[str], duration: float, course: Course = NORTHWARD) -> Scenario:
    """A scenario over several soils, each for an equal part of the time, with slip swept from 0.05 to 0.40.

    Raises
    ------
    KeyError
        A soil is unknown.
    """
    for name in soils:
        if name not in SOILS:
            raise KeyError(f"no soil is named {name}{did_you_mean(name, SOILS)}; known: {', '.join(SOILS)}")
    length = duration * _ASSUMED_SPEED / len(soils)
    patches = tuple(Patch(i * length, name) for i, name in enumerate(soils))
    return Scenario(duration, patches, slip=Swing(0.05, 0.40), course=course)


def play(recording: Recording, config: Config, log: Path | None) -> None:
    """Write the recording's frames to a log, or send them to the configured bus in real time.

    Raises
    ------
    BusError
        The bus cannot be opened, or goes away.
    OSError
        The log cannot be written.
    ValueError
        The log's format is unknown.
    """
    messages = frames(recording, config)
    if log is not None:
        write_log(messages, log)
        return
    settings = config.bus.model_dump()
    with open_bus(settings) as bus:
        try:
            send_in_time(messages, bus.send)
        except (can.CanError, OSError) as error:
            raise bus_fault(settings, error) from None


def send_in_time(
    messages: Iterable[can.Message],
    send: Callable[[can.Message], None],
    speed: float = 1.0,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Send messages spaced as their stamps are.

    Parameters
    ----------
    messages
        In the order of their stamps.
    send
        Sends one.
    speed
        Seconds of the recording per second.
    clock, sleep
        Monotonic time [s] and waiting by it.
    """
    first: float | None = None
    begin = clock()
    for message in messages:
        if first is None:
            first = message.timestamp
        ahead = (message.timestamp - first) / speed - (clock() - begin)
        if ahead > 0.0005:
            sleep(ahead)
        send(message)
