"""Whether the service does its work: systemd hears that it lives only while it does.

A silent bus, or none, is no fault of the service: starting it again would heal nothing.
"""

from __future__ import annotations

MAX_SOLVE_TIME = 20.0
"""A window that takes longer [s] is an estimator that hangs."""
MAX_TIME_WITHOUT_SEND = 30.0
"""Seconds of frames heard without one sent, after which it is the sender that hangs and not the bus that is full."""


class Health:
    """Watches over estimator and sender; times are monotonic [s]."""

    def __init__(self, now: float) -> None:
        self._sent, self._able = 0, now

    def fault(self, now: float, solving_since: float | None, hears: bool, sent: int) -> str | None:
        """What has stopped working, as the status says it, or None; asked once a tick.

        solving_since: when the window was begun that the estimator works at, if it does;
        hears: whether the bus is up with frames on it; sent: frames sent since the start.
        """
        if sent != self._sent or not hears:
            self._sent, self._able = sent, now
        if solving_since is not None and now - solving_since > MAX_SOLVE_TIME:
            return "overload the estimator hangs"
        if now - self._able > MAX_TIME_WITHOUT_SEND:
            return "internal nothing can be sent"
        return None
