"""One open bus: frames in, frames out, frames that the kernel had to drop.

python-can opens every bus.  Of SocketCAN we read the socket ourselves: python-can can neither count overruns nor send
without a select beside each frame.
"""

from __future__ import annotations

import errno
import math
import select
import socket
import struct
import time
from collections import deque
from contextlib import suppress
from typing import NamedTuple, Protocol

import can

from soilbus.can.publish import Frame

GATHER = 0.005  # pause [s] in which frames gather: the kernel has stamped them, and one waking for several is cheaper
STAMPED = 0.001
"""Seconds from a frame's stamp until it is in our socket; a later one counts from the next window on."""
ECHO_TIME, MAX_ECHOES = 1.0, 256
"""Time [s] within which a multicast frame comes back to its sender, and the number that is waited for: ours of 4 s."""
SMALL_SEND_BUFFER = 1  # the kernel's least, about six frames: no more than these can go stale in a stuck queue

_SO_RXQ_OVFL, _SO_TIMESTAMPNS = 40, 35  # asm-generic/socket.h
_MSG_CONFIRM = 0x800  # the frame is one of this very socket
_EXTENDED, _REMOTE, _ERROR = 1 << 31, 1 << 30, 1 << 29  # flags of can_id
_IDENTIFIER = (1 << 29) - 1
_HEAD = struct.Struct("=IB3x")  # can_id, length; the same in struct can_frame and canfd_frame
_FRAME = struct.Struct("=IB3x8s")
_LONGEST = 72  # of struct canfd_frame
_STAMP = struct.Struct("@ll")
_COUNT = struct.Struct("@I")
_ANCILLARY = socket.CMSG_SPACE(_STAMP.size) + socket.CMSG_SPACE(_COUNT.size)


class Received(NamedTuple):
    """Frame with what the daemon reads of python-can's Message, at less cost; the stamp is the kernel's."""

    timestamp: float
    arbitration_id: int
    is_extended_id: bool
    is_remote_frame: bool
    is_error_frame: bool
    data: bytes
    is_rx: bool = True
    is_fd: bool = False


class MessageBus(Protocol):
    """Part of python-can's interface (can.BusABC) that is used."""

    def recv(self, timeout: float | None = None, /) -> Received | can.Message | None: ...

    def send(self, message: can.Message, /) -> None: ...

    def shutdown(self) -> None: ...


class MessageWire:
    """Open bus of any interface of python-can; methods raise OSError or can.CanError (ENOBUFS, EAGAIN: no room now)."""

    overruns = 0  # frames that came and were dropped for want of room since it was opened; 0 where none can tell
    room = math.inf  # bytes of the buffer in which frames wait for us

    def __init__(self, bus: MessageBus) -> None:
        self._bus = bus

    def recv(self, timeout: float) -> Received | can.Message | None:
        """Return the next frame, or None after `timeout` [s]; frames of ours are passed over where they come back."""
        return self._bus.recv(timeout)

    def stamping_time(self) -> float:
        """Return the present time [s] by the clock that stamps frames as they come; nan where that is not known."""
        return math.nan  # devices have clocks of their own

    def heard_until(self) -> float:
        """Return the stamp [s] before which no frame can come any more; -inf where that is not known."""
        return -math.inf

    def send(self, frame: Frame) -> None:
        """Hand one frame to the driver, never waiting."""
        message = can.Message(arbitration_id=frame.arbitration_id, is_extended_id=frame.extended, data=frame.data)
        self._bus.send(message)

    def shutdown(self) -> None:
        """Close the bus."""
        self._bus.shutdown()


class SocketWire(MessageWire):
    """A raw CAN socket of the kernel."""

    def __init__(self, bus: MessageBus, own: socket.socket) -> None:
        super().__init__(bus)
        self.overruns, self.room = 0, float(own.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF))
        self._socket = own
        self._dropped = 0  # the kernel's count, modulo 2**32
        own.setblocking(False)
        own.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        own.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SMALL_SEND_BUFFER)
        with suppress(OSError):  # where the socket knows no CAN FD, none comes; else one under our id would be hidden
            own.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        self._poll = select.poll()
        self._poll.register(own, select.POLLIN)

    def recv(self, timeout: float) -> Received | None:
        frame = self._next()
        if frame is None and timeout > 0.0:
            time.sleep(min(timeout, GATHER))
            frame = self._next()
            if frame is None and timeout > GATHER and self._poll.poll(1e3 * (timeout - GATHER)):
                frame = self._next()
        return frame

    def _next(self) -> Received | None:
        try:
            raw, ancillary, flags, _ = self._socket.recvmsg(_LONGEST, _ANCILLARY)
        except BlockingIOError:
            return None
        t = math.nan
        for _, kind, data in ancillary:
            if kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _STAMP.unpack(data)
                t = seconds + 1e-9 * nanoseconds
            elif kind == _SO_RXQ_OVFL:
                (dropped,) = _COUNT.unpack(data)
                self.overruns += (dropped - self._dropped) % 2**32
                self._dropped = dropped
        if flags & _MSG_CONFIRM:
            return None
        word, length = _HEAD.unpack_from(raw)
        return Received(
            t, word & _IDENTIFIER, word & _EXTENDED != 0, word & _REMOTE != 0, word & _ERROR != 0,
            raw[8 : 8 + length], is_fd=len(raw) == _LONGEST,
        )  # fmt: skip

    def stamping_time(self) -> float:
        return time.time()

    def heard_until(self) -> float:
        now = time.time()  # a frame that is stamped is in the socket within STAMPED
        return -math.inf if self._poll.poll(0) else now - STAMPED

    def send(self, frame: Frame) -> None:
        word = frame.arbitration_id | _EXTENDED if frame.extended else frame.arbitration_id
        self._socket.send(_FRAME.pack(word, len(frame.data), frame.data))


class MulticastWire(MessageWire):
    """Multicast group, in which every sent frame comes back: known by identifier and data within ECHO_TIME."""

    def __init__(self, bus: MessageBus) -> None:
        super().__init__(bus)
        self._echoes: deque[tuple[float, int, bytes]] = deque(maxlen=MAX_ECHOES)

    def recv(self, timeout: float) -> Received | can.Message | None:
        message = super().recv(timeout)
        while self._echoes and self._echoes[0][0] <= time.monotonic() - ECHO_TIME:
            self._echoes.popleft()
        for echo in self._echoes:
            if message is not None and echo[1:] == (message.arbitration_id, message.data):
                self._echoes.remove(echo)
                return None
        return message

    def send(self, frame: Frame) -> None:
        self._echoes.append((time.monotonic(), frame.arbitration_id, frame.data))
        super().send(frame)


def wire_of(bus: MessageBus) -> MessageWire:
    """Return the wire of a bus that python-can has opened: its socket where it is the kernel's."""
    own = getattr(bus, "socket", None)
    if isinstance(own, socket.socket) and own.family == socket.AF_CAN:
        return SocketWire(bus, own)
    return MulticastWire(bus) if is_multicast(bus) else MessageWire(bus)


def is_multicast(bus: MessageBus) -> bool:
    """Return whether a bus is a multicast group of python-can (interface udp_multicast)."""
    return type(bus).__module__.startswith("can.interfaces.udp_multicast")


def error_number(error: Exception) -> int | None:
    """Return the errno of what a bus raised; EAGAIN for python-can's own full buffer."""
    if isinstance(error, OSError):
        return error.errno
    number = getattr(error, "error_code", None)
    return errno.EAGAIN if number is None and isinstance(error, can.CanOperationError) else number
