"""The python-can adapter against buses that fail as the kernel does."""

from __future__ import annotations

import errno
import itertools

import can
import pytest

from fakes import FakeClock, ScriptedBus
from soilbus.can.bus import LONGEST_BACK_OFF, BusError, LiveBus, open_bus
from soilbus.can.publish import Frame

FRAME = Frame(0x18FF609A, True, bytes(8))


def live(opener, clock) -> LiveBus:
    return LiveBus(opener, clock, clock.sleep)


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
    clock = FakeClock()
    tries: list[float] = []

    def opener():
        tries.append(clock.now)
        raise BusError("bus can0: no such device", may_come=True)

    bus = live(opener, clock)
    begin = clock.now
    while clock.now < begin + 20.0:
        before = clock.now
        assert bus.receive(0.1) is None
        assert clock.now - before <= 0.1 + 1e-9
        assert not bus.send(FRAME)
    gaps = [b - a for a, b in itertools.pairwise(tries)]
    assert gaps == sorted(gaps) or max(gaps) <= LONGEST_BACK_OFF + 0.11
    assert gaps[0] < 0.25
    assert max(gaps) <= LONGEST_BACK_OFF + 0.11
    assert bus.counts.dropped > 0


def test_error_frames_are_counted_not_handed_on():
    clock = FakeClock()
    wire = ScriptedBus(clock, [can.Message(timestamp=1.7e9, is_error_frame=True), can.Message(timestamp=1.7e9)])
    bus = live(lambda: wire, clock)
    bus.open()
    assert bus.receive(1.0) is None
    assert bus.receive(1.0) is not None
    assert bus.counts.error_frames == 1


@pytest.mark.parametrize("number", [errno.ENETDOWN, errno.ENODEV, errno.EIO])
def test_a_send_that_finds_the_bus_gone_closes_it(number):
    clock = FakeClock()
    wire = ScriptedBus(clock)
    wire.fail_send.append(can.CanOperationError("gone", number))
    bus = live(lambda: wire, clock)
    bus.open()
    assert not bus.send(FRAME)
    assert not bus.is_open
    assert wire.closed
    clock.now += 5.0
    bus.receive(0.0)
    assert bus.is_open
    assert bus.counts.reopened == 1


def test_a_full_queue_keeps_the_bus_open():
    clock = FakeClock()
    wire = ScriptedBus(clock)
    wire.fail_send.append(can.CanOperationError("full", errno.ENOBUFS))
    bus = live(lambda: wire, clock)
    bus.open()
    assert not bus.send(FRAME)
    assert bus.is_open
    assert bus.send(FRAME)
    assert (bus.counts.sent, bus.counts.dropped) == (1, 1)
