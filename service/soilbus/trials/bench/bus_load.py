"""A fully loaded bus: a simulated tractor's frames, and unmapped frames for the rest of the load.

frames a second = 1 Mbit/s / 136 bits, of which a tenth is mapped
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import can

from soilbus.can.bus import open_bus
from soilbus.can.j1939 import pgn_of
from soilbus.can.publish import Frame
from soilbus.can.wire import wire_of
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited

FULL_BUS_RATE = 7350.0
"""Frames a second of 8 bytes with 29-bit identifiers that 1 Mbit/s carries, at 136 bits each with their stuff bits."""
MAPPED_SHARE = 0.1
"""Share of the frames that is mapped."""

_POSITION = 0xFEF3
"""PGN of the vehicle position."""
_OTHERS_PERIOD = 0.01
"""Period [s] of each unmapped message."""
_OTHERS = 0x18EE0000  # address claims, which nothing is mapped to


class Traffic:
    """Plays a simulated drive onto a channel in real time; `sent` counts its frames, all of them mapped.

    The drive alone is less than a tenth of a full bus, so its position is sent more often, which adds no information.
    """

    def __init__(self, channel: str, seconds: float) -> None:
        self.sent = 0
        config = reference_configuration()
        drive = list(frames(simulate(config, excited("loam", seconds), seed=1), config))
        self.played = _thickened(drive, FULL_BUS_RATE * MAPPED_SHARE)
        """Each frame with its time [s] since an origin of its own, in their order."""
        self._channel = channel
        self._thread = threading.Thread(target=self._play, daemon=True)

    def start(self) -> None:
        """Begin to send."""
        self._thread.start()

    def wait(self) -> None:
        """Until the drive is over."""
        self._thread.join()

    def _play(self) -> None:
        bus = open_bus({"interface": "socketcan", "channel": self._channel}, [])
        wire = wire_of(bus)
        begin = time.monotonic() - self.played[0][0]
        for t, frame in self.played:
            if (ahead := begin + t - time.monotonic()) > 0.0005:
                time.sleep(ahead)
            wire.send(frame)
            self.sent += 1
        wire.shutdown()


def _thickened(drive: Sequence[can.Message], rate: float) -> list[tuple[float, Frame]]:
    """The drive's frames with their times [s], with copies of the position to make up the rate [1/s]."""
    span = drive[-1].timestamp - drive[0].timestamp
    spoken = sum(pgn_of(m.arbitration_id) == _POSITION for m in drive)
    copies = max(0, round((rate * span - len(drive)) / spoken))
    return [
        (message.timestamp, Frame(message.arbitration_id, message.is_extended_id, bytes(message.data)))
        for message in drive
        for _ in range(1 + (copies if pgn_of(message.arbitration_id) == _POSITION else 0))
    ]


@contextmanager
def others(channel: str) -> Iterator[None]:
    """The rest of a full bus, sent by the kernel's own timers."""
    with can.Bus(interface="socketcan", channel=channel, can_filters=[]) as bus:
        tasks = [
            bus.send_periodic(can.Message(arbitration_id=_OTHERS + i, data=bytes(8)), _OTHERS_PERIOD)
            for i in range(round(FULL_BUS_RATE * (1.0 - MAPPED_SHARE) * _OTHERS_PERIOD))
        ]
        try:
            yield
        finally:
            for task in tasks:
                task.stop()
