"""Lines through what was just seen, with exponential forgetting: where a quantity is and where it goes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LONG, SHORT = 2.5, 0.8
"""Time constants [s] of forgetting a capacity: of ground that softens over many metres, and of a soft patch's edge."""
SCATTER = 10.0
"""Time constant [s] of forgetting how much a capacity scatters."""
RISE = 4.0
"""Time constant [s] of forgetting a demand, of which a line is to show a rise and not a swing."""
SWINGS = 20.0
"""Time constant [s] of forgetting how a demand swings."""
SWING = 1.5
"""Time [s] after which a demand that swings is another: draft swings within some seconds."""
LAG = 0.5
"""Time [s] after which a capacity's scatter is another: neither the same samples nor the same metre of ground."""
ENOUGH = 0.4
"""Share of the last moments that must tell the capacity for its trend to be believed."""


class Line(NamedTuple):
    """Value now, slope [1/s], and sum of squares [s^2] by which the moments lie apart."""

    value: float
    slope: float
    spread: float


class Trend(NamedTuple):
    """A line through past values with exponential forgetting: sums of 1, x, x^2, y and x y, x [s] counted from now."""

    n: float = 0.0
    x: float = 0.0
    xx: float = 0.0
    y: float = 0.0
    xy: float = 0.0

    def joined(self, step: float, value: float | None, memory: float) -> Trend:
        """The trend a step [s] later, with one more value or none; memory is the time constant [s] of forgetting."""
        kept = math.exp(-step / memory)
        n, x, xx, y, xy = self
        n, x, xx, y, xy = kept * n, kept * x, kept * xx, kept * y, kept * xy
        later_x, later_xx, later_xy = x - step * n, xx - 2.0 * step * x + step**2 * n, xy - step * y
        if value is None:
            return Trend(n, later_x, later_xx, y, later_xy)
        return Trend(n + 1.0, later_x, later_xx, y + value, later_xy)

    def line(self) -> Line:
        """The line; it lies flat where all values are of one time."""
        spread = self.n * self.xx - self.x**2
        slope = (self.n * self.xy - self.x * self.y) / spread if spread > 1e-9 * self.n**2 else 0.0
        return Line((self.y - slope * self.x) / self.n, slope, spread / self.n)

    @property
    def mean(self) -> float:
        """Of the values, the last ones counting most; 0 where there are none."""
        return self.y / self.n if self.n > 0.0 else 0.0


def _trends(x: Array, series: Sequence[Array], memories: Sequence[float]) -> list[Trend]:
    """The trend of each series of values (N,) at times x [s] counted from now, with its memory [s]; nan is none."""
    y = np.array(series, float)
    known = np.isfinite(y)
    weight = np.exp(x / np.array(memories)[:, None]) * known
    y, wx = np.where(known, y, 0.0), weight * x
    sums = (weight.sum(axis=1), wx.sum(axis=1), wx @ x, (weight * y).sum(axis=1), (wx * y).sum(axis=1))
    return [Trend(*of_one) for of_one in np.transpose(sums).tolist()]


def _estimated(squares: Trend, alike: float) -> float:
    """Mean of squares of which so many say the same, widened as poorly known of few (as Student's t); inf of none."""
    return squares.mean * (1.0 + 2.0 * alike / squares.n) if squares.n > 0.0 else math.inf


class Capacity(NamedTuple):
    """Trends of the capacity [N] with the long and the short memory, and what they are worth.

    told: which moments tell it (1 or 0); scatter: square of its change within LAG [N^2].
    """

    long: Trend = Trend()
    short: Trend = Trend()
    told: Trend = Trend()
    scatter: Trend = Trend()

    @classmethod
    def through(cls, t: Array, values: Array) -> Capacity:
        """Of values [N] at times t [s], both (N,); nan is none."""
        if not len(t):
            return cls()
        x = t - t[-1]
        change = (values - values[np.searchsorted(t, t - LAG)]) ** 2
        change[0] = np.nan
        return cls(*_trends(x, [values, values, np.isfinite(values), change], [LONG, SHORT, SHORT, SCATTER]))

    def joined(self, step: float, value: float | None, earlier: float | None) -> Capacity:
        """A step [s] later, with one more value or none; earlier is that of LAG before."""
        change = None if value is None or earlier is None else (value - earlier) ** 2
        return Capacity(
            self.long.joined(step, value, LONG),
            self.short.joined(step, value, SHORT),
            self.told.joined(step, float(value is not None), SHORT),
            self.scatter.joined(step, change, SCATTER),
        )

    @property
    def is_told(self) -> bool:
        """Whether enough of the last moments tell it."""
        return self.told.y > ENOUGH * self.told.n

    def slope_std(self, line: Line) -> float:
        """Of one of the two lines' slopes [N/s], at most: old moments are forgotten, but count as if they were not.

        Changes within LAG, twice the variance of the scatter, hold little of a slow change of the ground.
        inf where none is known, as when wheels pull again that have rolled for long.
        """
        in_lag = LAG / SHORT * self.told.n
        variance = _estimated(self.scatter, in_lag) / 2.0
        return math.sqrt(in_lag * variance / line.spread) if line.spread > 0.0 else math.inf


class Demand(NamedTuple):
    """Trend of a demand [N] and how much it swings about it.

    swing: square of its change within SWING beyond the change in the SWING before [N^2], which is none on any line.
    """

    trend: Trend = Trend()
    swing: Trend = Trend()

    def joined(self, step: float, value: float, earlier: float | None, earliest: float | None) -> Demand:
        """A step [s] later, with one more value; earlier and earliest are those of SWING and of twice SWING before."""
        change = None if earlier is None or earliest is None else (value - 2.0 * earlier + earliest) ** 2
        return Demand(self.trend.joined(step, value, RISE), self.swing.joined(step, change, SWINGS))

    @property
    def swing_std(self) -> float:
        """Standard deviation [N] of the swing, inf where it is not known.

        The square of a change beyond the change before is six times the variance of values without relation.
        """
        return math.sqrt(_estimated(self.swing, self._in_swing) / 6.0)

    def slope_std(self, line: Line) -> float:
        """Of the line's slope [N/s] by the swing alone, at most: values within SWING count as one."""
        return self.swing_std * math.sqrt(self._in_swing / line.spread) if line.spread > 0.0 else math.inf

    @property
    def _in_swing(self) -> float:
        """Values within SWING."""
        return SWING / RISE * self.trend.n


class Peaks(NamedTuple):
    """The greatest value since the time `since` [s], and in the `hold` [s] before it."""

    since: float = -math.inf
    now: float = -math.inf
    before: float = -math.inf

    def joined(self, t: float, value: float, hold: float) -> Peaks:
        """With one more value."""
        if t - self.since > hold:
            return Peaks(t, value, self.now)
        return self._replace(now=max(self.now, value))

    @property
    def greatest(self) -> float:
        """Of all that is remembered."""
        return max(self.now, self.before)
