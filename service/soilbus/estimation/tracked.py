"""What the tracker is told, and what it says of a window."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from soilbus.estimation.gauss_newton import Fit

MIN_ROWS = 60
"""Residuals that a window needs."""


class Ground(StrEnum):
    """What the data of a window are of."""

    SAME = "same"
    NEW = "new"
    """Another soil than before, since less than a window: only its own data count."""
    CHANGING = "changing"
    """Too little of another soil is in to tell it; the estimate is of the one before."""
    SETTLING = "settling"
    """Another soil than before, whose border may go on: its data do not agree, or are of too little time."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What the tracker needs to be told; times s, speeds m/s.

    drift: sd of the logarithm of each soil coordinate after one window; it grows with the
    square root of time.  min_rows: residuals below which a window is not fitted.
    search_rate, search_burst: evaluations of the model that searches may take, see SearchBudget.
    form: how far each of form.FORM may be from the configured model's; () leaves none of it open.
    """

    window: float
    min_speed: float
    max_turn: float
    max_chi2: float
    drift: float
    min_rows: int = MIN_ROWS
    form: tuple[float, ...] = ()
    search_rate: float = 4.0
    search_burst: float = 100.0


@dataclass(frozen=True, slots=True)
class Tracked:
    """A window's fit (None without), whether the model fails to describe its data, and of which ground they are.

    since [s] is where the data that count begin; standstill and turning count instants left out.
    search_ended: the budget of evaluations ended the search for a soil that describes the data.
    """

    fit: Fit | None
    mismatch: bool
    ground: Ground
    since: float
    standstill: int = 0
    turning: int = 0
    search_ended: bool = False
