"""Queue of frames that the kernel has no room for yet: the newest of each identifier, dropped when late."""

from __future__ import annotations

from soilbus.can.publish import Frame

LATE = 0.1  # age [s] at which a frame that did not get out is dropped: its successor is newer


class Outbox:
    """Queue of frames to send, a slot for each identifier: a newer frame replaces the one that waits, in its turn."""

    def __init__(self) -> None:
        self.dropped = 0  # frames that were given up since the start
        self._waiting: dict[int, tuple[Frame, float]] = {}

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, frame: Frame, now: float) -> None:
        """Keep a frame made at the monotonic time `now` [s] until its turn."""
        self.dropped += frame.arbitration_id in self._waiting
        self._waiting[frame.arbitration_id] = frame, now

    def first(self, now: float) -> Frame | None:
        """Return the frame whose turn it is; drop those that are late by now."""
        for identifier, (frame, made) in list(self._waiting.items()):
            if now - made <= LATE:
                return frame
            del self._waiting[identifier]
            self.dropped += 1
        return None

    def done(self, frame: Frame) -> None:
        """Forget the first frame, which is sent."""
        del self._waiting[frame.arbitration_id]

    def clear(self) -> None:
        """Drop all frames, as the bus is gone and they would be stale later."""
        self.dropped += len(self._waiting)
        self._waiting.clear()
