"""State of the service, as sent on the bus, in systemd's STATUS line and in each JSON line.

starting -> waiting -> listening -> estimating -> valid or degraded; fault at any time
"""

from __future__ import annotations

from enum import StrEnum

from soilbus.decision.traversability import Status
from soilbus.pipeline.result import WindowResult


class ServiceState(StrEnum):
    """States of the service, in the order in which a good start passes them."""

    STARTING = "starting"
    WAITING = "waiting"
    LISTENING = "listening"
    ESTIMATING = "estimating"
    VALID = "valid"
    DEGRADED = "degraded"
    FAULT = "fault"


def state_after(result: WindowResult) -> ServiceState:
    """Return the state of the service after a window's result, while its inputs keep coming."""
    states = {Status.VALID: ServiceState.VALID, Status.NOT_EXCITED: ServiceState.LISTENING}
    return states.get(result.status, ServiceState.DEGRADED)
