"""A bus that may go and come back: opening, reopening with back-off, full queues, error frames, strangers."""

from __future__ import annotations

import errno
import logging
import math
import os
import socket
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from importlib.util import find_spec
from typing import Any

import can

from soilbus.can import candump
from soilbus.can.publish import Frame
from soilbus.can.wire import MessageBus, MessageWire, Received, error_number, is_multicast, wire_of
from soilbus.words import WorkError, one_line

log = logging.getLogger(__name__)

FIRST_BACK_OFF = 0.1
LONGEST_BACK_OFF = 1.0  # reopening is tried at least this often [s], so that a bus that is back is found in time
RECEIVE_BUFFER = 4 * 2**20  # bytes asked for frames that wait for us; the kernel takes as many again for itself
SO_RCVBUFFORCE = 33  # which Python does not name
LATE = 0.1  # age [s] at which a frame that did not get out is dropped: its successor is newer
RETRY = 0.005  # longest wait for a frame [s] while frames of ours wait for room
GARBLED_FOR = 1.0  # a driver that for so long [s] reads nothing that it understands is opened again
SAY_AGAIN = 60.0  # a fault that lasts is said in the journal this often [s]

_NO_ROOM = {errno.ENOBUFS, errno.EAGAIN, errno.EWOULDBLOCK}
_KERNEL_WITHOUT_CAN = {errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT, errno.ESOCKTNOSUPPORT}

# bits of the kernel's linux/can/error.h
_CONTROLLER, _BUS_OFF, _RESTARTED = 0x004, 0x040, 0x100  # error classes, in the identifier
_RX_OVERFLOW, _WARNING, _PASSIVE, _ACTIVE = 0x01, 0x0C, 0x30, 0x40  # of the controller, in data[1]


class BusError(WorkError):
    """The bus cannot be opened; `may_come` tells whether waiting can help."""

    def __init__(self, text: str, may_come: bool) -> None:
        super().__init__(text)
        self.may_come = may_come


def open_bus(settings: Mapping[str, Any], filters: Sequence[dict[str, Any]] | None = None) -> can.BusABC:
    """Return the bus of the section [bus], with kernel filters where it has a kernel; BusError with one line."""
    try:
        bus = can.Bus(**settings, can_filters=filters)
        if is_multicast(bus):
            with socket.socket(fileno=os.dup(bus.fileno())) as same:
                ask_for_buffer(same)
        own = getattr(bus, "socket", None)
        if isinstance(own, socket.socket):
            ask_for_buffer(own)
            if number := own.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):  # it is down; it binds all the same
                bus.shutdown()
                raise OSError(number, os.strerror(number))
        return bus
    except Exception as error:  # drivers raise all kinds
        raise bus_fault(settings, error) from None


def bus_fault(settings: Mapping[str, Any], error: Exception) -> BusError:
    """Return one line that says what the driver of the bus of [bus] raised."""
    name = f"{settings.get('interface')}:{settings.get('channel')}"
    number = getattr(error, "errno", None) or getattr(error, "error_code", None)
    if number in _KERNEL_WITHOUT_CAN:
        return BusError(f"bus {name}: this kernel has no SocketCAN", may_come=False)
    if settings.get("interface") == "udp_multicast" and find_spec("msgpack") is None:
        return BusError(f"bus {name}: needs the extra soilbus[udp]", may_come=False)
    is_there = isinstance(error, (OSError, can.CanError)) and not isinstance(error, can.CanInterfaceNotImplementedError)
    return BusError(f"bus {name}: {one_line(error)}", may_come=is_there)


def heard_for(settings: Mapping[str, Any], seconds: float) -> Iterator[candump.Frame]:
    """Yield the frames that the bus carries from now on; BusError where it cannot be opened or goes away."""
    try:
        with open_bus(settings) as bus:
            end = time.monotonic() + seconds
            while (left := end - time.monotonic()) > 0.0:
                if (message := bus.recv(left)) is not None:
                    yield candump.frame_of(message)
    except (OSError, can.CanError) as error:
        raise bus_fault(settings, error) from None


def ask_for_buffer(own: socket.socket) -> None:
    """Ask for RECEIVE_BUFFER (socket(7)): an administrator gets all of it, others what net.core.rmem_max allows."""
    own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
    with suppress(OSError):  # it takes CAP_NET_ADMIN
        own.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER)


