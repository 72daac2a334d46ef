"""Where the simulated tractor drives."""

import math

import numpy as np
import pytest

from soilbus.simulator.course import NORTHWARD, Course, course, positions


def metres(way: Course, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """North and east of the start [m], on a sphere: right to 1 % within a field."""
    latitude, longitude = positions(way, distance)
    return 6371e3 * (latitude - way.latitude), 6371e3 * math.cos(way.latitude) * (longitude - way.longitude)


def test_a_straight_line_goes_where_it_is_headed():
    north, east = metres(course((10.0, 20.0), heading=30.0), np.array([0.0, 100.0]))
    assert (north[1], east[1]) == (
        pytest.approx(100.0 * math.cos(math.pi / 6), rel=0.01),
        pytest.approx(50.0, rel=0.01),
    )
    assert (north[0], east[0]) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_rows_are_parallel_and_joined_by_half_circles():
    way = course((52.0, 13.0), heading=90.0, rows=(40.0, 6.0))
    turn = 3.0 * math.pi
    s = np.array([0.0, 40.0, 40.0 + turn / 2, 40.0 + turn, 80.0 + turn, 80.0 + 2 * turn, 100.0 + 2 * turn])
    north, east = metres(way, s)
    ahead, right = east, -north  # headed east, south is on the right
    assert ahead == pytest.approx([0.0, 40.0, 43.0, 40.0, 0.0, 0.0, 20.0], abs=0.3)
    assert right == pytest.approx([0.0, 0.0, 3.0, 6.0, 6.0, 12.0, 12.0], abs=0.1)


@pytest.mark.parametrize("heading", [0.0, 77.0, -135.0])
def test_the_distance_driven_is_the_length_of_the_way(heading):
    s = np.arange(0.0, 300.0, 0.05)
    north, east = metres(course((52.0, 13.0), heading, rows=(40.0, 6.0)), s)
    steps = np.hypot(np.diff(north), np.diff(east))
    assert steps == pytest.approx(0.05, rel=0.02)  # no jumps
    assert np.abs(np.diff(np.unwrap(np.arctan2(np.diff(east), np.diff(north))))).max() < 0.05 / 3.0 * 1.1  # no corners


def test_across_the_antimeridian():
    _, longitude = positions(course((10.0, 179.9999), heading=90.0), np.linspace(0.0, 50.0, 11))
    assert longitude[0] > 3.14
    assert longitude[-1] < -3.14
    assert np.all(np.abs(longitude) <= math.pi)


@pytest.mark.parametrize(
    "wrong",
    [
        {"start": (81.0, 0.0)},
        {"start": (0.0, 181.0)},
        {"start": (math.nan, 0.0)},
        {"heading": math.inf},
        {"rows": (0.0, 3.0)},
        {"rows": (40.0, 0.0)},
        {"rows": (40.0, math.inf)},
        {"rows": (math.nan, 3.0)},
    ],
    ids=str,
)
def test_a_course_that_cannot_be_driven(wrong):
    with pytest.raises(ValueError, match=r"^(start|heading|rows): "):
        course(**wrong)


def test_nothing_said_is_straight_north():
    assert course() == NORTHWARD
