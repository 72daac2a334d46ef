"""Bus time, and up to which bus time all frames have been received.

    bus time(now) = now + offset
    stamp - now <= offset <= stamp - (when no frame was waiting last)      for each frame, taken at `now`

Frames are stamped by the kernel's clock; the loop runs on the monotonic clock. A frame was stamped before it is taken,
and after the last moment when none was waiting: so frames that wait long in the kernel are known to be old.

A window ends when no frame of it can come any more: when a later frame was taken, when the bus says up to when it has
delivered, or CLOSE_DELAY after the window's end at the latest.
"""

from __future__ import annotations

import math

from soilbus.can.admission import CLOCK_STEP, LAST_TIME
from soilbus.can.bus import LiveBus
from soilbus.can.wire import STAMPED

CLOSE_DELAY = 0.2
"""Time [s] after its end at which a window is closed where no later frame and no report of the bus closed it before."""
TAKING_DELAY = 0.01
"""Longest time [s] from the stamp of a frame to the moment when the loop takes it."""


class BusTime:
    """Bus time of the frames and the monotonic time since; all times in s."""

    def __init__(self, bus: LiveBus, now: float) -> None:
        self._bus = bus
        self._stamp, self._offset = 0.0, -math.inf
        self._nothing_left = now
        self.last_frame = -1e9
        """Monotonic time at which a frame was taken last."""

    def set_ahead(self, stamp: float, now: float) -> bool:
        """Return whether a frame's stamp [s] shows that the stamping clock was set ahead since the last frame."""
        return self.last_frame > 0.0 and stamp - self.at(now) > CLOCK_STEP and stamp <= LAST_TIME

    def took(self, stamp: float, now: float) -> None:
        """Note that a frame with this stamp [s] was taken at the monotonic time `now` [s]."""
        self._stamp, self.last_frame = stamp, now
        self._offset = min(max(self._offset, stamp - now), stamp - self._nothing_left)

    def took_nothing(self, now: float) -> None:
        """Note that no frame was waiting at the monotonic time `now` [s]."""
        self._nothing_left = now

    def at(self, now: float) -> float:
        """Return the bus time [s] at the monotonic time `now` [s]; 0 before the first frame."""
        return max(self._stamp, now + self._offset) if self.last_frame > 0.0 else 0.0

    def read_until(self, now: float) -> float:
        """Return the bus time [s] up to which frames were taken: the last stamp where more may wait, else as `at`."""
        return self._stamp if self._nothing_left < self.last_frame else self.at(now)

    def present(self, now: float) -> float:
        """Return the bus time [s] by the stamping clock itself where it can be read, else as `at`."""
        stamping = self._bus.stamping_time()
        return self.at(now) if math.isnan(stamping) else stamping

    def heard(self, end: float, now: float) -> float:
        """Return the bus time [s] up to which all frames came; the bus is asked only near a window's `end` [s]."""
        heard, latest = max(self._stamp, self.at(self._nothing_left) - CLOSE_DELAY), self.at(now) + TAKING_DELAY
        if heard < end <= latest:
            return max(heard, min(self._bus.heard_until(), latest))  # its clock may just have been set
        return heard

    def wait(self, end: float, now: float, longest: float) -> float:
        """Return the time [s] to wait for a frame: at most `longest`, and at most to the window's end."""
        if self.at(now) + longest + TAKING_DELAY < end:
            return longest
        left = end + STAMPED - self._bus.stamping_time()
        return longest if math.isnan(left) else min(longest, max(left, 0.0))
