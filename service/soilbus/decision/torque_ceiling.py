"""Saturation: the greatest torque that a motor gives, from its torque alone, independent of any reported limit.

Torque T of a wheel below its motor's ceiling follows the pull Q that is asked of the vehicle; at the ceiling it does
not.  Over one span of bins, with means T', Q' and mean load N':

    follows      T - b (Q - Q') - T' (N / N' - 1) has no trend     b = T' / sum(T' / r): its share of the thrust
    saturated    T - T' is noise without trend, and T does not follow      a trend: a slope beyond its residuals

A wheel follows where it does so with its load or without.  Q is draft, slope and what speeds the vehicle up.  A ceiling
is never exceeded, so only the highest torque so far can be one.  A command held below it looks the same while it lasts:
one plateau counts while the vehicle loses speed on it; a second one at the same level, with less torque between them,
makes it a ceiling until the torque exceeds it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from soilbus.arrays import Array, Mask
from soilbus.estimation.window import Rig, Window, inertia_of, pull_asked

LEAST_BINS = 4
"""Bins of a span from which scatter and trend can be separated: one mean, one slope, two degrees of freedom."""


@dataclass(frozen=True, slots=True, eq=False)
class TorqueCeiling:
    """Each wheel's (W,) ceiling, as measured in one recording; `after` takes the next window.

    t [s]: end of the last span.  highest [N m]: largest mean of a span.  level [N m]: of the plateau on which the wheel
    was saturated last, nan without one.  lasts: the torque has not been below the level since.  unmet: the vehicle lost
    speed on this plateau, and has not gained any since.  returned: the torque was below the level, and the wheel was
    saturated at this level again.
    """

    t: float
    highest: Array
    level: Array
    lasts: Mask
    unmet: Mask
    returned: Mask

    @classmethod
    def unknown(cls, wheels: int) -> TorqueCeiling:
        """Return the state before any measurement."""
        no = np.zeros(wheels, bool)
        return cls(-math.inf, np.full(wheels, -np.inf), np.full(wheels, np.nan), no, no, no)

    @property
    def limit(self) -> Array:
        """Greatest available torque (W,) [N m]; nan where no ceiling was found."""
        return np.where((self.lasts & self.unmet) | self.returned, self.level, np.nan)

    def after(self, window: Window, rig: Rig, span: float, deviations: float) -> TorqueCeiling:
        """Return the ceiling after one more forward window with the true draft, of which only new spans count.

        span [s]: length of a plateau, and time between two evaluations.  deviations: sd from which a difference is
        significant.
        """
        if rig.chassis is None or not len(window.t):
            return self
        end = float(window.t[-1])
        first = window.t[0] if math.isinf(self.t) else max(self.t, window.t[0])
        now = self
        for k in reversed(range(round((end - first) / span))):
            inside = (window.t > end - (k + 1) * span) & (window.t <= end - k * span)
            now = now._after_span(window.rows(np.flatnonzero(inside)), rig, deviations)
        return replace(now, t=end)

    def _after_span(self, window: Window, rig: Rig, deviations: float) -> TorqueCeiling:
        if len(window.t) < LEAST_BINS:
            return self
        torque, var = window.torque.mean(axis=0), window.variance["torque"].mean(axis=0) / len(window.t)
        since = window.t - window.t.mean()
        with np.errstate(invalid="ignore"):  # a speed or torque that is no number
            gain = float(since @ window.ground_speed)  # of the ground speed's regression on time
            noise = deviations * np.sqrt(2.0 * var)
            exceeded, below = torque - self.level > noise, self.level - torque > noise
            saturated = _saturated(window, rig, deviations) & (self.highest - torque <= noise)
        known = np.isfinite(self.level) & ~exceeded
        same = saturated & known & ~below
        level = np.where(saturated, torque, np.where(known, self.level, np.nan))
        of_noise = deviations * math.sqrt(float(since**2 @ window.variance["ground_speed"]))
        lasts = saturated | (self.lasts & known & ~below)
        return replace(
            self,
            highest=np.fmax(self.highest, torque),
            level=level,
            lasts=lasts,
            unmet=lasts & ((self.unmet & (gain < of_noise)) | (saturated & (gain < -of_noise))),
            returned=known & (self.returned | (same & ~self.lasts)),
        )


def _saturated(window: Window, rig: Rig, deviations: float) -> Mask:
    """Which wheels' torques (W,) stand within noise and do not follow the trend of the pull asked of the vehicle."""
    assert rig.chassis is not None
    pull = pull_asked(window, rig.chassis) + np.maximum(inertia_of(window, rig.chassis), 0.0)
    mean, n = window.torque.mean(axis=0), len(window.t)
    since = (window.t - window.t.mean())[:, None]
    with np.errstate(all="ignore"):  # nan and inf where a sensor sends what no motor gives
        share = mean / np.nansum(mean / rig.radius)
        by_pull = (pull - pull.mean())[:, None] * share
        by_load = np.nan_to_num(mean * (window.load / window.load.mean(axis=0) - 1.0))
        spread = ((window.torque - mean) ** 2 / window.variance["torque"]).sum(axis=0)
        stands = spread <= n - 1.0 + deviations * math.sqrt(2.0 * (n - 1.0))
        stands &= _trend(since, window.torque) <= deviations
        noise = window.variance["torque"].mean(axis=0)
        follows = [_trend(since, window.torque - by_pull - part, noise) <= deviations for part in (0.0, by_load)]
    return np.asarray((share > 0.0) & stands & ~follows[0] & ~follows[1])


def _trend(since: Array, values: Array, variance: Array | float = 0.0) -> Array:
    """Slope of columns (N, W) over time (N, 1) as normal deviate (Wallace 1959), of residuals with this variance."""
    values, free = values - values.mean(axis=0), len(values) - 2
    spread = float((since**2).sum())
    slope = (since * values).sum(axis=0) / spread
    rest = np.maximum(((values - slope * since) ** 2).sum(axis=0) / free, variance)
    share = (8.0 * free + 1.0) / (8.0 * free + 3.0)
    return np.asarray(share * np.sqrt(free * np.log1p(slope**2 * spread / rest / free)))
