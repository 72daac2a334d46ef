"""Lines through what was just seen, with exponential forgetting: where a quantity is and where it goes.

Immobilisation ahead: how long until slip passes the greatest that is allowed, from slip and pull as they come.

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

from soilbus.arrays import Array
from soilbus.decision.traction_loss import TractionLoss
from soilbus.estimation.window import Rig, Window, inertia_of, pull_given
from soilbus.terra.vehicle import slip_ratio

if TYPE_CHECKING:
    from soilbus.decision.capability import OverSlip


LONG, SHORT = 2.5, 0.8
"""Time constants [s] of forgetting a capacity: of ground that softens over many metres, and of a soft patch's edge."""
SCATTER = 10.0
"""Time constant [s] of forgetting how much a capacity scatters."""
RISE = 4.0
"""Time constant [s] of forgetting a demand, of which a line is to show a rise and not a swing."""
SWINGS = 20.0
"""Time constant [s] of forgetting how a demand swings."""
SWING = 1.5
"""Time [s] after which a demand that swings is another: draft swings within some seconds."""
LAG = 0.5
"""Time [s] after which a capacity's scatter is another: neither the same samples nor the same metre of ground."""
ENOUGH = 0.4
"""Share of the last moments that must tell the capacity for its trend to be believed."""


class Line(NamedTuple):
    """Value now, slope [1/s], and sum of squares [s^2] by which the moments lie apart."""

    value: float
    slope: float
    spread: float


class Trend(NamedTuple):
    """A line through past values with exponential forgetting: sums of 1, x, x^2, y and x y, x [s] counted from now."""

    n: float = 0.0
    x: float = 0.0
    xx: float = 0.0
    y: float = 0.0
    xy: float = 0.0

    def joined(self, step: float, value: float | None, memory: float) -> Trend:
        """The trend a step [s] later, with one more value or none; memory is the time constant [s] of forgetting."""
        kept = math.exp(-step / memory)
        n, x, xx, y, xy = self
        n, x, xx, y, xy = kept * n, kept * x, kept * xx, kept * y, kept * xy
        later_x, later_xx, later_xy = x - step * n, xx - 2.0 * step * x + step**2 * n, xy - step * y
        if value is None:
            return Trend(n, later_x, later_xx, y, later_xy)
        return Trend(n + 1.0, later_x, later_xx, y + value, later_xy)

    def line(self) -> Line:
        """The line; it lies flat where all values are of one time."""
        spread = self.n * self.xx - self.x**2
        slope = (self.n * self.xy - self.x * self.y) / spread if spread > 1e-9 * self.n**2 else 0.0
        return Line((self.y - slope * self.x) / self.n, slope, spread / self.n)

    @property
    def mean(self) -> float:
        """Of the values, the last ones counting most; 0 where there are none."""
        return self.y / self.n if self.n > 0.0 else 0.0


def _trends(x: Array, series: Sequence[Array], memories: Sequence[float]) -> list[Trend]:
    """The trend of each series of values (N,) at times x [s] counted from now, with its memory [s]; nan is none."""
    y = np.array(series, float)
    known = np.isfinite(y)
    weight = np.exp(x / np.array(memories)[:, None]) * known
    y, wx = np.where(known, y, 0.0), weight * x
    sums = (weight.sum(axis=1), wx.sum(axis=1), wx @ x, (weight * y).sum(axis=1), (wx * y).sum(axis=1))
    return [Trend(*of_one) for of_one in np.transpose(sums).tolist()]


def _estimated(squares: Trend, alike: float) -> float:
    """Mean of squares of which this number agree, widened as poorly known of few (as Student's t); inf of none."""
    return squares.mean * (1.0 + 2.0 * alike / squares.n) if squares.n > 0.0 else math.inf


