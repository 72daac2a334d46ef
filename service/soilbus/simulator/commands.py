"""Commands of the bus to the simulated tractor: DriveCommand and TorqueLimitCommand of dbc/tractor.dbc.

A frame counts only with 8 bytes, the right checksum and a counter that goes on. What it commands holds for HOLD_TIME;
then, as for a signal that is not available, the scenario holds again.
"""

from __future__ import annotations

import math
from typing import Any

import can
from cantools.database import Database

from soilbus.can.checksum import CHECKSUM, COUNTER, frame_checksum
from soilbus.can.publish import ValueCodes
from soilbus.config.file import shipped_dbc
from soilbus.config.model import Config
from soilbus.simulator.drive import Command

__all__ = ["Commands"]

HOLD_TIME = 1.0
"""Time [s] for which a command holds (dbc/tractor.dbc): ten of its cycles."""
_DRIVE, _TORQUE_LIMIT = "DriveCommand", "TorqueLimitCommand"


class Commands:
    """The last commands, by the time at which they came.

    The wheels FL, FR, RL and RR of the DBC are the first two and the last two of the configuration.
    """

    def __init__(self, config: Config) -> None:
        self._wheels = [*config.wheel[:2], *config.wheel[2:][-2:]]
        database = Database()
        database.add_dbc_file(str(shipped_dbc("tractor.dbc")))
        self._messages = {m.frame_id: m for m in map(database.get_message_by_name, (_DRIVE, _TORQUE_LIMIT))}
        commanded = {i: [s for s in m.signals if s.name not in (COUNTER, CHECKSUM)] for i, m in self._messages.items()}
        self._codes = {i: {s.name: ValueCodes(s) for s in signals} for i, signals in commanded.items()}
        self._counter: dict[int, int] = {}
        self._values: dict[str, tuple[float, dict[str, float]]] = {}

    def take(self, frame: can.Message, now: float) -> bool:
        """Note a frame that came at a time `now` [s]; return whether it is a command and right."""
        message = self._messages.get(frame.arbitration_id) if frame.is_extended_id else None
        data = bytes(frame.data)
        if message is None or frame.is_remote_frame or len(data) != message.length:
            return False
        decoded: Any = message.decode(data, scaling=False, decode_choices=False)
        raw: dict[str, int] = decoded
        if raw[CHECKSUM] != frame_checksum(message.frame_id, data, 7):
            return False
        counter = raw[COUNTER]
        if self._counter.get(message.frame_id) == counter:
            return False
        self._counter[message.frame_id] = counter
        codes = self._codes[message.frame_id]
        good = {n: c.offset + c.scale * raw[n] for n, c in codes.items() if c.lowest <= raw[n] <= c.highest}
        self._values[message.name] = now, good
        return True

    def at(self, now: float) -> Command:
        """Return the commands in force at a time [s]."""
        drive, limits = (self._fresh(name, now) for name in (_DRIVE, _TORQUE_LIMIT))
        of_wheels = zip(self._wheels, ("LimitFL", "LimitFR", "LimitRL", "LimitRR"), strict=False)
        torque_limit = {wheel.name: limits[name] * wheel.gear_ratio for wheel, name in of_wheels if name in limits}
        return Command(drive.get("Draft"), drive.get("Speed"), torque_limit)

    def _fresh(self, name: str, now: float) -> dict[str, float]:
        came, values = self._values.get(name, (-math.inf, {}))
        return values if now - came <= HOLD_TIME else {}
