"""Immobilisation ahead: how long until slip passes the greatest that is allowed, from slip and pull as they come.

Slip itself gives no warning: it grows slowly at first and then runs away.  The pull that
the ground could give here and now does: it is the pull that is given, and what the last
window's pull over slip says is still to come from the present slip on.  It does not swing with
the draft, and falls steadily where the soil softens.  The warning comes when
it is about to fall below what is asked for, now and then or growing.

What speeds the vehicle up is part of the pull that is given, but no vehicle gains speed for long: draft and slope
are what may outgrow the ground.  A rise of theirs is carried on only where it is surely none of
the swings that came back before.

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
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from soilbus.capability.traction_loss import TractionLoss
from soilbus.capability.trend import LAG, SWING, Capacity, Demand, Line, Peaks, Trend
from soilbus.estimation.window import Rig, Window, inertia_of, pull_given
from soilbus.terra.vehicle import slip_ratio

if TYPE_CHECKING:
    from soilbus.capability.assessment import OverSlip

CREEP = 4.0
"""Time constant [s] of forgetting slip that creeps, and the pull that it gives."""
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
MUCH, TOO_MUCH, SURE_OR_NOT, NEARLY_ALL = 0.71, 0.76, 0.79, 0.85
"""Share of the capacity from which a rise of draft and slope beyond their last peaks is carried on where it is sure,
from which no warning ends, from which it is carried on sure or not, and from which any rise or swing of theirs may come
to be too much."""
WEAKENING, SHORT_WEAKENING = 0.006, 0.03
"""Loss [1/s], as a share of the capacity, from which the ground is said to weaken, by the long and the short memory."""
STEEPER = 1.6
"""Times that a loss will still grow which the short memory sees so much steeper than the long one: front wheels meet
an edge first, rear ones a wheelbase later."""
SURE = 2.5
"""Standard deviations by which such a loss, and a rise of the demand, must differ from none."""
STEADY = 0.003
"""Rise of the pull [1/s], as a share of the capacity, up to which growing slip is the ground's doing, and of draft and
slope beyond which they may come to be too much: where they are given too, for a vehicle that slows down gives less."""
CALM = 5.0
"""The warning ends this long [s] after its last cause."""
SPAN = 3
"""Bins of a window over which a moment's slip and pull are averaged."""


class Alert(StrEnum):
    """Is the vehicle about to get stuck?"""

    UNKNOWN = "unknown"
    NONE = "none"
    IMMOBILISATION = "immobilisation"


_NO_TREND, _NO_CAPACITY, _NO_DEMAND, _NO_PEAKS = Trend(), Capacity(), Demand(), Peaks()


class Look(NamedTuple):
    """Time [s], mean slip, pull [N] that is given, and what draft and slope ask of it [N]."""

    t: float
    slip: float
    pull: float
    asked: float


@dataclass(frozen=True, slots=True)
class Watch:
    """What is remembered from one moment to the next; `watched` makes the next one.

    t [s] is the last moment with slip and pull, since that of the first; recent are the last of them
    and curve is what the trend of the capacity rests on; capacity, demand [N] of draft and slope, mean
    slip and given pull are trends, peaks and asked hold the greatest pull and demand of late; caused [s] is
    when there was last a cause to warn.  warning and time_left [s] (None: not foreseeable) are what to tell.
    """

    t: float = -math.inf
    since: float = math.inf
    recent: tuple[Look, ...] = ()
    curve: OverSlip | None = None
    capacity: Capacity = _NO_CAPACITY
    demand: Demand = _NO_DEMAND
    slip: Trend = _NO_TREND
    given: Trend = _NO_TREND
    peaks: Peaks = _NO_PEAKS
    asked: Peaks = _NO_PEAKS
    caused: float = -math.inf
    warning: Alert = Alert.UNKNOWN
    time_left: float | None = None


