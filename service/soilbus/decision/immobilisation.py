"""Immobilisation ahead: time until slip passes its limit, by regression of slip and pull with exponential forgetting.

    capacity      C(t) = P(t) + max over s > s(t) of P_hat(s) - P_hat(s(t))     P: pull given, P_hat: last curve
    regression    S_k(t) = S_k(t - dt) e^(-dt / tau) + x^k y, x = 0 now          line y = a + b x, weights e^(x / tau)
    time left     min of (C - peak) / -C'                                        the ground weakens
                         (C - Q) / (Q' - C')                                     draft and slope Q outgrow it
                         (s_max - s) / s'                                        slip creeps at a steady pull

Wheels on a differential share a torque: as load shifts between them, the lighter one gains more slip than the other
loses, and their mean slip grows at the same pull.  The common slip s, at which both would give what they give, hardly
grows:

    e^(-b s) = mean of e^(-b s_w)                        mu = mu_max (1 - e^(-b s)), b = 7.5 (Brixius 1987)

The recursion: `watched` takes one moment (a `Look`: time, common slip, pull given, pull asked) and the `Watch` before
it, updates the regressions' sums and the peaks, and returns the next `Watch` with its warning.  Slip alone gives no
warning: it grows slowly at first and then runs away.  The capacity does not swing with the draft and falls steadily
where the soil softens, so the warning comes when it is about to fall below what is asked, at a peak or growing.
Inertia counts as pull given, but no vehicle gains speed for long, so only draft and slope count as asked.  Their rise
is extrapolated only where it differs significantly from the swings seen before.  Each window brings a new curve, and
with it another capacity on the same ground; so the last moments' regression is recomputed along the newest curve.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from enum import StrEnum
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.decision.options import WATCH, WatchOptions
from soilbus.decision.stall_forecast import LONGEST_GAP
from soilbus.decision.traction_loss import TractionLoss
from soilbus.estimation.window import Rig, Window, inertia_of, pull_given
from soilbus.terra.vehicle import slip_ratio

if TYPE_CHECKING:
    from soilbus.decision.capability import OverSlip


class Alert(StrEnum):
    """Is the vehicle about to get stuck?"""

    UNKNOWN = "unknown"
    NONE = "none"
    IMMOBILISATION = "immobilisation"


class Line(NamedTuple):
    """Value now, slope [1/s], and sum of squares [s^2] by which the moments lie apart."""

    value: float
    slope: float
    spread: float


class Trend(NamedTuple):
    """Regression line with exponential forgetting: weighted sums of 1, x, x^2, y and x y, x [s] counted from now."""

    n: float = 0.0
    x: float = 0.0
    xx: float = 0.0
    y: float = 0.0
    xy: float = 0.0


def later(
    trends: Iterable[Trend], step: float, values: Iterable[float | None], memories: Iterable[float]
) -> list[Trend]:
    """Regressions a step [s] later, each with one more value or None, and its time constant of forgetting [s]."""
    found = []
    for (n, x, xx, y, xy), value, memory in zip(trends, values, memories, strict=True):
        kept = math.exp(-step / memory)
        n, x, xx, y, xy = kept * n, kept * x, kept * xx, kept * y, kept * xy
        x, xx, xy = x - step * n, xx - 2.0 * step * x + step**2 * n, xy - step * y
        found.append(Trend(n, x, xx, y, xy) if value is None else Trend(n + 1.0, x, xx, y + value, xy))
    return found


def lines(trends: Iterable[Trend]) -> list[Line]:
    """The lines through the values; slope 0 where all values are of one time, value nan where there are none."""
    found = []
    for n, x, xx, y, xy in trends:
        spread = n * xx - x**2
        slope = (n * xy - x * y) / spread if spread > 1e-9 * n**2 else 0.0
        found.append(Line((y - slope * x) / n, slope, spread / n) if n > 0.0 else Line(math.nan, 0.0, 0.0))
    return found


class Capacity(NamedTuple):
    """Trends of the capacity [N] with the long and the short memory, and what they are worth.

    reserve, short_reserve: trends of the part of it [N] that is not given but predicted by the curve, with both
    memories; known: 1 for a moment whose capacity is known, else 0; scatter: square of its change within `scatter_lag`
    [N^2].
    """

    long: Trend = Trend()
    short: Trend = Trend()
    reserve: Trend = Trend()
    short_reserve: Trend = Trend()
    known: Trend = Trend()
    scatter: Trend = Trend()

    @classmethod
    def through(cls, t: Array, values: Array, reserves: Array, options: WatchOptions = WATCH) -> Capacity:
        """The trends through values and reserves [N] at times t [s], each (N,); nan where not known."""
        if not len(t):
            return cls()
        x = t - t[-1]
        change = (values - values[np.searchsorted(t, t - options.scatter_lag)]) ** 2
        change[0] = np.nan
        series = [values, values, reserves, reserves, np.isfinite(values), change]
        return cls(*_trends(x, series, options.capacity_memories))

    def joined(
        self,
        step: float,
        value: float | None,
        earlier: float | None,
        reserve: float = 0.0,
        options: WatchOptions = WATCH,
    ) -> Capacity:
        """A step [s] later, with one more value [N] or None, the value `scatter_lag` before, and its reserve [N]."""
        change = None if value is None or earlier is None else (value - earlier) ** 2
        part = None if value is None else reserve
        values = value, value, part, part, float(value is not None), change
        return Capacity(*later(self, step, values, options.capacity_memories))

    @property
    def is_known(self) -> bool:
        """Whether the capacity was known at more than half of the last moments."""
        return self.known.y > 0.5 * self.known.n

    def slope_std(self, line: Line, options: WatchOptions = WATCH) -> float:
        """Upper bound of the standard deviation of a line's slope [N/s]; inf where no change is known.

        Notes
        -----
        Changes within `scatter_lag` have twice the variance of the scatter and hold little of a slow change of the
        ground.  It is a bound because old moments, which are down-weighted, count as if they were not.
        """
        in_lag = options.scatter_lag / options.short_memory * self.known.n
        variance = _estimated(self.scatter, in_lag) / 2.0
        return math.sqrt(in_lag * variance / line.spread) if line.spread > 0.0 else math.inf


class Demand(NamedTuple):
    """Trend of a demand [N] and how much it swings about it.

    swing: square [N^2] of the second difference over `swing_time`, which is zero on any straight line.
    """

    trend: Trend = Trend()
    swing: Trend = Trend()

    def joined(
        self,
        step: float,
        value: float,
        earlier: float | None,
        earliest: float | None,
        options: WatchOptions = WATCH,
    ) -> Demand:
        """A step [s] later, with one more value [N]; earlier, earliest: those `swing_time` and twice that before."""
        change = None if earlier is None or earliest is None else (value - 2.0 * earlier + earliest) ** 2
        return Demand(*later(self, step, (value, change), (options.demand_memory, options.scatter_memory)))

    def slope_std(self, line: Line, options: WatchOptions = WATCH) -> float:
        """Upper bound of the standard deviation of the line's slope [N/s]: values within `swing_time` count as one.

        The second difference of uncorrelated values has six times their variance.
        """
        if line.spread <= 0.0:
            return math.inf
        in_swing = options.swing_time / options.demand_memory * self.trend.n
        return math.sqrt(_estimated(self.swing, in_swing) / 6.0) * math.sqrt(in_swing / line.spread)


class Peaks(NamedTuple):
    """Greatest value since the time `since` [s] (now), and in the `hold` [s] before that (before)."""

    since: float = -math.inf
    now: float = -math.inf
    before: float = -math.inf

    def joined(self, t: float, value: float, hold: float) -> Peaks:
        """With one more value at t [s]."""
        if t - self.since > hold:
            return Peaks(t, value, self.now)
        return self._replace(now=max(self.now, value))

    @property
    def greatest(self) -> float:
        """Greatest value of both spans."""
        return max(self.now, self.before)


class Look(NamedTuple):
    """One moment: time [s], common slip, pull given [N] (draft, slope, inertia), pull asked by draft and slope [N]."""

    t: float
    slip: float
    pull: float
    asked: float


class Watch(NamedTuple):
    """State of the recursion: what is carried from one moment to the next; `watched` makes the next one.

    Attributes
    ----------
    t, since
        [s], the last and the first moment with slip and pull.
    recent, curve
        The last moments, and the pull over slip along which their capacity was computed.
    capacity, demand, slip, given
        Trends of the capacity [N], of draft and slope [N], of the common slip and of the pull given [N].
    peaks, asked
        Greatest pull given and greatest demand [N] of the last `peak_memory`.
    caused
        [s], when there was last a cause to warn.
    warning, time_left
        The output: the warning, and the time [s] to the slip limit, None where it is not known.
    """

    t: float = -math.inf
    since: float = math.inf
    recent: tuple[Look, ...] = ()
    curve: OverSlip | None = None
    capacity: Capacity = Capacity()
    demand: Demand = Demand()
    slip: Trend = Trend()
    given: Trend = Trend()
    peaks: Peaks = Peaks()
    asked: Peaks = Peaks()
    caused: float = -math.inf
    warning: Alert = Alert.UNKNOWN
    time_left: float | None = None


class Moment(NamedTuple):
    """Input of the recursion: time [s], slip of each driven wheel, pull and the inertia in it [N]; nan: not known."""

    t: float
    slip: list[float]
    pull: float
    inertia: float = 0.0


def watched(
    before: Watch,
    t: float,
    slip: Iterable[float | None],
    pull: float | None,
    curve: OverSlip | None,
    inertia: float = 0.0,
    options: WatchOptions = WATCH,
) -> Watch:
    """The watch after one more moment; moments may come at any rate.

    Parameters
    ----------
    before
        The watch after the moment before.
    t
        [s], time of the moment.
    slip
        Slip of each wheel that a motor can drive, as of the curve; None or nan where not known.
    pull
        [N], of draft, slope and inertia.
    curve
        Pull over slip of the last window's estimate.
    inertia
        [N], part of the pull that accelerates the vehicle.
    options
        Tuning values.

    Returns
    -------
    Watch
        Its warning is unknown until the trends are `settling_time` old.

    Notes
    -----
    After LONGEST_GAP without slip, pull or curve the trends start afresh; where time goes back, so do the peaks.
    """
    slips = [s for s in slip if s is not None and math.isfinite(s)]
    if not slips or pull is None or not math.isfinite(pull) or curve is None:
        return before if 0.0 <= t - before.t <= LONGEST_GAP else _restarted(before, t)
    step = t - before.t
    if not 0.0 <= step <= LONGEST_GAP:
        before, step = _restarted(before, t)._replace(since=t), 0.0
    look = Look(t, common_slip(slips, options.slip_exponent), pull, pull - inertia)
    reserve = float(_reserve(curve, look.slip))
    kept = before.recent[bool(before.recent and t - before.recent[0].t > options.scatter_memory) :]
    trend = before.capacity if curve is before.curve else _capacity_along(curve, kept, options)
    earlier, once, twice = _looks_from(
        kept, (t - options.scatter_lag, t - options.swing_time, t - 2.0 * options.swing_time), options.scatter_lag
    )
    capacity = trend.joined(
        step,
        _capacity_at(curve, look, reserve),
        None if earlier is None else _capacity_at(curve, earlier),
        reserve,
        options,
    )
    demand = before.demand.joined(step, look.asked, once and once.asked, twice and twice.asked, options)
    peaks = before.peaks.joined(t, pull, options.peak_memory)
    asked = before.asked.joined(t, look.asked, options.peak_memory)
    creep, given = later(
        (before.slip, before.given), step, (look.slip, pull), (options.demand_memory, options.demand_memory)
    )
    *of_capacity, rising, creeping, giving = lines((*capacity[:4], demand.trend, creep, given))
    total = pull + reserve
    share, rise = (min(look.asked, pull) / total, rising.slope / total) if total > 0.0 else (0.0, 0.0)
    time_left = None
    if t - before.since >= options.settling_time:
        time_left = 0.0
        if reserve > 0.0:
            time_left = _time_of_creep(creeping, float(curve.slip[-1]), giving.slope / total, options)
            if capacity.is_known:
                outgrown = _time_to_outgrow(of_capacity[0], rising, look.asked, demand, asked.greatest, options)
                weak = _time_to_weaken(capacity, of_capacity, peaks.greatest, _relative_std(curve), options)
                time_left = min(weak, outgrown, time_left)
    warns = before.warning is Alert.IMMOBILISATION
    rises = share > options.rising_share and rise > options.steady_rise and time_left is not None
    enough = share > options.any_rise_share if warns else rises
    caused = t if enough or (time_left is not None and time_left < options.warning_time) else before.caused
    warning = Alert.UNKNOWN if time_left is None else Alert.NONE
    if t - caused < options.hold:
        warning = Alert.IMMOBILISATION
    return Watch(
        t, before.since, (*kept, look), curve, capacity, demand, creep, given, peaks, asked, caused, warning, time_left
    )  # fmt: skip


def common_slip(slips: Sequence[float], exponent: float = WATCH.slip_exponent) -> float:
    """The slip at which all wheels would give the mean of what they give at their own slips.

    Parameters
    ----------
    slips
        Of one wheel or more, of like size.
    exponent
        b, growth of the traction ratio with slip.

    Notes
    -----
    e^(-b s) = mean of e^(-b s_w), from the traction ratio mu = mu_max (1 - e^(-b s)) (Brixius 1987).
    """
    least = min(slips)
    mean = sum(math.exp(exponent * (least - slip)) for slip in slips) / len(slips)
    return least - math.log(mean) / exponent


def with_loss(watch: Watch, loss: TractionLoss, now: float = -math.inf) -> Watch:
    """The watch as reported at `now` [s]: warned by what wheels and vehicle do as well; no time left once stuck."""
    if not loss.warns:
        slip_known = max(now, loss.t) - loss.ahead.heard <= LONGEST_GAP
        none = watch.warning is Alert.UNKNOWN and slip_known
        return watch._replace(warning=Alert.NONE) if none else watch
    left = [time for time in (watch.time_left, loss.ahead.time_left) if time is not None]
    return watch._replace(warning=Alert.IMMOBILISATION, time_left=0.0 if loss.stuck else min(left, default=None))


def has_cause(watch: Watch, loss: TractionLoss, hold: float) -> bool:
    """Whether a warning has a cause no older than `hold` [s]; else it only lasts, until a decision is go again."""
    return loss.warns or (watch.warning is Alert.IMMOBILISATION and watch.t - watch.caused < hold)


def ended(watch: Watch) -> Watch:
    """The watch after a decision is go: a warning without a cause is over, and only a new cause begins another."""
    return watch._replace(caused=-math.inf, warning=Alert.NONE)


class Warnings(NamedTuple):
    """When warnings began [s]: the present one (None without), and those since the last window, ended or not."""

    since: float | None = None
    begun: tuple[float, ...] = ()

    def after(self, t: float, warning: Alert) -> Warnings:
        """After the reported warning at t [s]."""
        if warning is not Alert.IMMOBILISATION:
            return self._replace(since=None)
        return self if self.since is not None else Warnings(t, (*self.begun, t))


def moments(window: Window, rig: Rig, chosen: NDArray[np.intp], bins: int, min_speed: float) -> Iterator[Moment]:
    """The mean slip and pull over the last bins at each of some bins.

    Parameters
    ----------
    window
        A forward window.
    rig
        With a chassis and wheels, else there are no moments.
    chosen
        (M,), the bins at which each mean ends.
    bins
        Over how many each mean goes, fewer at the window's begin (`traction_loss.bins_of_a_moment`).
    min_speed
        [m/s], ground speed up to which slip is nan.
    """
    if rig.chassis is None or not rig.wheels:
        return
    ground = window.ground_speed[:, None]
    slip = np.where(ground > min_speed, slip_ratio(rig.radius, window.speed, ground), np.nan)
    of_bins = np.column_stack([slip[:, rig.drives], pull_given(window, rig.chassis), inertia_of(window, rig.chassis)])
    place = chosen[:, None] + np.arange(1 - bins, 1)
    there = place >= 0
    total = np.where(there[:, :, None], of_bins[np.maximum(place, 0)], 0.0).sum(axis=1)
    means = total / there.sum(axis=1)[:, None]
    for t, (*slips, pull, inertia) in zip(window.t[chosen].tolist(), means.tolist(), strict=True):
        yield Moment(t, slips, pull, inertia)


def _restarted(before: Watch, t: float) -> Watch:
    """A new watch that keeps the peaks, unless time went back."""
    return Watch(peaks=before.peaks, asked=before.asked) if t >= before.peaks.since else Watch()


def _looks_from(recent: Sequence[Look], times: Iterable[float], tolerance: float) -> list[Look | None]:
    """The first look from each time [s] on; None where it came `tolerance` [s] later or more."""
    found: list[Look | None] = []
    for t in times:
        place = bisect_left(recent, (t,))  # a look begins with its time
        found.append(recent[place] if place < len(recent) and recent[place].t - t < tolerance else None)
    return found


def _capacity_at(curve: OverSlip, look: Look, reserve: float | None = None) -> float | None:
    """Pull [N] that the ground could give; None below the curve's least slip, where wheels nearly roll free.

    reserve: `_reserve` of this look, where it is known already.
    """
    if look.slip < curve.slip[0]:
        return None
    return look.pull + (float(_reserve(curve, look.slip)) if reserve is None else reserve)


def _capacity_along(curve: OverSlip, recent: Sequence[Look], options: WatchOptions) -> Capacity:
    """The capacity at the last moments along a curve."""
    t, slip, pull, _ = np.array(recent, float).reshape(-1, len(Look._fields)).T
    reserve = np.where(slip >= curve.slip[0], _reserve(curve, slip), np.nan)
    return Capacity.through(t, pull + reserve, reserve, options)


def _reserve(curve: OverSlip, slip: Array | float) -> Array:
    """Pull [N] that the curve still gains beyond slips; 0 at those where most soils allow no steady driving."""
    slips, pulls, ahead = _known_pulls(curve)
    return np.asarray(ahead[np.searchsorted(slips, slip, "right")] - np.interp(slip, slips, pulls))


@lru_cache(maxsize=2)
def _known_pulls(curve: OverSlip) -> tuple[Array, Array, Array]:
    """Slips and pulls [N] where the curve is known, and the greatest pull after each number of these slips."""
    known = np.isfinite(curve.pull)
    pull = curve.pull[known]
    return curve.slip[known], pull, np.append(np.maximum.accumulate(pull[::-1])[::-1], pull[-1:])


@lru_cache(maxsize=2)
def _relative_std(curve: OverSlip) -> float:
    """Relative sd of the curve's largest pull."""
    most = int(np.nanargmax(curve.pull))
    return float(curve.pull_std[most] / curve.pull[most]) if curve.pull[most] > 0.0 else math.inf


