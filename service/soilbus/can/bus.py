"""python-can, made to survive: filters, reopening with back-off, full queues, error frames."""

from __future__ import annotations

import errno
import logging
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import can

from soilbus.can.publish import Frame

log = logging.getLogger(__name__)

FIRST_BACK_OFF = 0.1
LONGEST_BACK_OFF = 1.0
"""Reopening is tried at least this often [s], so that a bus that is back is found in time."""

RECEIVE_BUFFER = 4 * 2**20

_KERNEL_WITHOUT_CAN = {errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT, errno.ESOCKTNOSUPPORT}


class BusError(Exception):
    """The bus cannot be opened; `may_come` tells whether waiting can help."""

    def __init__(self, text: str, may_come: bool) -> None:
        super().__init__(text)
        self.may_come = may_come


@dataclass(slots=True)
class BusCounts:
    """What happened on the bus since the start."""

    sent: int = 0
    dropped: int = 0
    error_frames: int = 0
    reopened: int = 0


def open_bus(settings: Mapping[str, Any], filters: Sequence[dict[str, Any]] | None = None) -> can.BusABC:
    """The bus that the section [bus] describes, with kernel filters where it has a kernel.

    Raises BusError with one line.
    """
    name = f"{settings.get('interface')}:{settings.get('channel')}"
    try:
        bus = can.Bus(**dict(settings), can_filters=list(filters) if filters is not None else None)
        _enlarge_buffer(bus)
        return bus
    except can.CanInterfaceNotImplementedError as error:
        raise BusError(f"bus {name}: {_one_line(error)}", may_come=False) from None
    except (OSError, can.CanError) as error:
        number = getattr(error, "errno", None) or getattr(error, "error_code", None)
        if number in _KERNEL_WITHOUT_CAN:
            raise BusError(f"bus {name}: this kernel has no SocketCAN", may_come=False) from None
        raise BusError(f"bus {name}: {_one_line(error)}", may_come=True) from None
    except (ValueError, TypeError, AttributeError) as error:
        raise BusError(f"bus {name}: {_one_line(error)}", may_come=False) from None


def _enlarge_buffer(bus: can.BusABC) -> None:
    """As much receive buffer as the kernel lets us have (net.core.rmem_max)."""
    if isinstance(getattr(bus, "socket", None), socket.socket):
        bus.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)  # type: ignore[attr-defined]


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


class LiveBus:
    """A bus that may go and come back.

    Nothing in here blocks longer than asked.  While the bus is away `receive` returns
    nothing and `send` drops.  `clock` is monotonic.
    """

    def __init__(
        self,
        opener: Callable[[], can.BusABC],
        clock: Callable[[], float],
        sleep: Callable[[float], None],
    ) -> None:
        self.counts = BusCounts()
        self.fault = "not opened yet"
        self._opener, self._clock, self._sleep = opener, clock, sleep
        self._bus: can.BusABC | None = None
        self._next_try = -1.0
        self._back_off = FIRST_BACK_OFF
        self._full = False

    @property
    def is_open(self) -> bool:
        """Whether frames can come and go now."""
        return self._bus is not None

    def open(self) -> None:
        """Open now; raises BusError."""
        self._bus = self._opener()
        self.fault, self._back_off = "", FIRST_BACK_OFF

    def _reopen(self) -> bool:
        now = self._clock()
        if now < self._next_try:
            return False
        try:
            self.open()
        except BusError as error:
            if str(error) != self.fault:
                log.warning("%s", error)
            self.fault = str(error)
            self._next_try = now + self._back_off
            self._back_off = min(2.0 * self._back_off, LONGEST_BACK_OFF)
            return False
        self.counts.reopened += 1
        log.info("bus is open")
        return True

    def _lost(self, error: Exception) -> None:
        log.warning("bus lost: %s", _one_line(error))
        self.fault = _one_line(error)
        self.close()
        self._next_try = self._clock() + self._back_off

    def receive(self, timeout: float) -> can.Message | None:
        """The next data or remote frame, or None after `timeout` [s] or when the bus is away."""
        if self._bus is None and not self._reopen():
            self._sleep(min(timeout, max(self._next_try - self._clock(), 0.0)))
            return None
        try:
            message = self._bus.recv(timeout)  # type: ignore[union-attr]
        except (can.CanError, OSError) as error:
            self._lost(error)
            return None
        if message is not None and message.is_error_frame:
            self.counts.error_frames += 1
            return None
        return message

    def send(self, frame: Frame) -> bool:
        """Send at once or drop: a late result is worth less than the next one."""
        if self._bus is None:
            self.counts.dropped += 1
            return False
        try:
            self._bus.send(
                can.Message(arbitration_id=frame.arbitration_id, is_extended_id=frame.extended, data=frame.data)
            )
        except can.CanOperationError as error:
            self.counts.dropped += 1
            if error.error_code in (errno.ENOBUFS, errno.EAGAIN, errno.EWOULDBLOCK) or error.error_code is None:
                if not self._full:
                    log.warning("send queue full: %s", _one_line(error))
                self._full = True
                return False
            self._lost(error)
            return False
        except OSError as error:
            self.counts.dropped += 1
            self._lost(error)
            return False
        self._full = False
        self.counts.sent += 1
        return True

    def close(self) -> None:
        """Let go of the bus."""
        bus, self._bus = self._bus, None
        if bus is not None:
            try:
                bus.shutdown()
            except (can.CanError, OSError) as error:
                log.debug("closing: %s", error)
