"""What the service says it is doing; on the bus, in systemd's STATUS line and in each JSON line."""

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
    """State that a window's result puts the service in while its inputs keep coming."""
    match result.status:
        case Status.VALID:
            return ServiceState.VALID
        case Status.NOT_EXCITED:
            return ServiceState.LISTENING
        case _:
            return ServiceState.DEGRADED
