"""The python-can adapter against buses that fail as the kernel does."""

import contextlib
import errno
import itertools
import math
import socket
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fakes import FakeClock, ScriptedBus
from soilbus.can.bus import BusError, LiveBus, ask_for_buffer, open_bus
from soilbus.can.publish import Frame
from soilbus.daemon.bus_health import health_text

FRAME = Frame(0x18FF609A, True, bytes(8))
SO_RCVBUFFORCE = 33
"""Linux's number of the socket option (asm-generic/socket.h); Python has no name for it."""
BUFFER = 4 * 2**20
"""Bytes that systemd/soilbus.sysctl lets the service have."""
BACK_WITHIN = 1.15
"""Seconds within which a bus that is back must be found, so that frames go out again in two."""
CYCLE = 0.1
"""Seconds after which the next frame of an identifier is made: one that waited longer says nothing."""
AGAIN_WITHIN = 0.01
"""Seconds within which frames that wait for room are tried again: a tenth of their cycle."""


def live(opener, clock) -> LiveBus:
    return LiveBus(opener, clock, clock.sleep)


def opened(messages=(), own=()) -> tuple[LiveBus, ScriptedBus, FakeClock]:
    """A bus that is open and hears these messages, its wire and the clock."""
    clock = FakeClock()
    wire = ScriptedBus(clock, messages)
    bus = LiveBus(lambda: wire, clock, clock.sleep, own)
    bus.open()
    return bus, wire, clock


def tried(opening, looks: float, sends: bool = False) -> tuple[LiveBus, list[float]]:
    """A bus whose wires come from `opening` and which is looked at so often for 20 s, and when it was opened.

    `sends`: a frame is offered besides, for which there is no bus.
    """
    clock, tries = FakeClock(), []
    bus = live(lambda: tries.append(clock.now) or opening(clock), clock)
    begin = clock.now
    while clock.now < begin + 20.0:
        before = clock.now
        assert bus.receive(looks) is None
        assert clock.now - before <= looks + 1e-9
        assert not (sends and bus.send(FRAME))
    return bus, tries


def test_an_unknown_interface_is_one_line_and_will_not_come():
    with pytest.raises(BusError) as caught:
        open_bus({"interface": "nosuch", "channel": "x"})
    assert not caught.value.may_come
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("number", "may_come"), [(errno.ENODEV, True), (errno.ENETDOWN, True), (errno.EAFNOSUPPORT, False)]
)
def test_whether_waiting_helps_is_told_by_the_kernels_error(monkeypatch, number, may_come):
    def refuse(**_):
        raise OSError(number, "refused")

    monkeypatch.setattr(can, "Bus", refuse)
    with pytest.raises(BusError) as caught:
        open_bus({"interface": "socketcan", "channel": "can7"})
    assert caught.value.may_come is may_come
    assert "can7" in str(caught.value)


def test_as_much_buffer_is_taken_as_this_user_may_have():
    limit = int(Path("/proc/sys/net/core/rmem_max").read_text())
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as own:
        with contextlib.suppress(PermissionError):
            own.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, limit + 1)
            limit = BUFFER  # an administrator's
        ask_for_buffer(own)
        assert own.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == 2 * min(limit, BUFFER)


def test_frames_cross_a_virtual_bus_and_filters_hold():
    settings = {"interface": "virtual", "channel": "test-filters"}
    filters = [{"can_id": FRAME.arbitration_id, "can_mask": 0x1FFFFFFF, "extended": True}]
    with open_bus(settings, filters) as ear, open_bus(settings) as mouth:
        clock = FakeClock()
        bus = live(lambda: mouth, clock)
        bus.open()
        mouth.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\1"))
        assert bus.send(FRAME)
        received = ear.recv(1.0)
        assert (received.arbitration_id, received.is_extended_id, bytes(received.data)) == (
            FRAME.arbitration_id, True, FRAME.data,
        )  # fmt: skip
        assert ear.recv(0.0) is None


def test_a_bus_that_stays_away_is_tried_with_back_off_and_never_blocks():
    def away(clock):
        raise BusError("bus can0: no such device", may_come=True)

    bus, tries = tried(away, 0.1, sends=True)
    gaps = [b - a for a, b in itertools.pairwise(tries)]
    assert gaps[0] < 0.25
    assert max(gaps) <= BACK_WITHIN
    assert bus.counts.dropped > 0


