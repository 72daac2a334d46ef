"""Bars and charts of characters: one cell a column of time, eighths of a cell as height.

None is a gap: where nothing is known nothing is drawn, and never a zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

RISING = " ▁▂▃▄▅▆▇█"
"""Cells filled from below, by eighths."""
GROWING = " ▏▎▍▌▋▊▉█"
"""Cells filled from the left, by eighths."""

Series = Sequence[float | None]


def bar(value: float | None, top: float, width: int) -> str:
    """Return a bar of `width` cells that is full at `top`; empty below zero and where the value is not known."""
    if value is None or top <= 0.0:
        return " " * width
    eighths = round(8 * width * min(max(value / top, 0.0), 1.0))
    return ("█" * (eighths // 8) + GROWING[eighths % 8].strip()).ljust(width)


def place(value: float, top: float, width: int) -> int:
    """Return the index of the cell of a bar at which a value lies."""
    return min(max(int(width * value / top), 0), width - 1)


def sparkline(values: Series) -> str:
    """Return one line, from the smallest to the largest value; a value that hardly changes is drawn in the middle."""
    known = [value for value in values if value is not None]
    low, high = min(known, default=0.0), max(known, default=0.0)
    if high - low <= 0.02 * max(abs(high), abs(low)):
        return "".join(" " if value is None else RISING[4] for value in values)
    return "".join(" " if value is None else RISING[1 + round(7 * (value - low) / (high - low))] for value in values)


def area(values: Series, height: int, top: float, limits: Series = ()) -> list[str]:
    """Return the lines of a chart from 0 to `top`, one value a column, filled from below; limits are a line."""
    rows = [[" "] * len(values) for _ in range(height)]
    for column, limit in enumerate(limits):
        if limit is not None:
            rows[height - 1 - place(limit, top, height)][column] = "─"
    for column, value in enumerate(values):
        if value is None or not math.isfinite(value):
            continue
        eighths = round(8 * height * min(max(value / top, 0.0), 1.0))
        for row in range(height):
            if filled := min(max(eighths - 8 * row, 0), 8):
                rows[height - 1 - row][column] = RISING[filled]
    return ["".join(row) for row in rows]
