"""May the vehicle go on: go, caution, no_go or unknown, with a probability and the limiting cause."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from soilbus.config.model import Traversability as Settings

if TYPE_CHECKING:
    from soilbus.decision.capability import Capability
    from soilbus.estimation.posterior import Estimate

__all__ = ["State", "Status", "Traversability", "state_of"]


class State(StrEnum):
    """May the vehicle go on?"""

    GO = "go"
    CAUTION = "caution"
    NO_GO = "no_go"
    UNKNOWN = "unknown"


class Status(StrEnum):
    """What a window's estimate is worth."""

    VALID = "valid"
    DEGRADED = "degraded"
    NOT_EXCITED = "not_excited"
    INVALID = "invalid"


@dataclass(frozen=True, slots=True)
class Traversability:
    """The decision and what it rests on; None where nothing can be said.

    Torques are sums over the wheels [N m]; max_draft [N] on the level; max_grade [rad]
    without draft; slip_needed gives the present demand; since_valid is the time [s] since the
    end of the last valid window; capability has all the rest; spare is the pull [N] on the present slope beyond
    the demand and its margin.
    """

    state: State = State.UNKNOWN
    probability: float | None = None
    torque_required: float | None = None
    torque_available: float | None = None
    max_draft: Estimate | None = None
    max_grade: Estimate | None = None
    slip_needed: float | None = None
    limit: str | None = None
    since_valid: float | None = None
    capability: Capability | None = None
    spare: Estimate | None = None


def state_of(probability: float, status: Status, settings: Settings) -> State:
    """The state that a probability and a status allow."""
    if probability < settings.no_go:
        return State.NO_GO
    if probability >= settings.go and status is Status.VALID:
        return State.GO
    return State.CAUTION
