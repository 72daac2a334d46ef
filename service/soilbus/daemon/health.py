"""Watchdog conditions: whether the estimator and the sender still work.

    fault  if  a window is being solved for more than 20 s
    fault  if  frames were received for 30 s and none could be sent

systemd is notified only while there is no fault, so it restarts the service. A silent or absent bus is no fault of
the service, because a restart would not change it.
"""

from __future__ import annotations

MAX_SOLVE_TIME = 20.0
"""Time [s] after which a window's estimate counts as hung."""
MAX_TIME_WITHOUT_SEND = 30.0
"""Time [s] of reception without one frame sent after which the sender, not a full bus, is at fault."""


class Health:
    """Watch of the estimator and the sender; times are monotonic [s]."""

    def __init__(self, now: float) -> None:
        self._sent, self._able = 0, now

    def fault(self, now: float, solving_since: float | None, hears: bool, sent: int) -> str | None:
        """Return what has stopped working, for the status line; None where nothing has. Call it once a tick.

        The worker began with its present window at `solving_since` [s]. `hears`: the bus is up with frames on it.
        `sent` frames went out since the start.
        """
        if sent != self._sent or not hears:
            self._sent, self._able = sent, now
        if solving_since is not None and now - solving_since > MAX_SOLVE_TIME:
            return "overload the estimator hangs"
        if now - self._able > MAX_TIME_WITHOUT_SEND:
            return "internal nothing can be sent"
        return None