class BusState(StrEnum):
    """Fault confinement state of our controller; those of ISO 11898-1, names as in the DBC."""

    UNKNOWN = "unknown"
    ACTIVE = "error_active"
    WARNING = "error_warning"
    PASSIVE = "error_passive"
    OFF = "bus_off"


def state_told(before: BusState, error_class: int, data: bytes | bytearray) -> BusState:
    """Return the state after an error frame with this identifier and data; `before` if it tells none."""
    status = data[1] if error_class & _CONTROLLER and len(data) > 1 else 0
    of_bus = ((error_class & _BUS_OFF, BusState.OFF), (error_class & _RESTARTED, BusState.ACTIVE))
    of_controller = ((_PASSIVE, BusState.PASSIVE), (_WARNING, BusState.WARNING), (_ACTIVE, BusState.ACTIVE))
    told = (*of_bus, *((status & bits, state) for bits, state in of_controller))
    return next((state for is_told, state in told if is_told), before)


def tells_overflow(error_class: int, data: bytes | bytearray) -> bool:
    """Return whether an error frame says that the controller lost a frame by overflow."""
    return bool(error_class & _CONTROLLER and len(data) > 1 and data[1] & _RX_OVERFLOW)


@dataclass(slots=True)
class BusCounts:
    """Counts of the bus since the start; dropped frames are ours, overruns the others'."""

    received: int = 0
    sent: int = 0
    dropped: int = 0
    overruns: int = 0
    error_frames: int = 0
    garbled: int = 0  # frames that the driver could not read: of a serial adapter, say, that lost a character
    foreign: int = 0  # frames of others under our identifiers
    lost: int = 0  # how often the bus went away
    reopened: int = 0


