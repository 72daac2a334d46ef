"""What a controller's error frames say of the bus: error active, warning, passive, bus-off.

Bits as in the kernel's linux/can/error.h; the states are those of ISO 11898-1.
"""

from __future__ import annotations

from enum import StrEnum

_CONTROLLER, _BUS_OFF, _RESTARTED = 0x004, 0x040, 0x100  # error classes, in the identifier
_RX_OVERFLOW, _WARNING, _PASSIVE, _ACTIVE = 0x01, 0x0C, 0x30, 0x40  # of the controller, in data[1]


class BusState(StrEnum):
    """Fault confinement state of our controller; names as in the DBC."""

    UNKNOWN = "unknown"
    ACTIVE = "error_active"
    WARNING = "error_warning"
    PASSIVE = "error_passive"
    OFF = "bus_off"


def state_told(before: BusState, error_class: int, data: bytes | bytearray) -> BusState:
    """Return the state after an error frame with this identifier and data; `before` if it tells none."""
    if error_class & _BUS_OFF:
        return BusState.OFF
    if error_class & _RESTARTED:
        return BusState.ACTIVE
    status = data[1] if error_class & _CONTROLLER and len(data) > 1 else 0
    for bits, state in ((_PASSIVE, BusState.PASSIVE), (_WARNING, BusState.WARNING), (_ACTIVE, BusState.ACTIVE)):
        if status & bits:
            return state
    return before


def tells_overflow(error_class: int, data: bytes | bytearray) -> bool:
    """Return whether an error frame says that the controller lost a frame by overflow."""
    return bool(error_class & _CONTROLLER and len(data) > 1 and data[1] & _RX_OVERFLOW)
