"""Immobilisation ahead: how long until slip passes the greatest that is allowed, from slip and pull as they come.

Slip itself gives no warning: it grows slowly at first and then runs away.  The pull that
the ground could give here and now does: it is the pull that is given, and what the last
window's pull over slip says is still to come from the present slip on.  It does not swing with
the draft, and falls steadily where the soil softens.  The warning comes when
it is about to fall below what is asked for, now and then or growing.

Every window brings another curve, and with it another capacity on the same ground: that is no
change of the ground.  So the trend is that along the newest curve, of the last moments too.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from soilbus.capability.assessment import OverSlip
from soilbus.capability.trend import LAG, Capacity, Line, Peaks, Trend
from soilbus.estimation.window import Rig, Window, pull_given
from soilbus.terra.vehicle import slip_ratio

DEMAND_MEMORY = 4.0
"""Time constant [s] of forgetting the demand, which swings and for the most part comes back."""
HOLD = 300.0
"""A peak of the demand is remembered this long [s] at least, and at most twice as long."""
LONGEST_GAP = 1.0
"""Silence [s] after which the trends start anew."""
REMEMBERED = 10.0
"""Age [s] up to which moments are kept for the next curve."""
SETTLED = 2.0
"""Age [s] from which a trend is believed."""
AHEAD = 10.0
"""Time left [s] from which is warned."""
MUCH, TOO_MUCH = 0.71, 0.76
"""Share of the capacity from which a rise of the demand beyond its last peaks is carried on, and from which no warning
ends."""
WEAKENING, SHORT_WEAKENING = 0.006, 0.03
"""Loss [1/s], as a share of the capacity, from which the ground is said to weaken, by the long and the short memory."""
STEEPER = 1.6
"""Times that a loss will still grow which the short memory sees so much steeper than the long one: front wheels meet
an edge first, rear ones a wheelbase later."""
SURE = 2.5
"""Standard deviations by which such a loss must differ from none."""
STEADY = 0.003
"""Rise of the demand [1/s], as a share of the capacity, up to which growing slip is the ground's doing."""
CALM = 5.0
"""The warning ends this long [s] after its last cause."""
SPAN = 3
"""Bins of a window over which a moment's slip and pull are averaged."""


class Alert(StrEnum):
    """Is the vehicle about to get stuck?"""

    UNKNOWN = "unknown"
    NONE = "none"
    IMMOBILISATION = "immobilisation"


_NO_TREND, _NO_CAPACITY, _NO_PEAKS = Trend(), Capacity(), Peaks()


@dataclass(frozen=True, slots=True)
class Watch:
    """What is remembered from one moment to the next; `watched` makes the next one.

    t [s] is the last moment with slip and pull, since that of the first; recent are the last of them as
    (t, mean slip, pull) and curve is what the trend of the capacity rests on; capacity and demand [N] and the
    mean slip are trends, peaks holds the demand's greatest of late; caused [s] is when there was last a cause to
    warn.  warning and time_left [s] (None: not foreseeable) are what to tell.
    """

    t: float = -math.inf
    since: float = math.inf
    recent: tuple[tuple[float, float, float], ...] = ()
    curve: OverSlip | None = None
    capacity: Capacity = _NO_CAPACITY
    demand: Trend = _NO_TREND
    slip: Trend = _NO_TREND
    peaks: Peaks = _NO_PEAKS
    caused: float = -math.inf
    warning: Alert = Alert.UNKNOWN
    time_left: float | None = None


def watched(before: Watch, t: float, slip: Iterable[float | None], pull: float | None, curve: OverSlip | None) -> Watch:
    """The watch after a look at the wheels' slips and the pull [N] (draft, slope, inertia) at the time t [s].

    None is what is not known.  Moments may come at any rate.  After LONGEST_GAP without
    slip, pull or curve the trends start anew, and when time goes back the peaks are forgotten
    too.  Unknown until the trends have settled.
    """
    slips = [s for s in slip if s is not None and math.isfinite(s)]
    if not slips or pull is None or not math.isfinite(pull) or curve is None:
        return before if 0.0 <= t - before.t <= LONGEST_GAP else _anew(before, t)
    step = t - before.t
    if not 0.0 <= step <= LONGEST_GAP:
        before, step = replace(_anew(before, t), since=t), 0.0
    mean_slip = sum(slips) / len(slips)
    reserve = _reserve(curve, mean_slip)
    kept = before.recent[bool(before.recent and t - before.recent[0][0] > REMEMBERED) :]
    trend = before.capacity if curve is before.curve else _along(curve, kept)
    capacity = trend.joined(step, _able(curve, mean_slip, pull), _earlier(curve, t, kept))
    demand = before.demand.joined(step, pull, DEMAND_MEMORY)
    peaks = before.peaks.joined(t, pull, HOLD)
    creep = before.slip.joined(step, mean_slip, DEMAND_MEMORY)
    time_left = None
    if t - before.since >= SETTLED:
        time_left = 0.0
        if reserve > 0.0:
            rise = demand.line().slope
            to_limit = _time_of_creep(creep, float(curve.slip[-1]), rise / (pull + reserve))
            time_left = min(_time_left(capacity, pull, rise, peaks.greatest), to_limit)
    still = before.warning is Alert.IMMOBILISATION and pull > TOO_MUCH * (pull + reserve)
    caused = t if still or (time_left is not None and time_left < AHEAD) else before.caused
    warning = Alert.UNKNOWN if time_left is None else Alert.NONE
    if t - caused < CALM:
        warning = Alert.IMMOBILISATION
    recent = (*kept, (t, mean_slip, pull))
    return Watch(t, before.since, recent, curve, capacity, demand, creep, peaks, caused, warning, time_left)


