"""The kernel's frames as python-can reads them; a datagram socket stands in for the CAN socket where it can."""

import errno
import math
import socket
import struct
import time
from types import SimpleNamespace

import can
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame, dissect_can_frame
from hypothesis import given
from hypothesis import strategies as st

from soilbus.can.publish import Frame
from soilbus.can.wire import MessageWire, SocketWire, error_number, wire_of

STAMPS, OVERFLOWS, CONFIRM = 35, 40, 0x800
DELIVERY = 0.0005, 0.002
"""Seconds from a frame's stamp to the socket: the kernel may need the first, and the second is never waited for."""


class Kernel(SimpleNamespace):
    """A socket that hands out (raw, control messages, flags) or raises; keeps what is sent."""

    def __init__(self, *coming) -> None:
        super().__init__(coming=list(coming), out=[], options=[])

    def fileno(self) -> int:
        return 0

    def setblocking(self, wait: bool) -> None:
        self.blocking = wait

    def setsockopt(self, *option: int) -> None:
        self.options.append(option)

    def getsockopt(self, *option: int) -> int:
        return {(socket.SOL_SOCKET, socket.SO_RCVBUF): 425_984}[option]

    def recvmsg(self, *_):
        if not self.coming:
            raise BlockingIOError
        raw, control, flags = self.coming.pop(0)
        return raw, control, flags, ("vcan0",)

    def send(self, raw: bytes) -> None:
        self.out.append(raw)


def wire(kernel) -> SocketWire:
    return SocketWire(SimpleNamespace(shutdown=lambda: None), kernel)


def stamp(t: float = 0.0):
    return (socket.SOL_SOCKET, STAMPS, struct.pack("@ll", int(t), round(t % 1.0 * 1e9)))


def overflow(n: int):
    return (socket.SOL_SOCKET, OVERFLOWS, struct.pack("@I", n))


def send_all(mouth: SocketWire, n: int) -> None:
    for _ in range(n):
        mouth.send(Frame(0x123, False, bytes(8)))


messages = st.builds(
    lambda extended, i, data, kind: can.Message(
        arbitration_id=i & (0x1FFFFFFF if extended else 0x7FF),
        is_extended_id=extended,
        data=b"" if kind == "remote" else data,
        is_remote_frame=kind == "remote",
        is_fd=kind == "fd",
    ),
    st.booleans(),
    st.integers(0, 0x1FFFFFFF),
    st.binary(max_size=8),
    st.sampled_from(["data", "remote", "fd"]),
)


@given(messages, st.floats(0.0, 2e9))
def test_frames_are_read_as_python_can_builds_them(message, t):
    frame = wire(Kernel((build_can_frame(message), [stamp(t)], 0))).recv(0.0)
    assert (frame.arbitration_id, frame.is_extended_id) == (message.arbitration_id, message.is_extended_id)
    assert (frame.is_remote_frame, frame.is_error_frame) == (message.is_remote_frame, False)
    assert frame.is_fd == message.is_fd
    assert frame.data == bytes(message.data)
    assert frame.timestamp == pytest.approx(t, abs=1e-6)


@given(st.booleans(), st.integers(0, 0x1FFFFFFF), st.binary(max_size=8))
def test_frames_are_sent_as_python_can_reads_them(extended, i, data):
    kernel = Kernel()
    i &= 0x1FFFFFFF if extended else 0x7FF
    wire(kernel).send(Frame(i, extended, data))
    can_id, length, _, got = dissect_can_frame(kernel.out[0])
    assert can_id == i | (extended << 31)
    assert (length, got[:length]) == (len(data), data)
    assert len(kernel.out[0]) == 16


def test_error_frames_keep_their_class_and_data():
    raw = struct.pack("=IB3x8s", 1 << 29 | 0x204, 8, bytes((0, 0x20, 0, 0, 0, 0, 96, 128)))
    frame = wire(Kernel((raw, [stamp()], 0))).recv(0.0)
    assert frame.is_error_frame
    assert (frame.arbitration_id, frame.data[1]) == (0x204, 0x20)


def test_overruns_are_what_the_kernel_counts_on_top_also_past_its_end():
    raw = bytes(16)
    counts = [None, 3, 3, 10, 2**32 - 1, 4]
    kernel = Kernel(*((raw, [stamp()] + ([] if n is None else [overflow(n)]), 0) for n in counts))
    ear = wire(kernel)
    assert (socket.SOL_SOCKET, OVERFLOWS, 1) in kernel.options
    assert (socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1) in kernel.options  # else the kernel hides them
    seen = []
    for _ in counts:
        ear.recv(0.0)
        seen.append(ear.overruns)
    assert seen == [0, 3, 3, 10, 2**32 - 1, 2**32 + 4]


def test_a_frame_of_this_very_socket_is_passed_over():
    ear = wire(Kernel((bytes(16), [stamp()], CONFIRM), (bytes(16), [stamp()], 0)))
    assert ear.recv(0.0) is None
    assert ear.recv(0.0) is not None


def test_all_is_heard_up_to_now_where_no_frame_waits():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, theirs:
        ours.setsockopt(socket.SOL_SOCKET, STAMPS, 1)
        ear, before = wire(ours), time.time()
        assert before - DELIVERY[1] <= ear.heard_until() <= ear.stamping_time() - DELIVERY[0]
        theirs.send(bytes(16))
        assert ear.heard_until() == -math.inf
        stamped = ear.recv(0.0).timestamp
        assert ear.heard_until() > stamped - DELIVERY[1]


def test_a_real_socket_waits_as_long_as_asked_and_no_longer():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, theirs:
        ours.setsockopt(socket.SOL_SOCKET, STAMPS, 1)
        ear = wire(ours)
        for timeout in (0.0, 0.002, 0.05):
            begin = time.monotonic()
            assert ear.recv(timeout) is None
            assert timeout <= time.monotonic() - begin < timeout + 1.0
        before = time.time()
        theirs.send(struct.pack("=IB3x8s", 0x123, 8, b"soilbus!"))
        frame = ear.recv(1.0)
        assert (frame.arbitration_id, frame.data) == (0x123, b"soilbus!")
        assert before - 0.01 <= frame.timestamp <= time.time() + 0.01
        with pytest.raises(BlockingIOError) as full:
            send_all(ear, 100_000)
        assert error_number(full.value) == errno.EAGAIN
        theirs.close()
        with pytest.raises(OSError, match=r"refused|reset") as gone:
            ear.send(Frame(0x123, False, bytes(8)))
        assert error_number(gone.value) != errno.EAGAIN


def test_python_cans_own_full_buffer_has_no_number():
    assert error_number(can.CanOperationError("Transmit buffer full")) == errno.EAGAIN
    assert error_number(can.CanOperationError("down", errno.ENETDOWN)) == errno.ENETDOWN
    assert error_number(can.CanInitializationError("no")) is None


def test_what_has_no_kernel_socket_goes_by_python_can():
    with (
        can.Bus(interface="virtual", channel="test-wire") as mouth,
        can.Bus(interface="virtual", channel="test-wire") as ear,
    ):
        wires = wire_of(mouth), wire_of(ear)
        assert all(isinstance(w, MessageWire) for w in wires)
        wires[0].send(Frame(0x18FF649A, True, b"12345678"))
        heard = wires[1].recv(1.0)
        assert (heard.arbitration_id, heard.is_extended_id, bytes(heard.data)) == (0x18FF649A, True, b"12345678")
