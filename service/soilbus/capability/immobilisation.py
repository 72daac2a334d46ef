"""Immobilisation ahead: how long until slip passes the greatest that is allowed, from slip and pull as they come.

Slip itself gives no warning: it grows slowly at first and then runs away.  The pull that
the ground could give here and now does: it is the pull that is given, and what the last
window's pull over slip says is still to come from the present slip on.  It does not swing with
the draft, and falls steadily where the soil softens.  The warning comes when
it is about to fall below what is asked for, now and then or growing.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from soilbus.capability.assessment import OverSlip
from soilbus.estimation.window import Rig, Window, pull_given
from soilbus.terra.vehicle import slip_ratio

MEMORY = 2.5
"""Time constant [s] of the trends' forgetting."""
HOLD = 300.0
"""A peak of the demand is remembered this long [s] at least, and at most twice as long."""
LONGEST_GAP = 1.0
"""Silence [s] after which the trends start anew."""
SETTLED = 2.0
"""Age [s] from which a trend is believed."""
AHEAD = 10.0
"""Time left [s] from which is warned."""
MUCH = 0.75
"""Share of the capacity from which a rise of the demand beyond its last peaks is carried on."""
WEAKENING = 0.006
"""Loss [1/s], as a share of the capacity, from which the ground is said to weaken."""
CALM = 5.0
"""The warning ends this long [s] after its last cause."""
SPAN = 3
"""Bins of a window over which a moment's slip and pull are averaged."""


class Alert(StrEnum):
    """Is the vehicle about to get stuck?"""

    UNKNOWN = "unknown"
    NONE = "none"
    IMMOBILISATION = "immobilisation"


class Trend(NamedTuple):
    """A line through past values with exponential forgetting: sums of 1, x, x^2, y and x y, x [s] counted from now."""

    n: float = 0.0
    x: float = 0.0
    xx: float = 0.0
    y: float = 0.0
    xy: float = 0.0

    def joined(self, step: float, value: float) -> Trend:
        """The trend a step [s] later, with one more value."""
        kept = math.exp(-step / MEMORY)
        n, x, y = kept * self.n, kept * self.x, kept * self.y
        xx, xy = kept * self.xx, kept * self.xy
        return Trend(n + 1.0, x - step * n, xx - 2.0 * step * x + step**2 * n, y + value, xy - step * y)

    def line(self) -> tuple[float, float]:
        """Value now and slope [1/s]."""
        spread = self.n * self.xx - self.x**2
        slope = (self.n * self.xy - self.x * self.y) / spread if spread > 1e-9 * self.n**2 else 0.0
        return (self.y - slope * self.x) / self.n, slope


class Peaks(NamedTuple):
    """The greatest value since the time `since` [s], and in the HOLD before it."""

    since: float = -math.inf
    now: float = -math.inf
    before: float = -math.inf

    def joined(self, t: float, value: float) -> Peaks:
        """With one more value."""
        if t - self.since > HOLD:
            return Peaks(t, value, self.now)
        return self._replace(now=max(self.now, value))

    @property
    def greatest(self) -> float:
        """Of all that is remembered."""
        return max(self.now, self.before)


_NOTHING, _NO_PEAKS = Trend(), Peaks()


@dataclass(frozen=True, slots=True)
class Watch:
    """What is remembered from one moment to the next; `watched` makes the next one.

    t [s] is the last moment with slip and pull, since that of the first; capacity and demand [N]
    are trends, peaks holds the demand's greatest of late; caused [s] is when there was last a cause to
    warn.  warning and time_left [s] (None: not foreseeable) are what to tell.
    """

    t: float = -math.inf
    since: float = math.inf
    capacity: Trend = _NOTHING
    demand: Trend = _NOTHING
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
    capacity = before.capacity.joined(step, pull + reserve)
    demand = before.demand.joined(step, pull)
    peaks = before.peaks.joined(t, pull)
    time_left = None
    if t - before.since >= SETTLED:
        time_left = 0.0 if reserve <= 0.0 else _time_left(capacity.line(), (pull, demand.line()[1]), peaks.greatest)
    caused = t if time_left is not None and time_left < AHEAD else before.caused
    warning = Alert.UNKNOWN if time_left is None else Alert.NONE
    if t - caused < CALM:
        warning = Alert.IMMOBILISATION
    return Watch(t, before.since, capacity, demand, peaks, caused, warning, time_left)


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


def _time_left(capacity: tuple[float, float], demand: tuple[float, float], peak: float) -> float:
    """Time [s] until the capacity, going on as it does, meets the demand's peak or its rise."""
    (able, change), (asked, rise) = capacity, demand
    weakens, outgrows = -change > WEAKENING * abs(able), asked >= peak and asked > MUCH * able
    to_peak = (able - peak) / -change if weakens else math.inf
    to_rise = (able - asked) / (rise - change) if outgrows and rise > change else math.inf
    return max(min(to_peak, to_rise), 0.0)
