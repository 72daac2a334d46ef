"""Hysteresis of the state: a worse state at once, a better one after several windows beyond a raised threshold.

    raised threshold    p_raised = Phi(Phi^-1(p) + h)        h: `hysteresis` [standard deviations of the margin]
    better state        the last `hold` windows each pass its raised threshold

`Held` is the state in force with the states of the last windows by the raised thresholds.  `settled` updates it by one
window; `doubted` replaces it while the ground changes, when no estimate of the new ground exists.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist

from soilbus.config.model import Traversability as Settings
from soilbus.decision.traversability import State, Status, state_of

__all__ = ["ORDER", "Held", "doubted", "settled"]

ORDER = (State.NO_GO, State.CAUTION, State.GO)
"""States from the worst to the best."""


@dataclass(frozen=True, slots=True)
class Held:
    """The state in force, and the states of the last windows by the raised thresholds."""

    state: State = State.UNKNOWN
    recent: tuple[State, ...] = ()


def settled(last: Held, probability: float | None, status: Status, settings: Settings) -> Held:
    """The state in force after one more window.

    Parameters
    ----------
    last
        The state before.
    probability
        Of the window's decision; None is unknown.
    status
        Of the window.
    settings
        Thresholds, `hold` and `hysteresis`.

    Notes
    -----
    Unknown and worse states take effect at once.  After unknown, any state does.
    """
    if probability is None:
        return Held()
    now, raised = (state_of(probability, status, by) for by in (settings, _raised(settings)))
    recent = (*last.recent, raised)[-settings.hold :]
    if last.state is State.UNKNOWN or _rank(now) <= _rank(last.state):
        return Held(now, recent)
    risen = min(recent, key=_rank) if len(recent) == settings.hold else last.state
    return Held(max(last.state, risen, key=_rank), recent)


def doubted(last: Held) -> Held:
    """The state in force while the ground changes and the new soil is not known: caution, or no_go if it was no_go."""
    state = min(last.state, State.CAUTION, key=_rank) if last.state is not State.UNKNOWN else State.CAUTION
    return Held(state, (state,))


def _rank(state: State) -> int:
    return ORDER.index(state)


@lru_cache(maxsize=8)
def _raised(settings: Settings) -> Settings:
    """The settings with thresholds raised by `hysteresis` standard deviations of the margin."""
    normal = NormalDist()
    go, no_go = (normal.cdf(normal.inv_cdf(p) + settings.hysteresis) for p in (settings.go, settings.no_go))
    return settings.model_copy(update={"go": go, "no_go": no_go})
