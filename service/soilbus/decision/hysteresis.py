"""Hysteresis of the state: worse at once, better only when the ground has surely become so."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist

from soilbus.config.model import Traversability as Settings
from soilbus.decision.traversability import State, Status, state_of

__all__ = ["ORDER", "Held", "doubted", "settled"]

ORDER = (State.NO_GO, State.CAUTION, State.GO)
"""From the worst to the best."""


@dataclass(frozen=True, slots=True)
class Held:
    """The state in force, and the states for which the last windows surely spoke."""

    state: State = State.UNKNOWN
    recent: tuple[State, ...] = ()


def settled(last: Held, probability: float | None, status: Status, settings: Settings) -> Held:
    """The state in force after one more window.

    Unknown (probability None) and a worse state take effect at once.  A better one does
    when `hold` windows in a row pass its threshold by `hysteresis` standard deviations of
    the margin.  Unknown holds nothing back: what follows it counts as a first window does.
    """
    if probability is None:
        return Held()
    now, surely = (state_of(probability, status, by) for by in (settings, _raised(settings)))
    recent = (*last.recent, surely)[-settings.hold :]
    if last.state is State.UNKNOWN or _rank(now) <= _rank(last.state):
        return Held(now, recent)
    risen = min(recent, key=_rank) if len(recent) == settings.hold else last.state
    return Held(max(last.state, risen, key=_rank), recent)


def doubted(last: Held) -> Held:
    """The state in force while the ground changes, and nothing is known of the new one: at most caution."""
    state = min(last.state, State.CAUTION, key=_rank) if last.state is not State.UNKNOWN else State.CAUTION
    return Held(state, (state,))


def _rank(state: State) -> int:
    return ORDER.index(state)


@lru_cache(maxsize=8)
def _raised(settings: Settings) -> Settings:
    """The settings with thresholds that lie `hysteresis` standard deviations higher."""
    normal = NormalDist()
    go, no_go = (normal.cdf(normal.inv_cdf(p) + settings.hysteresis) for p in (settings.go, settings.no_go))
    return settings.model_copy(update={"go": go, "no_go": no_go})
