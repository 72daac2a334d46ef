"""Which soil a window's estimate is of, as a state machine.

STEADY       one soil: the tracker's recursion
SUSPECT      a change point, and too few data after it for a second soil
TRANSITION   two soils have much more evidence than one, but the border may not be over: the second has the wide
             prior of a new soil and the gains of the recursion; data between the soils are left out
NEW_SOIL     the border is over and less than a window old; once it is out of the window, STEADY
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

from soilbus.estimation.change_detection import ChangeStatistic, Transition


class TrackerState(StrEnum):
    """Soil that a window's estimate is of: the same, another, or undecided."""

    STEADY = "steady"
    """The soil of the windows before."""
    SUSPECT = "suspect"
    """The newest data disagree with this soil, but are too few to estimate another; the estimate is of this soil."""
    TRANSITION = "transition"
    """Another soil; the border may not be over: its data do not agree yet."""
    NEW_SOIL = "new_soil"
    """Another soil for less than a window; only its own data count."""


class Reason(StrEnum):
    """Reason for a window's TrackerState."""

    ONE_SOIL = "one_soil"
    """Its data agree with the soil of the windows before (steady)."""
    TOO_FEW_DATA = "too_few_data"
    """It has too few residuals to be fitted (steady)."""
    UNCONFIRMED = "change_unconfirmed"
    """The change statistic exceeds its threshold, but two soils are not much likelier than one (steady)."""
    MISMATCH = "mismatch"
    """No soil describes it (steady), or its newest part (suspect)."""
    CHANGE_STATISTIC = "change_statistic"
    """The change statistic exceeds its threshold (suspect)."""
    TWO_SOILS = "two_soils_likelier"
    """Two soils have much more evidence than one (new soil)."""
    ANOTHER_SOIL = "prior_conflict"
    """Its data conflict with the present soil's prior and are of another one (new soil)."""
    SPANS_BORDER = "window_spans_border"
    """The last border is less than a window ago (new soil)."""
    UNSETTLED = "unsettled"
    """The fit of the new soil exceeds its chi-square limit just after a border (transition)."""


class ChangePoint(NamedTuple):
    """Time t [s] from which the data disagree with the present soil, ground speed [m/s] then, and why."""

    t: float
    speed: float
    statistic: ChangeStatistic


@dataclass(frozen=True, slots=True)
class SoilState:
    """State of the tracker: which soil the windows are of."""

    name: TrackerState = TrackerState.STEADY  # the state, and why it is so
    reason: Reason = Reason.ONE_SOIL
    transition: Transition | None = None  # the last one: data before its end are of another soil
    change: ChangePoint | None = None  # a change point that no other soil explains yet
    mismatch: bool = False  # whether the last fit was a mismatch

    def spans_border(self, start: float) -> bool:
        """Return whether a window from `start` [s] on may still have data of another soil."""
        is_open = self.name is TrackerState.TRANSITION and self.mismatch
        return self.transition is not None and (is_open or start < self.transition.end)


class Shown(NamedTuple):
    """What a window tells of a change of soil."""

    found: Reason | None  # why its newest data are of another soil than that of the window before; None if of the same
    transition: Transition | None  # the last transition, found now or before
    change: ChangePoint | None  # the change point, where there is one
    mismatch: bool  # whether the fit exceeds its limit of chi-square


def next_state(state: SoilState, shown: Shown, end: float, window: float) -> SoilState:
    """Return the state after a window of length `window` that ended at `end` [s]."""
    S, transition, now = TrackerState, shown.transition, replace(state, change=shown.change, mismatch=shown.mismatch)
    if shown.found in (Reason.CHANGE_STATISTIC, Reason.MISMATCH):
        return replace(now, name=S.SUSPECT, reason=shown.found)
    if transition is None or not (shown.found or state.spans_border(end - window)):
        one = Reason.ONE_SOIL if shown.change is None else Reason.UNCONFIRMED
        return replace(now, name=S.STEADY, reason=Reason.MISMATCH if shown.mismatch else one)
    now = replace(now, transition=transition)
    if shown.mismatch:
        return replace(now, name=S.TRANSITION, reason=Reason.UNSETTLED)
    return replace(now, name=S.NEW_SOIL, reason=shown.found or Reason.SPANS_BORDER)
