"""Conditions that a soak run must meet."""

from __future__ import annotations

from typing import NamedTuple

from tests.lab.soak.run import CYCLE, SLACK, Soak

GROWTH = 1e6
"""Of resident memory [bytes] after the first hour that is allowed."""
WORSE = 1.3
"""Errors of the last quarter of the hours over those of the first that are chance: an hour's scatter by a tenth."""
FARTHEST = 5.0
"""Standard deviations that no valid window may be off, of some thousands an hour."""
LEAST_HOURS = 2
"""Fewer do not show what grows or drifts."""


class Demand(NamedTuple):
    """What was asked, what was found, and whether that will do; None where the run was too short."""

    asked: str
    found: str
    met: bool | None


def demands(shown: Soak) -> list[Demand]:
    """All of them, with what a run showed."""
    hours = [hour for hour in shown.hours if hour.valid]
    long_enough = len(shown.hours) >= LEAST_HOURS and len(hours) >= LEAST_HOURS
    growth = max(hour.memory for hour in shown.hours) - shown.hours[0].memory
    part = max(len(hours) // 4, 1)
    first, last = (sum(hour.error for hour in some) / part for some in (hours[:part], hours[-part:]))
    farthest = max((hour.worst_z for hour in hours), default=float("inf"))
    return [
        Demand(
            "every frame accounted for", f"lost {shown.lost or 'none'} of {shown.received}",
            not shown.lost and shown.received == shown.admitted + shown.refused.total(),
        ),
        Demand("no deadline missed", f"{shown.deadline_misses} missed", shown.deadline_misses == 0),
        Demand("every frame on its beat", f"{shown.off_beat} of {shown.sent} off it", shown.off_beat == 0 < shown.sent),
        Demand(
            "the beat drifts with the windows' ends only", f"{shown.drift:+.3f} s in {shown.epochs} beginnings",
            abs(shown.drift) <= CYCLE / 2 * shown.epochs + SLACK,
        ),
        Demand(
            f"memory grows by at most {GROWTH / 1e6:g} MB after the first hour", f"{growth / 1e6:+.2f} MB",
            growth <= GROWTH if long_enough else None,
        ),
        Demand(
            "estimates as good at the end as at the start", f"error {first:.2%} at first, {last:.2%} at last",
            last <= WORSE * first if long_enough else None,
        ),
        Demand(f"no valid window {FARTHEST:g} sd off", f"the farthest {farthest:.1f} sd", farthest < FARTHEST),
    ]  # fmt: skip
