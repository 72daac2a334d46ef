"""Where on the earth the simulated tractor drives: along a straight line, or up and down the rows of a field.

    row number = distance // (row + pi spacing / 2),   a half circle of diameter `spacing` at each row's end

Only the positions that the receiver reports depend on the course. The wheels do not feel the turns, and soils follow
one another along the distance driven, not across the field.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.earth import moved

__all__ = ["NORTHWARD", "Course", "course", "positions"]


@dataclass(frozen=True, slots=True)
class Course:
    """Course of a drive over the ground: a start [rad], the heading [rad] of the first row clockwise from north, rows.

    A row is `row` [m] long, inf for a straight line; each lies `spacing` [m] to the right of the one before.
    """

    latitude: float = math.radians(52.43)
    longitude: float = math.radians(12.53)
    heading: float = 0.0
    row: float = math.inf
    spacing: float = 3.0

    def __post_init__(self) -> None:
        """Raise ValueError for a course that cannot be driven."""
        if not (abs(self.latitude) <= math.radians(80.0) and abs(self.longitude) <= math.pi):
            raise ValueError("start: latitude must be within 80 degrees, longitude within 180")
        if not math.isfinite(self.heading):
            raise ValueError("heading: must be a number")
        if not (self.row > 0.0 and 0.0 < self.spacing < math.inf):
            raise ValueError("rows: length and spacing must be above zero")


def course(start: Sequence[float] | None = None, heading: float = 0.0, rows: Sequence[float] | None = None) -> Course:
    """Return a course from a start [deg], a heading [deg] clockwise from north, and length and spacing of rows [m].

    ValueError for one that cannot be driven.
    """
    from_start = {} if start is None else dict(zip(("latitude", "longitude"), map(math.radians, start), strict=True))
    in_rows = {} if rows is None else dict(zip(("row", "spacing"), rows, strict=True))
    return Course(**from_start, heading=math.radians(heading), **in_rows)


NORTHWARD = Course()
"""A straight line north through Brandenburg."""


def positions(course: Course, distance: Array) -> tuple[Array, Array]:
    """Return the latitudes and longitudes [rad] (N,) at these distances [m] (N,) on a course."""
    ahead, right = _in_field(course, distance)
    sine, cosine = math.sin(course.heading), math.cos(course.heading)
    north, east = cosine * ahead - sine * right, sine * ahead + cosine * right
    return moved(course.latitude, course.longitude, north, east)


def _in_field(course: Course, distance: Array) -> tuple[Array, Array]:
    """Metres along the first row and to its right."""
    if math.isinf(course.row):
        return distance, np.zeros_like(distance)
    radius = course.spacing / 2.0
    number, since = np.divmod(distance, course.row + math.pi * radius)
    angle = np.maximum(since - course.row, 0.0) / radius
    along = np.minimum(since, course.row) + radius * np.sin(angle)
    ahead = np.where(number % 2 == 0, along, course.row - along)
    return ahead, number * course.spacing + radius * (1.0 - np.cos(angle))