class LiveBus:
    """A bus that may go and come back: while it is away `receive` returns nothing and `send` drops.

    Nothing blocks longer than asked.  `clock` is monotonic.  `own` are the identifiers that we send (with: is it
    extended); a data frame that comes with one of them is somebody else's and is not handed on.
    """

    def __init__(
        self,
        opener: Callable[[], MessageBus],
        clock: Callable[[], float],
        sleep: Callable[[float], None],
        own: Collection[tuple[int, bool]] = (),
    ) -> None:
        self.fault = "not opened yet"
        self.state = BusState.UNKNOWN
        self.last_foreign = -math.inf  # when the last foreign frame came, by `clock` [s]
        self.found_nothing = True  # whether the last `receive` returned None because no frame of any kind waited
        self._opener, self._clock, self._sleep, self._own = opener, clock, sleep, frozenset(own)
        self._counts = BusCounts()
        self._wire: MessageWire | None = None
        self._waiting: dict[int, tuple[Frame, float]] = {}  # for room, since when: the newest of each identifier
        self._overruns_before = 0  # of wires that are closed, and what the controller reported
        self._next_try = -1.0
        self._back_off = FIRST_BACK_OFF
        self._garbled_since: float | None = None
        self._said: dict[str, float] = {}

    @property
    def is_open(self) -> bool:
        """Whether frames can come and go now."""
        return self._wire is not None

    @property
    def holds_seconds(self) -> bool:
        """Whether frames of a few seconds find room while nobody takes them."""
        return self._wire is not None and self._wire.room >= RECEIVE_BUFFER

    @property
    def counts(self) -> BusCounts:
        """Counts of the bus since the start."""
        self._counts.overruns = self._overruns_before + (self._wire.overruns if self._wire is not None else 0)
        return self._counts

    def open(self) -> None:
        """Open the bus now; raise BusError where that fails."""
        bus = self._opener()
        try:
            self._wire = wire_of(bus)
        except OSError as error:
            bus.shutdown()
            raise BusError(f"bus: {one_line(error)}", may_come=True) from None
        self.state, self.fault = BusState.UNKNOWN, ""

    def _reopen(self) -> None:
        if self._clock() < self._next_try:
            return
        try:
            self.open()
        except BusError as error:
            if str(error) != self.fault:
                log.warning("%s", error)
            self._wait(str(error))
            return
        self._counts.reopened += 1
        log.info("bus is open")

    def _lost(self, error: Exception) -> None:
        log.warning("bus lost: %s", one_line(error))
        self._counts.lost += 1
        self.close()
        self._wait(one_line(error))

    def _wait(self, fault: str) -> None:
        """No try for a while, and longer each time until a frame has come."""
        self.fault = fault
        self._next_try = self._clock() + self._back_off
        self._back_off = min(2.0 * self._back_off, LONGEST_BACK_OFF)

    def receive(self, timeout: float) -> Received | can.Message | None:
        """Return the next frame for us; None after `timeout` [s], or where the bus is away or garbles a frame."""
        self.found_nothing = True
        if self._wire is None:
            self._reopen()
        if self._wire is None:
            self._sleep(min(timeout, max(self._next_try - self._clock(), 0.0)))
            return None
        if self._waiting:
            self._flush(self._clock())
            timeout = min(timeout, RETRY)
        if self._wire is None:
            return None
        try:
            message = self._wire.recv(timeout)
        except (can.CanError, OSError) as error:
            self._lost(error)
            return None
        except Exception as error:
            self._note_garbled(error)
            return None
        self._garbled_since = None
        if message is None:
            return None
        self.found_nothing = False
        if message.is_error_frame:
            self._counts.error_frames += 1
            self._overruns_before += tells_overflow(message.arbitration_id, message.data)
            before, self.state = self.state, state_told(self.state, message.arbitration_id, message.data)
            if self.state is not before:
                log.warning("controller: %s", self.state)
            return None
        if (message.arbitration_id, message.is_extended_id) in self._own:
            if message.is_rx and not message.is_remote_frame:
                self._counts.foreign += 1
                self.last_foreign = self._clock()
                self._say(f"another node sends our frame {message.arbitration_id:08X}")
            return None
        if self.state is BusState.OFF:  # not any more: nothing is heard in bus-off
            self.state = BusState.UNKNOWN
        self._counts.received += 1
        self._back_off = FIRST_BACK_OFF
        return message

    def stamping_time(self) -> float:
        """Return the present time [s] by the clock that stamps frames; nan where that is not known."""
        return math.nan if self._wire is None else self._wire.stamping_time()

    def heard_until(self) -> float:
        """Return the stamp [s] before which no frame can come any more; -inf where that is not known."""
        return -math.inf if self._wire is None else self._wire.heard_until()

    def _note_garbled(self, error: Exception) -> None:
        self._counts.garbled += 1
        self.found_nothing = False
        now = self._clock()
        if self._garbled_since is None:
            self._garbled_since = now
        if now - self._garbled_since > GARBLED_FOR:
            self._garbled_since = None
            self._lost(error)
        else:
            self._say(f"the driver could not read a frame: {type(error).__name__}")

    def send(self, frame: Frame) -> bool:
        """Send a frame, or keep it for a moment if there is no room; return whether nothing waits any more.

        It is dropped when a newer one of its identifier comes first, when it is late, or when the bus is away.
        """
        if self._wire is None:
            self._counts.dropped += 1
            return False
        now = self._clock()
        self._counts.dropped += frame.arbitration_id in self._waiting
        self._waiting[frame.arbitration_id] = frame, now
        return self._flush(now)

    def _flush(self, now: float) -> bool:
        """Send what waits and is not late, as far as there is room; whether all of it is out."""
        for identifier, (frame, made) in list(self._waiting.items()):
            if self._wire is None or now - made > LATE:
                self._counts.dropped += 1
                del self._waiting[identifier]
                continue
            try:
                self._wire.send(frame)
            except Exception as error:  # drivers raise all kinds
                if error_number(error) not in _NO_ROOM:
                    self._lost(error)
                else:
                    self._say(f"send queue full: {one_line(error)}")
                return False
            self._counts.sent += 1
            del self._waiting[identifier]
        return True

    def _say(self, text: str) -> None:
        """Into the journal, the same text once in a while."""
        now = self._clock()
        if now - self._said.get(text, -math.inf) >= SAY_AGAIN:
            self._said[text] = now
            log.warning("%s", text)

    def close(self) -> None:
        """Close the bus."""
        wire, self._wire = self._wire, None
        self._counts.dropped += len(self._waiting)
        self._waiting.clear()
        if wire is not None:
            self._overruns_before += wire.overruns
            try:
                wire.shutdown()
            except Exception as error:  # drivers raise all kinds
                log.debug("closing: %s", error)