def watched(
    before: Watch,
    t: float,
    slip: Iterable[float | None],
    pull: float | None,
    curve: OverSlip | None,
    inertia: float = 0.0,
) -> Watch:
    """The watch after a look at the wheels' slips and the pull [N] (draft, slope, inertia) at the time t [s].

    inertia [N] is the share of the pull that speeds the vehicle up.  None is what is not known.
    Moments may come at any rate.  After LONGEST_GAP without slip, pull or curve the trends start
    anew, and when time goes back the peaks are forgotten too.  Unknown until the trends have settled.
    """
    slips = [s for s in slip if s is not None and math.isfinite(s)]
    if not slips or pull is None or not math.isfinite(pull) or curve is None:
        return before if 0.0 <= t - before.t <= LONGEST_GAP else _anew(before, t)
    step = t - before.t
    if not 0.0 <= step <= LONGEST_GAP:
        before, step = replace(_anew(before, t), since=t), 0.0
    look = Look(t, sum(slips) / len(slips), pull, pull - inertia)
    reserve = _reserve(curve, look.slip)
    kept = before.recent[bool(before.recent and t - before.recent[0].t > REMEMBERED) :]
    trend = before.capacity if curve is before.curve else _along(curve, kept)
    earlier, once, twice = (_ago(kept, t - lag) for lag in (LAG, SWING, 2.0 * SWING))
    capacity = trend.joined(step, _able(curve, look, reserve), None if earlier is None else _able(curve, earlier))
    demand = before.demand.joined(step, look.asked, *(None if a is None else a.asked for a in (once, twice)))
    peaks, asked = before.peaks.joined(t, pull, HOLD), before.asked.joined(t, look.asked, HOLD)
    creep, given = before.slip.joined(step, look.slip, CREEP), before.given.joined(step, pull, CREEP)
    able = pull + reserve
    share, rise = (min(look.asked, pull) / able, demand.trend.line().slope / able) if able > 0.0 else (0.0, 0.0)
    time_left = None
    if t - before.since >= SETTLED:
        time_left = 0.0
        if reserve > 0.0:
            to_limit = _time_of_creep(creep, float(curve.slip[-1]), given.line().slope / able)
            outgrown = _time_to_outgrow(capacity, look.asked, demand, asked.greatest)
            time_left = min(_time_to_weaken(capacity, peaks.greatest), outgrown, to_limit)
    warns = before.warning is Alert.IMMOBILISATION
    enough = share > TOO_MUCH if warns else share > NEARLY_ALL and rise > STEADY and time_left is not None
    caused = t if enough or (time_left is not None and time_left < AHEAD) else before.caused
    warning = Alert.UNKNOWN if time_left is None else Alert.NONE
    if t - caused < CALM:
        warning = Alert.IMMOBILISATION
    return Watch(
        t, before.since, (*kept, look), curve, capacity, demand, creep, given, peaks, asked, caused, warning, time_left
    )  # fmt: skip


def _along(curve: OverSlip, recent: Sequence[Look]) -> Capacity:
    """The capacity at the last moments by a curve."""
    t, slip, pull, _ = np.array(recent, float).reshape(-1, len(Look._fields)).T
    known = np.isfinite(curve.pull)
    slips, pulls = curve.slip[known], curve.pull[known]
    ahead = np.append(np.maximum.accumulate(pulls[::-1])[::-1], pulls[-1:])[np.searchsorted(slips, slip, "right")]
    able = pull + np.where(slip >= slips[-1], 0.0, ahead - np.interp(slip, slips, pulls))
    return Capacity.through(t, np.where(slip >= curve.slip[0], able, np.nan))


def _able(curve: OverSlip, look: Look, reserve: float | None = None) -> float | None:
    """Pull [N] that the ground could give; None from wheels that all but roll, for these ask nothing of it.

    reserve is what is still to come, where that is known already.
    """
    if look.slip < curve.slip[0]:
        return None
    return look.pull + (_reserve(curve, look.slip) if reserve is None else reserve)


