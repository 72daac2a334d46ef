"""The bus's own time, and until when all of it was heard: a window ends when no frame of it can come any more."""

from __future__ import annotations

import math

from soilbus.can.admission import CLOCK_STEP, LAST_TIME
from soilbus.can.bus import LiveBus
from soilbus.can.wire import STAMPED

CLOSE_DELAY = 0.2
"""A window that no later frame has closed is closed this long after its end [s], where the bus cannot tell before."""
TAKING_DELAY = 0.01
"""Seconds by which a frame may be taken later than it was stamped."""


class BusTime:
    """The stamps of a bus's frames, and what the monotonic clock has gone on since; all times in s."""

    def __init__(self, bus: LiveBus, now: float) -> None:
        self._bus = bus
        self._stamp = 0.0
        self._nothing_left = now
        self.last_frame = -1e9
        """Monotonic time at which a frame was taken last."""

    def set_ahead(self, stamp: float, now: float) -> bool:
        """Whether a frame's stamp says that the clock which stamps frames was set ahead since the last frame."""
        return self.last_frame > 0.0 and stamp - self.at(now) > CLOCK_STEP and stamp <= LAST_TIME

    def took(self, stamp: float, now: float) -> None:
        """A frame was taken."""
        self._stamp, self.last_frame = stamp, now

    def took_nothing(self, now: float) -> None:
        """There was none to take."""
        self._nothing_left = now

    def at(self, now: float) -> float:
        """The bus's own time at the monotonic time `now`."""
        return self._stamp + max(0.0, now - self.last_frame) if self.last_frame > 0.0 else 0.0

    def present(self, now: float) -> float:
        """The same, by the clock that stamps frames where it can be asked."""
        stamping = self._bus.stamping_time()
        return self.at(now) if math.isnan(stamping) else stamping

    def heard(self, end: float, now: float) -> float:
        """The bus's own time of which all is heard; asks the bus itself where a window may just have ended at `end`."""
        heard, latest = max(self._stamp, self.at(self._nothing_left) - CLOSE_DELAY), self.at(now) + TAKING_DELAY
        if heard < end <= latest:
            return max(heard, min(self._bus.heard_until(), latest))  # its clock may just have been set
        return heard

    def wait(self, end: float, now: float, longest: float) -> float:
        """How long to wait for a frame, `longest` at most: not past the moment when a window's end is heard."""
        if self.at(now) + longest + TAKING_DELAY < end:
            return longest
        left = end + STAMPED - self._bus.stamping_time()
        return longest if math.isnan(left) else min(longest, max(left, 0.0))
