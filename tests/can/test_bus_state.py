"""Error frames as drivers build them, and what the service makes of them."""

import can
import pytest

from fakes import FakeClock, ScriptedBus
from soilbus.can.bus import BusState, LiveBus, state_told, tells_overflow

CONTROLLER, PROTOCOL, NO_ACK, BUS_OFF, BUS_ERROR, RESTARTED, COUNTERS = 0x4, 0x8, 0x20, 0x40, 0x80, 0x100, 0x200


@pytest.mark.parametrize(
    ("error_class", "controller", "state"),
    [
        (CONTROLLER, 0x04, BusState.WARNING),  # by received frames
        (CONTROLLER, 0x08, BusState.WARNING),  # by sent frames
        (CONTROLLER, 0x10, BusState.PASSIVE),
        (CONTROLLER | COUNTERS, 0x20, BusState.PASSIVE),
        (CONTROLLER, 0x28, BusState.PASSIVE),  # the worse one
        (CONTROLLER, 0x40, BusState.ACTIVE),
        (CONTROLLER | BUS_OFF, 0x20, BusState.OFF),
        (BUS_OFF, 0, BusState.OFF),
        (RESTARTED, 0, BusState.ACTIVE),
    ],
)
def test_the_state_is_the_one_told_last(error_class, controller, state):
    for before in BusState:
        assert state_told(before, error_class, bytes((0, controller)) + bytes(6)) is state


@pytest.mark.parametrize("error_class", [CONTROLLER, PROTOCOL, NO_ACK, BUS_ERROR, COUNTERS, PROTOCOL | BUS_ERROR])
def test_other_errors_say_nothing_of_the_state(error_class):
    for before in BusState:
        assert state_told(before, error_class, bytes((0, 0x00, 0xFF, 0xFF, 0, 0, 0xFF, 0xFF))) is before
    assert state_told(BusState.PASSIVE, CONTROLLER, b"") is BusState.PASSIVE


def test_only_an_overflow_of_the_receiver_is_a_lost_frame():
    assert tells_overflow(CONTROLLER, bytes((0, 0x01)))
    assert not tells_overflow(CONTROLLER, bytes((0, 0x02)))
    assert not tells_overflow(PROTOCOL, bytes((0, 0x01)))
    assert not tells_overflow(CONTROLLER, b"")


def test_a_frame_heard_in_bus_off_ends_it_and_a_bus_that_comes_back_begins_unknown():
    clock = FakeClock()
    off = can.Message(timestamp=1.7e9, arbitration_id=BUS_OFF, is_error_frame=True, data=bytes(8))
    lost = can.Message(timestamp=1.7e9, arbitration_id=CONTROLLER, is_error_frame=True, data=bytes((0, 1)))
    heard = can.Message(timestamp=1.7e9, arbitration_id=0x123)
    wire = ScriptedBus(clock, [off, lost, heard, off])
    bus = LiveBus(lambda: wire, clock, clock.sleep)
    bus.open()
    bus.receive(0.1)
    assert bus.state is BusState.OFF
    bus.receive(0.1)
    assert (bus.state, bus.counts.error_frames, bus.counts.overruns) == (BusState.OFF, 2, 1)
    assert bus.receive(0.1) is heard
    assert bus.state is BusState.UNKNOWN
    bus.receive(0.1)
    assert bus.state is BusState.OFF
    bus.close()
    bus.open()
    assert bus.state is BusState.UNKNOWN
    assert bus.counts.overruns == 1