def test_error_frames_are_counted_not_handed_on():
    bus, _, _ = opened([can.Message(timestamp=1.7e9, is_error_frame=True), can.Message(timestamp=1.7e9)])
    assert bus.receive(1.0) is None
    assert bus.receive(1.0) is not None
    assert bus.counts.error_frames == 1


@pytest.mark.parametrize("number", [errno.ENETDOWN, errno.ENODEV, errno.EIO])
def test_a_send_that_finds_the_bus_gone_closes_it(number):
    bus, wire, clock = opened()
    wire.fail_send.append(can.CanOperationError("gone", number))
    assert not bus.send(FRAME)
    assert not bus.is_open
    assert wire.closed
    clock.now += 5.0
    bus.receive(0.0)
    assert bus.is_open
    assert bus.counts.reopened == 1


def test_a_full_queue_keeps_the_bus_open():
    bus, wire, _ = opened()
    wire.fail_send.append(can.CanOperationError("full", errno.ENOBUFS))
    assert not bus.send(FRAME)
    assert bus.is_open
    assert bus.send(FRAME)
    assert (bus.counts.sent, bus.counts.dropped) == (1, 1)


def test_a_frame_that_waits_goes_out_with_the_next_look_and_never_blocks():
    bus, wire, clock = opened()
    wire.full_until = clock.now + 0.03
    assert not bus.send(FRAME)
    while not wire.sent:
        before = clock.now
        assert bus.receive(1.0) is None
        assert clock.now - before <= AGAIN_WITHIN
    assert clock.now <= wire.full_until + AGAIN_WITHIN
    assert (bus.counts.sent, bus.counts.dropped) == (1, 0)


def test_nothing_that_waited_is_sent_when_the_bus_comes_back():
    bus, wire, clock = opened()
    wire.full_until = clock.now + 0.05
    bus.send(FRAME)
    wire.fail_receive.append(OSError(errno.ENODEV, "No such device"))
    bus.receive(0.0)
    assert not bus.is_open
    while not bus.is_open:
        bus.receive(0.02)
    bus.receive(0.2)
    assert wire.sent == []
    assert (bus.counts.dropped, bus.counts.lost, bus.counts.reopened) == (1, 1, 1)


def test_a_bus_that_opens_and_fails_at_once_is_not_tried_all_the_time():
    def failing(clock):
        wire = ScriptedBus(clock)
        wire.fail_receive.append(can.CanOperationError("Network is down", errno.ENETDOWN))
        return wire

    _, tries = tried(failing, 0.02)
    assert 19 <= len(tries) <= 26
    assert max(b - a for a, b in itertools.pairwise(tries)) <= BACK_WITHIN


OWN = (0x18FF649A, True)


@pytest.mark.parametrize(
    ("message", "foreign"),
    [
        (can.Message(timestamp=1.7e9, arbitration_id=OWN[0], data=bytes(8)), 1),
        (can.Message(timestamp=1.7e9, arbitration_id=OWN[0], data=bytes(8), is_rx=False), 0),  # an echo of ours
        (can.Message(timestamp=1.7e9, arbitration_id=OWN[0], is_remote_frame=True), 0),  # somebody asks for it
    ],
)
def test_our_own_identifiers_are_never_handed_on(message, foreign):
    bus, _, clock = opened([message, can.Message(timestamp=1.7e9, arbitration_id=0x64A)], [OWN])
    assert bus.receive(0.1) is None
    assert bus.receive(0.1) is not None
    assert (bus.counts.foreign, bus.counts.received) == (foreign, 1)
    assert (bus.last_foreign == clock.now) == bool(foreign)


def test_faults_that_last_are_said_once_in_a_while(caplog):
    bus, wire, clock = opened([can.Message(timestamp=1.7e9, arbitration_id=OWN[0], data=bytes(8))] * 1000, [OWN])
    wire.full_until = clock.now + 1e9
    for _ in range(1000):
        bus.receive(0.0)
        bus.send(FRAME)
        clock.now += 0.1
    assert bus.counts.foreign == 1000
    assert bus.counts.dropped == 999
    texts = [r.getMessage() for r in caplog.records]
    assert sum("another node" in t for t in texts) == sum("queue full" in t for t in texts) == 2
    assert len(texts) == 4


