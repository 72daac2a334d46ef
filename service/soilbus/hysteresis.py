"""Hysteresis of the state: worse at once, better only when the ground has surely become so."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

from soilbus.config import Traversability as Settings
from soilbus.traversability import State, Status, state_of

ORDER = (State.NO_GO, State.CAUTION, State.GO)
"""From the worst to the best."""


@dataclass(frozen=True, slots=True)
class Held:
    """The state in force; towards is the better one for which the last `windows` windows spoke."""

    state: State = State.UNKNOWN
    towards: State = State.UNKNOWN
    windows: int = 0


def settled(last: Held, probability: float | None, status: Status, settings: Settings) -> Held:
    """The state in force after one more window.

    Unknown (probability None) and a worse state take effect at once.  A better one does
    when `hold` windows in a row pass its threshold by `hysteresis` standard deviations of
    the margin; it is then the worst that they spoke for.  Unknown holds nothing back: what
    follows it counts as a first window does.
    """
    if probability is None:
        return Held()
    now = state_of(probability, status, settings)
    if last.state is State.UNKNOWN or ORDER.index(now) <= ORDER.index(last.state):
        return Held(now)
    surely = state_of(probability, status, _raised(settings))
    if ORDER.index(surely) <= ORDER.index(last.state):
        return Held(last.state)
    towards = surely if last.windows == 0 else min(surely, last.towards, key=ORDER.index)
    if last.windows + 1 >= settings.hold:
        return Held(towards)
    return Held(last.state, towards, last.windows + 1)


def _raised(settings: Settings) -> Settings:
    """The settings with thresholds that lie `hysteresis` standard deviations higher."""
    normal = NormalDist()
    go, no_go = (normal.cdf(normal.inv_cdf(p) + settings.hysteresis) for p in (settings.go, settings.no_go))
    return settings.model_copy(update={"go": go, "no_go": no_go})