def _time_to_outgrow(
    limit: Line, line: Line, asked: float, demand: Demand, peak: float, options: WatchOptions
) -> float:
    """Time [s] until draft and slope, with their line, reach the capacity's limit; inf without a significant rise."""
    if asked < peak:
        return math.inf
    is_significant = line.slope > options.significant_sd * demand.slope_std(line, options)
    rises = is_significant or asked > options.any_rise_share * limit.value
    outgrows = asked > options.sure_rise_share * limit.value and line.slope > max(limit.slope, 0.0) and rises
    return max(limit.value - asked, 0.0) / (line.slope - limit.slope) if outgrows else math.inf


def _time_to_weaken(
    capacity: Capacity, of_capacity: Sequence[Line], peak: float, relative: float, options: WatchOptions
) -> float:
    """Time [s] until the capacity, extrapolated, falls to the peak of the pull [N]; relative: sd of the curve."""
    slow, fast, reserve, short_reserve = of_capacity
    long = _time_of_weakening(capacity, slow, peak, options)
    short = _time_of_weakening(capacity, fast, peak, options)
    if _due_to_the_curve(slow, reserve, options.significant_sd * relative):
        long = math.inf
    if _due_to_the_curve(fast, short_reserve, options.significant_sd * relative):
        short = math.inf
    if fast.slope < options.steepening * min(slow.slope, 0.0):
        short /= options.steepening
    return max(min(long, short), 0.0)


