"""Small distances on the ellipsoid against geodesics."""

import math

import numpy as np
import pytest

from soilbus.terra.earth import moved, offset, wrapped


@pytest.mark.parametrize(
    ("latitude", "longitude", "north", "east", "expected"),
    [
        # Karney's geodesics (geographiclib 2.1, Geodesic.WGS84.Direct) of that length and azimuth at the middle
        (52.4, 12.5, 1000.0, 0.0, (52.40898674250, 12.50000000000)),
        (52.4, 12.5, 0.0, 1000.0, (52.40000000000, 12.51469200929)),
        (-33.9, 151.2, 700.0, -700.0, (-33.89368917516, 151.19243213048)),
        (0.1, -179.9995, -300.0, -950.0, (0.09728689165, 179.99196599224)),
        (70.0, 20.0, 600.0, 800.0, (70.00537817243, 20.02095248962)),
        (80.0, -60.0, 3.0, 400.0, (80.00002686729, -59.97937448978)),
    ],
)
def test_moved_agrees_with_geodesics_to_a_tenth_of_a_millimetre(latitude, longitude, north, east, expected):
    end = moved(math.radians(latitude), math.radians(longitude), np.array([north]), np.array([east]))
    metres = 6371e3 * np.array([1.0, math.cos(end[0][0])]) * (np.ravel(end) - np.radians(expected))
    assert np.abs(metres).max() < 1e-4
    back = offset(math.radians(latitude), math.radians(longitude), *end)
    assert np.ravel(back) == pytest.approx([north, east], abs=1e-4)


def test_a_minute_of_latitude_is_a_nautical_mile_on_average():
    """WGS84's meridian: 1842.9 m at the equator, 1861.6 m at the poles (NIMA TR8350.2)."""
    for latitude, metres in ((0.0, 1842.9), (45.0, 1852.2)):
        there, _ = moved(math.radians(latitude), 0.0, np.array([metres]), np.zeros(1))
        assert math.degrees(there[0]) - latitude == pytest.approx(1.0 / 60.0, rel=1e-4)


def test_wrapped():
    degrees = np.array([-540.0, -181.0, -180.0, 0.0, 179.5, 180.5, 359.0])
    assert np.degrees(wrapped(np.radians(degrees))) == pytest.approx([-180.0, 179.0, -180.0, 0.0, 179.5, -179.5, -1.0])
    assert math.degrees(wrapped(math.radians(-179.9) - math.radians(179.9))) == pytest.approx(0.2)
