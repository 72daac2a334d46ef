"""J1939 / ISO 11783 identifiers: parameter group, source address, and which source to trust."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from soilbus.config.model import J1939

__all__ = ["STANDARD_PGNS", "SourceLock", "group_mask", "name_of", "pgn_of", "source_of"]

STANDARD_PGNS = frozenset(
    {61444, 61449, 61459, 61481, 61482, 61485}  # engine torque, vehicle dynamics, attitude, rates, acceleration
    | {65093, 65094, 65096, 65097, 65258, 65265, 65267}  # hitch, speeds, axle weight, position
    | {127251, 127257, 129025, 129026}  # NMEA 2000: rate of turn, attitude, position, speed over ground
)
"""Groups whose meaning the standards fix, whoever sends them."""

LOCK_RELEASE, LOCK_CYCLES = 2.0, 3.0
"""Silence [s] of a locked source after which another may take its place, and the same in cycles of the message:
positions (PGN 65267) may come every 5 s."""

_PDU2 = 0xF0
_PDU1_MASK = 0x03FF0000
_PDU2_MASK = 0x03FFFF00


def group_mask(arbitration_id: int) -> int:
    """Return the bits of a 29-bit identifier that tell its parameter group: below PDU format 240 without byte 2."""
    return _PDU1_MASK if (arbitration_id >> 16) & 0xFF < _PDU2 else _PDU2_MASK


def pgn_of(arbitration_id: int) -> int:
    """Return the parameter group number of a 29-bit identifier, data page bits included."""
    return (arbitration_id & group_mask(arbitration_id)) >> 8


def source_of(arbitration_id: int) -> int:
    """Return the source address of a 29-bit identifier."""
    return arbitration_id & 0xFF


def name_of(unit: J1939) -> int:
    """Return the NAME of a unit that is content with one address (ISO 11783-5), as 64 bits."""
    name = unit.identity_number | unit.manufacturer_code << 21
    name |= unit.ecu_instance << 32 | unit.function_instance << 35 | unit.function << 40
    return name | unit.device_class << 49 | unit.device_class_instance << 56 | unit.industry_group << 60


@dataclass(slots=True)
class SourceLock:
    """Lock on the first source heard of a parameter group, until it is silent for `patience` [s].

    `own`, the address that the DBC names, takes over whenever it talks.
    """

    own: int
    patience: float = LOCK_RELEASE
    source: int | None = field(default=None, init=False)
    heard: float = field(default=-math.inf, init=False)

    @classmethod
    def at_cycle(cls, own: int, cycle_time: float) -> SourceLock:
        """Return a lock with patience for a message that comes every `cycle_time` [s] (0: unknown)."""
        return cls(own, max(LOCK_RELEASE, LOCK_CYCLES * cycle_time))

    def admits(self, t: float, source: int) -> bool:
        """Return whether a frame of `source` at t [s] counts; move the lock where it must."""
        if source != self.source and source != self.own and t - self.heard <= self.patience:
            return False
        self.source, self.heard = source, max(self.heard, t)
        return True

    def release(self) -> None:
        """Forget the source and its time."""
        self.source, self.heard = None, -math.inf