@pytest.mark.parametrize("error", [ValueError("invalid literal for int()"), IndexError("string index out of range")])
def test_a_frame_that_the_driver_cannot_read_is_counted_and_the_next_one_comes(error):
    bus, wire, _ = opened([can.Message(timestamp=1.7e9)])
    wire.fail_receive.append(error)
    assert bus.receive(1.0) is None
    assert not bus.found_nothing  # other frames may wait behind it
    assert bus.receive(1.0) is not None
    assert (bus.counts.garbled, bus.counts.received, bus.counts.lost) == (1, 1, 0)
    assert "1 frames that the driver could not read" in health_text(bus.state, bus.counts)


def test_a_driver_that_only_garbles_is_opened_anew():
    class Garbling(ScriptedBus):
        def recv(self, timeout=None):
            self.clock.now += 0.01
            raise UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte")

    bus, times = tried(Garbling, 0.02)
    assert 8 <= len(times) <= 20
    assert bus.counts.garbled > 500


def test_only_silence_counts_as_nothing_to_take():
    theirs = can.Message(timestamp=1.7e9, arbitration_id=OWN[0], data=bytes(8))
    bus, _, _ = opened([theirs, can.Message(timestamp=1.7e9, is_error_frame=True)], [OWN])
    found_nothing = []
    for _ in range(3):
        assert bus.receive(0.1) is None
        found_nothing.append(bus.found_nothing)
    assert found_nothing == [False, False, True]
    assert (bus.counts.foreign, bus.counts.error_frames) == (1, 1)


def numbered(identifier: int, content: int = 0) -> Frame:
    return Frame(identifier, True, bytes((content,)))


def full() -> tuple[LiveBus, ScriptedBus, FakeClock]:
    """A bus without room, its wire and the clock."""
    bus, wire, clock = opened()
    wire.full_until = math.inf
    return bus, wire, clock


def given_room(bus: LiveBus, wire: ScriptedBus) -> list[tuple[int, int]]:
    """Identifiers and contents of what goes out while there is room."""
    before, wire.full_until = len(wire.sent), 0.0
    bus.receive(0.0)
    wire.full_until = math.inf
    return [(message.arbitration_id, message.data[0]) for _, message in wire.sent[before:]]


def test_a_newer_frame_takes_the_place_and_the_turn_of_the_older():
    bus, wire, _ = full()
    for identifier, content in ((1, 0), (2, 0), (1, 7)):
        bus.send(numbered(identifier, content))
    assert given_room(bus, wire) == [(1, 7), (2, 0)]
    assert bus.counts.dropped == 1


def test_late_frames_are_dropped():
    bus, wire, clock = full()
    bus.send(numbered(1))
    clock.now += 0.05
    bus.send(numbered(2))
    clock.now += CYCLE - 0.03
    assert given_room(bus, wire) == [(2, 0)]
    bus.send(numbered(3))
    clock.now += CYCLE + 0.01
    assert given_room(bus, wire) == []
    assert bus.counts.dropped == 2


@given(st.lists(st.integers(0, 5) | st.sampled_from(["room", "away"]), max_size=60), st.floats(0.0, 0.05))
def test_every_frame_is_sent_or_dropped_and_none_is_sent_late_or_after_a_newer_one(actions, pause):
    bus, wire, clock = full()
    newest: dict[int, int] = {}
    made: dict[int, float] = {}
    put = 0
    for action in actions:
        clock.now += pause
        if action == "room":
            for identifier, content in given_room(bus, wire):
                assert content == newest[identifier] % 256
                assert clock.now - made[identifier] <= CYCLE + 0.001
        elif action == "away":
            bus.close()
            bus.open()
        else:
            put += 1
            newest[action], made[action] = put, clock.now
            bus.send(numbered(action, put % 256))
    bus.close()
    assert put == bus.counts.sent + bus.counts.dropped == len(wire.sent) + bus.counts.dropped