def _time_of_weakening(capacity: Capacity, line: Line, peak: float, options: WatchOptions) -> float:
    """Time [s] until a line of the capacity falls to the peak [N]; inf where it does not fall significantly."""
    falls = -line.slope > options.significant_sd * capacity.slope_std(line, options)
    return (line.value - peak) / -line.slope if falls else math.inf


def _due_to_the_curve(line: Line, reserve: Line, factor: float) -> bool:
    """Whether a capacity falls only as its curve may be too high or too low by e^factor.

    C' = P' - a P_hat',  |ln a| < factor: where slip and pull rise together, the sign of C' is that of their
    ratio less a; where the pull does not rise with growing slip, it is negative for every a.  Where slip falls, the
    wheels are relieved: the capacity is then lost only if the curve is steep enough at this very slip, where
    the sd of its largest pull says too little.
    """
    predicted = -reserve.slope
    given = line.slope + predicted
    if predicted < 0.0:
        return True
    return predicted > 0.0 and given > 0.0 and math.log(predicted / given) < factor


def _time_of_creep(line: Line, limit: float, rise: float, options: WatchOptions) -> float:
    """Time [s] until slip, growing under a pull that hardly rises (rise [1/s]), passes the limit."""
    creeps = line.slope > 0.0 and abs(rise) < options.steady_rise
    return max(limit - line.value, 0.0) / line.slope if creeps else math.inf


def _trends(x: Array, series: Sequence[Array], memories: Sequence[float]) -> list[Trend]:
    """The trend of each series of values (N,) at times x [s] counted from now, with its memory [s]; nan is none."""
    y = np.array(series, float)
    known = np.isfinite(y)
    weight = np.exp(x / np.array(memories)[:, None]) * known
    y, wx = np.where(known, y, 0.0), weight * x
    sums = (weight.sum(axis=1), wx.sum(axis=1), wx @ x, (weight * y).sum(axis=1), (wx * y).sum(axis=1))
    return [Trend(*of_one) for of_one in np.transpose(sums).tolist()]


def _estimated(squares: Trend, alike: float) -> float:
    """Mean of squares, `alike` of which are correlated, widened for few values (as Student's t); inf without values."""
    return squares.y / squares.n * (1.0 + 2.0 * alike / squares.n) if squares.n > 0.0 else math.inf
