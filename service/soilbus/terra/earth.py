"""Small distances on the WGS84 ellipsoid (NIMA TR8350.2, 3rd ed. 2000); angles in rad."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from soilbus.arrays import Array

SEMI_MAJOR_AXIS = 6378137.0
"""[m]"""
FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)


def wrapped(longitude: ArrayLike) -> Array:
    """Return the same longitudes, or differences of longitudes, within -pi .. pi."""
    return np.asarray((np.asarray(longitude) + np.pi) % (2.0 * np.pi) - np.pi)


def moved(latitude: float, longitude: float, north: Array, east: Array) -> tuple[Array, Array]:
    """Return the latitudes and longitudes north and east [m] (N,) of a point.

    Along the meridian and the parallel of the middle latitude: right to a tenth of a
    millimetre within a kilometre, up to 80 degrees north or south.
    """
    rough = north / _radii(np.asarray(latitude))[0]
    along_meridian, across = _radii(latitude + rough / 2.0)
    change = north / along_meridian
    middle = latitude + change / 2.0
    return latitude + change, wrapped(longitude + east / (across * np.cos(middle)))


def offset(latitude: float, longitude: float, latitudes: Array, longitudes: Array) -> tuple[Array, Array]:
    """Return how far north and east [m] of a point others (N,) are; the inverse of `moved`."""
    along_meridian, across = _radii((latitude + latitudes) / 2.0)
    east = across * np.cos((latitude + latitudes) / 2.0) * wrapped(longitudes - longitude)
    return along_meridian * (latitudes - latitude), east


def _radii(latitude: Array) -> tuple[Array, Array]:
    """Radii of curvature [m] along the meridian and across it."""
    w = 1.0 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
    across = SEMI_MAJOR_AXIS / np.sqrt(w)
    return across * (1.0 - _ECCENTRICITY_SQUARED) / w, across