def _along(curve: OverSlip, recent: Sequence[tuple[float, float, float]]) -> Capacity:
    """The capacity at the last moments by a curve."""
    t, slip, pull = np.array(recent, float).reshape(-1, 3).T
    known = np.isfinite(curve.pull)
    slips, pulls = curve.slip[known], curve.pull[known]
    ahead = np.append(np.maximum.accumulate(pulls[::-1])[::-1], pulls[-1:])[np.searchsorted(slips, slip, "right")]
    able = pull + np.where(slip >= slips[-1], 0.0, ahead - np.interp(slip, slips, pulls))
    return Capacity.through(t, np.where(slip >= curve.slip[0], able, np.nan))


def _able(curve: OverSlip, slip: float, pull: float) -> float | None:
    """Pull [N] that the ground could give; None from wheels that all but roll, for these ask nothing of it."""
    return pull + _reserve(curve, slip) if slip >= curve.slip[0] else None


def _earlier(curve: OverSlip, t: float, recent: Sequence[tuple[float, float, float]]) -> float | None:
    """The capacity at the first moment that is no more than LAG before the time t [s]; None where it is not known."""
    place = bisect_left(recent, t - LAG, key=lambda moment: moment[0])
    return _able(curve, *recent[place][1:]) if place < len(recent) else None


def _anew(before: Watch, t: float) -> Watch:
    """Nothing remembered but the peaks."""
    return Watch(peaks=before.peaks) if t >= before.peaks.since else Watch()


class Moment(NamedTuple):
    """Time [s], slips of the wheels and pull [N]; nan is what is not known."""

    t: float
    slip: list[float]
    pull: float


def moments(window: Window, rig: Rig, since: float, min_speed: float) -> Iterator[Moment]:
    """The moments of a window's bins after `since` [s], none for a rig without a chassis.

    No slip is judged up to min_speed [m/s].
    """
    if rig.chassis is None:
        return
    ground = window.ground_speed[:, None]
    slip = np.where(ground > min_speed, slip_ratio(rig.radius, window.speed, ground), np.nan)
    pull = pull_given(window, rig.chassis)
    for i in np.flatnonzero(window.t > since).tolist():
        recent = slice(max(i + 1 - SPAN, 0), i + 1)
        yield Moment(float(window.t[i]), slip[recent].mean(axis=0).tolist(), float(pull[recent].mean()))


def _reserve(curve: OverSlip, slip: float) -> float:
    """Pull [N] still to come from this slip on."""
    slips, pulls, ahead = _known(curve)
    i = bisect_right(slips, slip)
    if i == len(slips):
        return 0.0
    share = (slip - slips[i - 1]) / (slips[i] - slips[i - 1]) if i else 1.0
    return ahead[i] - (pulls[i] - (1.0 - share) * (pulls[i] - pulls[i - 1]))


@lru_cache(maxsize=2)
def _known(curve: OverSlip) -> tuple[list[float], list[float], list[float]]:
    """Slips and pulls [N] where they are known, and the greatest pull from each on."""
    known = np.isfinite(curve.pull)
    pull = curve.pull[known]
    return curve.slip[known].tolist(), pull.tolist(), np.maximum.accumulate(pull[::-1])[::-1].tolist()


def _time_left(capacity: Capacity, asked: float, rise: float, peak: float) -> float:
    """Time [s] until the capacity, going on as it does, meets the demand's peak or its rise."""
    if not capacity.is_told:
        return math.inf
    able = capacity.long.line()
    outgrows = asked >= peak and asked > MUCH * able.value and rise > able.slope
    to_rise = (able.value - asked) / (rise - able.slope) if outgrows else math.inf
    long = _time_of_weakening(capacity, able, WEAKENING, peak)
    latest = capacity.short.line()
    short = _time_of_weakening(capacity, latest, SHORT_WEAKENING, peak)
    if latest.slope < STEEPER * min(able.slope, 0.0):
        short /= STEEPER
    return max(min(to_rise, long, short), 0.0)


def _time_of_weakening(capacity: Capacity, line: Line, least: float, peak: float) -> float:
    """Time [s] until one of the capacity's lines falls to the demand's peak, inf where it does not surely fall."""
    surely = -line.slope > max(least * abs(line.value), SURE * capacity.slope_std(line))
    return (line.value - peak) / -line.slope if surely else math.inf


def _time_of_creep(slip: Trend, limit: float, rise: float) -> float:
    """Time [s] until slip, growing under a demand that hardly rises (rise [1/s]), passes the limit."""
    line = slip.line()
    return max(limit - line.value, 0.0) / line.slope if line.slope > 0.0 and abs(rise) < STEADY else math.inf
