"""The bus's own time, and when a window's end is heard."""

import math
from types import SimpleNamespace

import pytest

from soilbus.daemon.bus_time import BusTime

STAMP, NOW = 1.7e9, 500.0
END = STAMP + 0.5


class Told(SimpleNamespace):
    """A bus of which `until` is heard by its own clock; it is `present` there."""

    until, present = -math.inf, math.nan

    def heard_until(self) -> float:
        return self.until

    def stamping_time(self) -> float:
        return self.present


@pytest.fixture
def bus() -> Told:
    return Told()


@pytest.fixture
def of_bus(bus) -> BusTime:
    """A frame was taken at NOW, and nothing 0.3 s later."""
    time = BusTime(bus, NOW - 60.0)
    assert time.at(NOW) == 0.0
    time.took(STAMP, NOW)
    time.took_nothing(NOW + 0.3)
    return time


def test_the_monotonic_clock_goes_on_where_the_stamps_end(of_bus):
    assert of_bus.at(NOW + 0.25) == pytest.approx(STAMP + 0.25)
    assert of_bus.at(NOW - 1.0) == STAMP


def test_a_bus_that_cannot_tell_has_grace(of_bus):
    """Frames may come a tenth of a second late; a quarter after its end a window is closed."""
    assert STAMP < of_bus.heard(END, NOW + 0.5) < STAMP + 0.3
    of_bus.took_nothing(NOW + 0.6)
    assert of_bus.heard(END, NOW + 0.6) < END
    of_bus.took_nothing(NOW + 0.75)
    assert of_bus.heard(END, NOW + 0.75) >= END


def test_a_bus_that_can_tell_has_none(of_bus, bus):
    bus.until = END + 0.002
    assert of_bus.heard(END, NOW + 0.498) == pytest.approx(END + 0.002)
    bus.until = -math.inf  # frames wait
    assert of_bus.heard(END, NOW + 0.498) < END


@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_a_clock_that_was_set_ends_no_window_that_has_not(of_bus, bus, step):
    bus.until = STAMP + 0.4 + step
    for now in (0.4, 0.48):
        assert of_bus.heard(END, NOW + now) < END
    assert of_bus.heard(END, NOW + 0.495) <= END + 0.01


def test_nobody_sleeps_past_an_end_that_the_bus_can_tell(of_bus, bus):
    assert of_bus.wait(END, NOW + 0.49, 0.02) == 0.02
    bus.present = END - 0.007
    assert 0.007 < of_bus.wait(END, NOW + 0.49, 0.02) < 0.009  # a frame needs up to a millisecond to the socket
    assert of_bus.wait(END, NOW + 0.49, 0.003) == 0.003
    assert of_bus.wait(END, NOW + 0.40, 0.02) == 0.02  # far off: the bus is not even asked
    bus.present = END + 3600.0
    assert of_bus.wait(END, NOW + 0.49, 0.02) == 0.0
    assert of_bus.wait(math.inf, NOW + 0.49, 0.02) == 0.02


def test_frames_that_waited_are_known_to_be_old_until_none_waits(bus):
    time = BusTime(bus, NOW)
    for i in range(100):  # one comes each 10 ms, one is taken each 30 ms
        time.took(STAMP + 0.01 * i, NOW + 0.03 * i)
    assert time.at(NOW + 3.0) == pytest.approx(STAMP + 3.0)
    assert time.read_until(NOW + 3.0) == pytest.approx(STAMP + 0.99)
    for i in range(100, 300):
        time.took(STAMP + 0.01 * i, NOW + 3.0)
    time.took_nothing(NOW + 3.0)
    assert time.read_until(NOW + 3.2) == time.at(NOW + 3.2) == pytest.approx(STAMP + 3.2)


@pytest.mark.parametrize("step", [-3600.0, -2.0, 0.7, 3600.0])
def test_a_clock_that_was_set_is_followed_with_the_next_frame(of_bus, step):
    of_bus.took(STAMP + 0.31 + step, NOW + 0.31)
    assert of_bus.at(NOW + 0.5) == pytest.approx(STAMP + 0.5 + step, abs=0.011)


def test_a_clock_that_runs_otherwise_than_ours_is_followed(bus):
    time = BusTime(bus, NOW)
    for rate in (1.001, 0.999):
        for i in range(20_000):
            time.took(STAMP + rate * 0.01 * i, NOW + 0.01 * i)
            time.took_nothing(NOW + 0.01 * i + 0.005)
        assert time.at(NOW + 200.0) == pytest.approx(STAMP + rate * 200.0, abs=0.01)
        time = BusTime(bus, NOW)