def _ago(recent: Sequence[Look], t: float) -> Look | None:
    """The first look from the time t [s] on; None where it came much later."""
    place = bisect_left(recent, t, key=lambda look: look.t)
    return recent[place] if place < len(recent) and recent[place].t - t < LAG else None


def _anew(before: Watch, t: float) -> Watch:
    """Nothing remembered but the peaks."""
    return Watch(peaks=before.peaks, asked=before.asked) if t >= before.peaks.since else Watch()


def with_loss(watch: Watch, loss: TractionLoss) -> Watch:
    """The same, as it is to be reported while traction is lost: that needs no trend, and no estimate."""
    if not loss.present:
        return watch
    return replace(watch, warning=Alert.IMMOBILISATION, time_left=0.0 if loss.stuck else watch.time_left)


class Moment(NamedTuple):
    """Time [s], slips of the wheels, pull [N] and the inertia [N] in it; nan is what is not known."""

    t: float
    slip: list[float]
    pull: float
    inertia: float = 0.0


def moments(window: Window, rig: Rig, since: float, min_speed: float) -> Iterator[Moment]:
    """The moments of a window's bins after `since` [s], none for a rig without a chassis.

    No slip is judged up to min_speed [m/s].
    """
    if rig.chassis is None:
        return
    ground = window.ground_speed[:, None]
    slip = np.where(ground > min_speed, slip_ratio(rig.radius, window.speed, ground), np.nan)
    of_bins = np.column_stack([slip, pull_given(window, rig.chassis), inertia_of(window, rig.chassis)])
    chosen = np.flatnonzero(window.t > since)
    place = chosen[:, None] + np.arange(1 - SPAN, 1)
    there = place >= 0
    total = np.where(there[:, :, None], of_bins[np.maximum(place, 0)], 0.0).sum(axis=1)
    means = total / there.sum(axis=1)[:, None]
    for t, (*slips, pull, inertia) in zip(window.t[chosen].tolist(), means.tolist(), strict=True):
        yield Moment(t, slips, pull, inertia)


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


def _time_to_outgrow(capacity: Capacity, asked: float, demand: Demand, peak: float) -> float:
    """Time [s] until draft and slope meet the capacity, both going on as they do; inf where they do not surely rise."""
    if not capacity.is_told or asked < peak:
        return math.inf
    able, line = capacity.long.line(), demand.trend.line()
    sure = line.slope > SURE * demand.slope_std(line) or asked > SURE_OR_NOT * able.value
    outgrows = asked > MUCH * able.value and line.slope > max(able.slope, 0.0) and sure
    return max(able.value - asked, 0.0) / (line.slope - able.slope) if outgrows else math.inf


def _time_to_weaken(capacity: Capacity, peak: float) -> float:
    """Time [s] until the capacity, going on as it does, falls to the pull's peak."""
    if not capacity.is_told:
        return math.inf
    able, latest = capacity.long.line(), capacity.short.line()
    long = _time_of_weakening(capacity, able, WEAKENING, peak)
    short = _time_of_weakening(capacity, latest, SHORT_WEAKENING, peak)
    if latest.slope < STEEPER * min(able.slope, 0.0):
        short /= STEEPER
    return max(min(long, short), 0.0)


def _time_of_weakening(capacity: Capacity, line: Line, least: float, peak: float) -> float:
    """Time [s] until one of the capacity's lines falls to the demand's peak, inf where it does not surely fall."""
    surely = -line.slope > max(least * abs(line.value), SURE * capacity.slope_std(line))
    return (line.value - peak) / -line.slope if surely else math.inf


def _time_of_creep(slip: Trend, limit: float, rise: float) -> float:
    """Time [s] until slip, growing under a pull that hardly rises (rise [1/s]), passes the limit."""
    line = slip.line()
    return max(limit - line.value, 0.0) / line.slope if line.slope > 0.0 and abs(rise) < STEADY else math.inf
