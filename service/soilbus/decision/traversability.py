"""Traversability: may the vehicle go on, with which probability, and what limits it.

    P < no_go                         no_go
    P >= go and a valid estimate      go
    otherwise                         caution; unknown without a probability

P is the probability that pull and sinkage stay within their limits (`judgement`); go and no_go are configured.
"""

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
    """Quality of a window's estimate."""

    VALID = "valid"
    DEGRADED = "degraded"
    NOT_EXCITED = "not_excited"
    INVALID = "invalid"


@dataclass(frozen=True, slots=True)
class Traversability:
    """The decision, with its main figures; None where not known.

    Attributes
    ----------
    state, probability
        The decision, and the probability that pull and sinkage stay within their limits.
    torque_required, torque_available
        [N m], sums over the wheels.
    max_draft
        [N], on the level.
    max_grade
        [rad], without draft.
    slip_needed
        Slip at which the present demand is met.
    limit
        What limits the vehicle.
    since_valid
        [s], time since the end of the last valid window.
    capability
        All other figures.
    spare
        [N], pull on the present slope less the demand and its margin.
    contradicted
        Why the decision is worse than its estimate says: `warning` of immobilisation, or `slip` beyond the forecast's.
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
    contradicted: str | None = None


def state_of(probability: float, status: Status, settings: Settings) -> State:
    """The state by a probability and a status, with the thresholds of the settings."""
    if probability < settings.no_go:
        return State.NO_GO
    if probability >= settings.go and status is Status.VALID:
        return State.GO
    return State.CAUTION
