"""Traversability: may the vehicle go on, with which probability, and what limits it.

    P < no_go                         no_go
    P >= go and a valid estimate      go
    otherwise                         caution; unknown without a probability

P: that pull and sinkage stay within their limits (`judgement`).  A worse state is in force at once, a better one after
several windows beyond a raised threshold (hysteresis):

    raised threshold    p_raised = Phi(Phi^-1(p) + h)        h: `hysteresis` [standard deviations of the margin]
    better state        the last `hold` windows each pass its raised threshold
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from statistics import NormalDist
from typing import TYPE_CHECKING

from soilbus.config.model import Traversability as Settings

if TYPE_CHECKING:
    from soilbus.decision.capability import Capability
    from soilbus.estimation.posterior import Estimate


__all__ = ["ORDER", "Held", "State", "Status", "Traversability", "doubted", "settled", "state_of"]


class State(StrEnum):
    """Verdict whether the vehicle can go on."""

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
    max_draft, max_grade
        [N] on the level, and [rad] without draft.
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
    """Return the state by a probability and a status, with the thresholds of the settings."""
    if probability < settings.no_go:
        return State.NO_GO
    if probability >= settings.go and status is Status.VALID:
        return State.GO
    return State.CAUTION


ORDER = (State.NO_GO, State.CAUTION, State.GO)
"""States from the worst to the best."""


@dataclass(frozen=True, slots=True)
class Held:
    """State in force, and the states of the last windows by the raised thresholds."""

    state: State = State.UNKNOWN
    recent: tuple[State, ...] = ()


def settled(last: Held, probability: float | None, status: Status, settings: Settings) -> Held:
    """Return the state in force after one more window of this probability (None: unknown) and status.

    Unknown and worse states take effect at once.  After unknown, any state does.
    """
    if probability is None:
        return Held()
    now, raised = (state_of(probability, status, by) for by in (settings, _raised(settings)))
    recent = (*last.recent, raised)[-settings.hold :]
    if last.state is State.UNKNOWN or ORDER.index(now) <= ORDER.index(last.state):
        return Held(now, recent)
    risen = min(recent, key=ORDER.index) if len(recent) == settings.hold else last.state
    return Held(max(last.state, risen, key=ORDER.index), recent)


def doubted(last: Held) -> Held:
    """Return the state in force while the ground changes and the new soil is unknown: caution, or still no_go."""
    state = min(last.state, State.CAUTION, key=ORDER.index) if last.state is not State.UNKNOWN else State.CAUTION
    return Held(state, (state,))


@lru_cache(maxsize=8)
def _raised(settings: Settings) -> Settings:
    """The settings with thresholds raised by `hysteresis` standard deviations of the margin."""
    normal = NormalDist()
    go, no_go = (normal.cdf(normal.inv_cdf(p) + settings.hysteresis) for p in (settings.go, settings.no_go))
    return settings.model_copy(update={"go": go, "no_go": no_go})
