"""Position of the vehicle at any time, from the fixes of a satellite receiver.

    coordinate(t) = a, from the least-squares line a + b (t_i - t) through the fixes within SMOOTHING of t

Longitude is taken relative to a fix, so the antimeridian needs no special case.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.sensors.options import RECEPTION
from soilbus.terra.earth import wrapped

NO_FIX = 1e-9
"""Angle [rad] below which a coordinate is zero: what receivers send before they have a fix."""


class Position(NamedTuple):
    """WGS84 [rad]; positive north and east."""

    latitude: float
    longitude: float


class PositionTrack:
    """The recent fixes; latitude and longitude may come in different frames.

    timeout: longest gap [s] between two fixes, by channel name, empty where no position is mapped; smoothing: time [s]
    before and after, within which fixes are averaged.
    """

    def __init__(self, timeout: Mapping[str, float], smoothing: float = RECEPTION.timeout) -> None:
        self._timeout, self._smoothing = dict(timeout), smoothing
        self.forget()

    def forget(self) -> None:
        """Forget all fixes."""
        self._fixes: dict[str, tuple[Array, Array]] = dict.fromkeys(self._timeout, (np.zeros(0), np.zeros(0)))

    def copy(self) -> PositionTrack:
        """Return a copy that later fixes do not change."""
        track = PositionTrack(self._timeout, self._smoothing)
        track._fixes = dict(self._fixes)
        return track

    def add(self, samples: Mapping[str, tuple[Array, Array]]) -> None:
        """Add times [s] and values [rad], both (N,), by channel name; other channels are ignored."""
        for name in self._timeout.keys() & samples.keys():
            t, value = samples[name]
            fixed = np.abs(value) > NO_FIX
            old_t, old_value = self._fixes[name]
            self._fixes[name] = np.concatenate([old_t, t[fixed]]), np.concatenate([old_value, value[fixed]])

    def at(self, t: float) -> Position | None:
        """Return the position at t [s]; None where the fixes around it are further apart than the timeout."""
        if not self._timeout:
            return None
        latitude, longitude = (self._coordinate(name, t) for name in Position._fields)
        if latitude is None or longitude is None:
            return None
        return Position(latitude, float(wrapped(longitude)))

    def drop_before(self, t: float) -> None:
        """Forget the fixes that no position at or after t [s] needs."""
        for name, (times, value) in self._fixes.items():
            first = int(np.searchsorted(times, t - self._timeout[name]))
            self._fixes[name] = times[first:], value[first:]

    def _coordinate(self, name: str, t: float) -> float | None:
        """The coordinate [rad] at t [s] on the least-squares line in time; None where no position is known."""
        times, value = self._fixes[name]
        after = int(np.searchsorted(times, t))
        if not 0 < after < len(times) or times[after] - times[after - 1] > self._timeout[name]:
            return None
        near = min(self._smoothing, self._timeout[name])
        low = min(int(np.searchsorted(times, t - near)), after - 1)
        high = max(int(np.searchsorted(times, t + near, "right")), after + 1)
        reference = float(value[after])
        since, off = times[low:high] - t, wrapped(value[low:high] - reference)
        mean = float(since.mean())
        spread = float(((since - mean) ** 2).sum())
        slope = float((since - mean) @ off) / spread if spread > 0.0 else 0.0
        return reference + float(off.mean()) - slope * mean