class Capacity(NamedTuple):
    """Trends of the capacity [N] with the long and the short memory, and what they are worth.

    told: which moments tell it (1 or 0); scatter: square of its change within LAG [N^2].
    """

    long: Trend = Trend()
    short: Trend = Trend()
    told: Trend = Trend()
    scatter: Trend = Trend()

    @classmethod
    def through(cls, t: Array, values: Array) -> Capacity:
        """Of values [N] at times t [s], both (N,); nan is none."""
        if not len(t):
            return cls()
        x = t - t[-1]
        change = (values - values[np.searchsorted(t, t - LAG)]) ** 2
        change[0] = np.nan
        return cls(*_trends(x, [values, values, np.isfinite(values), change], [LONG, SHORT, SHORT, SCATTER]))

    def joined(self, step: float, value: float | None, earlier: float | None) -> Capacity:
        """A step [s] later, with one more value or none; earlier is that of LAG before."""
        change = None if value is None or earlier is None else (value - earlier) ** 2
        return Capacity(
            self.long.joined(step, value, LONG),
            self.short.joined(step, value, SHORT),
            self.told.joined(step, float(value is not None), SHORT),
            self.scatter.joined(step, change, SCATTER),
        )

    @property
    def is_told(self) -> bool:
        """Whether enough of the last moments tell it."""
        return self.told.y > ENOUGH * self.told.n

    def slope_std(self, line: Line) -> float:
        """Of one of the two lines' slopes [N/s], at most: old moments are forgotten, but count as if they were not.

        Changes within LAG, twice the variance of the scatter, hold little of a slow change of the ground.
        inf where none is known, as when wheels pull again that have rolled for long.
        """
        in_lag = LAG / SHORT * self.told.n
        variance = _estimated(self.scatter, in_lag) / 2.0
        return math.sqrt(in_lag * variance / line.spread) if line.spread > 0.0 else math.inf


class Demand(NamedTuple):
    """Trend of a demand [N] and how much it swings about it.

    swing: square of its change within SWING beyond the change in the SWING before [N^2], which is none on any line.
    """

    trend: Trend = Trend()
    swing: Trend = Trend()

    def joined(self, step: float, value: float, earlier: float | None, earliest: float | None) -> Demand:
        """A step [s] later, with one more value; earlier and earliest are those of SWING and of twice SWING before."""
        change = None if earlier is None or earliest is None else (value - 2.0 * earlier + earliest) ** 2
        return Demand(self.trend.joined(step, value, RISE), self.swing.joined(step, change, SWINGS))

    @property
    def swing_std(self) -> float:
        """Standard deviation [N] of the swing, inf where it is not known.

        The square of a change beyond the change before is six times the variance of values without relation.
        """
        return math.sqrt(_estimated(self.swing, self._in_swing) / 6.0)

    def slope_std(self, line: Line) -> float:
        """Of the line's slope [N/s] by the swing alone, at most: values within SWING count as one."""
        return self.swing_std * math.sqrt(self._in_swing / line.spread) if line.spread > 0.0 else math.inf

    @property
    def _in_swing(self) -> float:
        """Values within SWING."""
        return SWING / RISE * self.trend.n


class Peaks(NamedTuple):
    """The greatest value since the time `since` [s], and in the `hold` [s] before it."""

    since: float = -math.inf
    now: float = -math.inf
    before: float = -math.inf

    def joined(self, t: float, value: float, hold: float) -> Peaks:
        """With one more value."""
        if t - self.since > hold:
            return Peaks(t, value, self.now)
        return self._replace(now=max(self.now, value))

    @property
    def greatest(self) -> float:
        """Of all that is remembered."""
        return max(self.now, self.before)


CREEP = 4.0
"""Time constant [s] of forgetting slip that creeps, and the pull that it gives."""
HOLD = 300.0
"""A peak of the demand is remembered this long [s] at least, and at most twice as long."""
LONGEST_GAP = 1.0
"""Silence [s] after which the trends start afresh."""
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
    afresh, and when time goes back the peaks are forgotten too.  Unknown until the trends have settled.
    """
    slips = [s for s in slip if s is not None and math.isfinite(s)]
    if not slips or pull is None or not math.isfinite(pull) or curve is None:
        return before if 0.0 <= t - before.t <= LONGEST_GAP else _restarted(before, t)
    step = t - before.t
    if not 0.0 <= step <= LONGEST_GAP:
        before, step = replace(_restarted(before, t), since=t), 0.0
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


def _restarted(before: Watch, t: float) -> Watch:
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
