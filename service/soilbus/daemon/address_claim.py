"""Claim of our source address (SAE J1939-81, ISO 11783-5), by the library can-j1939, over the daemon's own bus.

    frames received -> hear -> can-j1939 -> outgoing -> the loop sends them

Nothing of ours is sent before the address is claimed, nor after a node with a smaller NAME has taken it.  can-j1939 has
a thread for the time a claim may be contested (250 ms); its frames wait in a queue, so that the loop alone sends.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

from soilbus.can.j1939 import name_of, pgn_of
from soilbus.can.publish import Frame
from soilbus.config.model import J1939, ConfigError

log = logging.getLogger(__name__)

ADDRESS_CLAIMED, REQUEST = 60928, 59904
"""Parameter groups of the claim."""


class AddressClaim:
    """Claim of one source address, that of our frames (SAE J1939-81); ConfigError where the extra is not installed."""

    filters: tuple[dict[str, Any], ...] = tuple(
        {"can_id": group << 8, "can_mask": 0x03FF0000, "extended": True} for group in (ADDRESS_CLAIMED, REQUEST)
    )
    """For python-can: the two groups, whoever sends them."""

    def __init__(self, settings: J1939, address: int) -> None:
        if find_spec("j1939") is None:
            raise ConfigError(["j1939: needs the extra soilbus[j1939]"])
        logging.getLogger("j1939").setLevel(logging.CRITICAL)  # what of it matters is said here
        self.wanted = address
        self._name = name_of(settings).to_bytes(8, "little")
        self._outgoing: deque[Frame] = deque()
        self._unit: Any = None
        self._was_lost = False
        self.begin()

    def begin(self) -> None:
        """Claim the address, at the start and whenever the bus has come back."""
        from j1939 import ControllerApplication, ElectronicControlUnit, Name

        self.close()
        self._outgoing.clear()
        self._unit = ElectronicControlUnit(send_message=self._queue)
        self._claimant = ControllerApplication(Name(bytes=list(self._name)), self.wanted)
        self._states = ControllerApplication.State
        self._unit.add_ca(controller_application=self._claimant)
        self._claimant.start()

    def _queue(self, identifier: int, extended: bool, data: Any, _fd: bool = False) -> None:
        self._outgoing.append(Frame(identifier, extended, bytes(data)))

    def hear(self, t: float, identifier: int, extended: bool, data: bytes | bytearray) -> None:
        """Take a received frame at its time [s]; only the two groups of the claim count, and no echo of our own."""
        if extended and pgn_of(identifier) in (ADDRESS_CLAIMED, REQUEST) and bytes(data) != self._name:
            self._unit.notify(identifier, data, t)

    def outgoing(self) -> Iterator[Frame]:
        """Yield the claim's own frames that are due."""
        while self._outgoing:
            yield self._outgoing.popleft()

    @property
    def holds(self) -> bool:
        """Whether the address is ours, so that we may send."""
        return bool(self._claimant.state == self._states.NORMAL)

    @property
    def is_lost(self) -> bool:
        """Whether another node has the address."""
        lost = bool(self._claimant.state == self._states.CANNOT_CLAIM)
        if lost and not self._was_lost:
            log.error("%s; nothing is sent any more", self.status_of(lost))
        self._was_lost = lost
        return lost

    def status(self) -> str:
        """Return what is not well, for the status line; empty where the address is ours."""
        return "" if self.holds else self.status_of(self.is_lost)

    def status_of(self, lost: bool) -> str:
        """Return why nothing may be sent."""
        return f"address {self.wanted:#04x} " + ("belongs to a node with a smaller NAME" if lost else "not claimed yet")

    def close(self) -> None:
        """End the library's thread."""
        if self._unit is not None:
            self._unit.stop()
