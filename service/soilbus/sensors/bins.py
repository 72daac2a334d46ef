"""Samples to bins: means over short spans of time, without single outliers.

    value(c) = mean(y) + slope * (c - mean(t))       c: centre of the bin, slope: between neighbouring bins
    variance = noise / (n w),  w = 1 / (1 + d^2 / 2)     n: samples, d: shift in bins, w: worth of a sample

Sums and counts are kept by bin and channel.  Each sample is added once, however many windows contain it.  A bin without
a sample is nan, unless it lies between samples of a channel of the vehicle that is slower than the bins (`_bridge`).
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy

import numpy as np

from soilbus.arrays import Array, Indices
from soilbus.estimation.window import WHEEL_QUANTITIES, NoiseTable, Rig, Window, made_window
from soilbus.sensors.options import RECEPTION, ReceptionOptions
from soilbus.sensors.outliers import SIDE, Samples, joined, outlier_test


class Bins:
    """Sums and counts of samples by bin and channel, over a sliding span of time.

    Outliers (see `outliers`) are left out.  One found among the last four samples of its channel is tested again when
    later samples are known.  Bins have the length `bin_length` [s]; the first begins at `origin` [s].
    """

    def __init__(self, rig: Rig, bin_length: float, origin: float, options: ReceptionOptions = RECEPTION) -> None:
        self.rig, self.options = rig, options
        self.bin_length = bin_length
        self.origin = origin
        self._index = {name: i for i, name in enumerate(rig.channels)}
        self._noise = NoiseTable.of(rig)
        self._first = 0
        self._totals = np.zeros((3, 0, len(self._index)))  # count, sum of values, sum of times
        self._recent: list[Samples] = []
        self._outliers: list[Array] = []

    def add(self, samples: Mapping[str, tuple[Array, Array]]) -> None:
        """Add samples (t [s] and value in SI, both (N,)) by channel; samples before the span are dropped."""
        if not samples:
            return
        rows = np.array([self._index[name] for name in samples], np.int16)
        column = np.repeat(rows, [len(t) for t, _ in samples.values()])
        since = np.concatenate([t for t, _ in samples.values()]) - self.origin
        value = np.concatenate([v for _, v in samples.values()])
        self._recent.append(Samples(column, since, value, np.zeros(len(value), bool)))

    @np.errstate(invalid="ignore", divide="ignore")  # of bins without samples
    def window(self, start: float, end: float) -> Window:
        """Return the bins from start to end [s], both rounded to whole bins."""
        low, high = self._span(start, end)
        samples, outlier, later = outlier_test(self._taken(high), self._noise.sd, self.options)
        new = ~samples.settled
        self._count(samples.pick(new & ~outlier), high)
        again = new & outlier & (later < SIDE)
        if outlier.any():
            self._outliers.append(samples.t[new & outlier & ~again] + self.origin)
        self._recent.append(samples._replace(settled=~again).pick(later < 2 * SIDE))
        count, total, time = self._totals[:, low:high]
        mean, since = total / count, time / count
        centre: Array = (self._first + low + np.arange(len(mean), dtype=np.float64) + 0.5) * self.bin_length
        of_vehicle = slice(len(WHEEL_QUANTITIES) * self._noise.n_wheels, None)
        n, count = int(count.sum()), count.copy()
        _bridge(mean[:, of_vehicle], since[:, of_vehicle], count[:, of_vehicle], centre)
        mean, worth = _at_centres(mean, since, centre)
        return made_window(self._noise, self.origin + centre, mean, count * worth, n)

    def glimpse(self, start: float, end: float) -> Window:
        """Return the same as `window` without changing the state."""
        other = copy(self)
        other._totals, other._outliers = self._totals.copy(), []
        other._recent = [joined(self._recent)]
        return other.window(start, end)

    def screened(self, end: float) -> Samples:
        """Return the samples before `end` [s] without outliers, times [s] from `origin`; keep the state."""
        other = copy(self)
        samples, outlier, _ = outlier_test(other._taken(other._span(end, end)[1]), self._noise.sd, self.options)
        return samples.pick(~outlier)

    def new_outliers(self) -> Array:
        """Return the times [s], ascending, of the samples finally found to be outliers since the last call."""
        found = np.sort(np.concatenate([np.zeros(0), *self._outliers]))
        self._outliers.clear()
        return found

    def drop_before(self, t: float) -> None:
        """Forget the bins that end before t."""
        gone = int(np.floor((t - self.origin) / self.bin_length + 1e-9)) - self._first
        if gone > 0:
            self._totals = self._totals[:, gone:]
            self._first += gone

    def _span(self, start: float, end: float) -> tuple[int, int]:
        """Numbers of the bins that begin nearest to start and end [s], counted from the first one kept."""
        low, high = (round((t - self.origin) / self.bin_length) - self._first for t in (start, end))
        return max(low, 0), max(high, 0)

    def _bins(self, samples: Samples) -> Indices:
        return np.floor(samples.t / self.bin_length + 1e-9).astype(np.intp) - self._first

    def _taken(self, high: int) -> Samples:
        """Take the recent samples before bin `high` out of the store; those before the span are dropped."""
        recent = joined(self._recent)
        bins = self._bins(recent)
        self._recent = [recent.pick(bins >= high)]
        return recent.pick((bins >= 0) & (bins < high))

    def _count(self, samples: Samples, high: int) -> None:
        """Add samples to the totals, which reach at least up to the bin `high` afterwards."""
        short, width = high - self._totals.shape[1], self._totals.shape[2]
        if short > 0:
            self._totals = np.concatenate([self._totals, np.zeros((3, max(short, 64), width))], axis=1)
        if not len(samples.t):
            return
        bins = self._bins(samples)
        low = int(bins.min())
        place = (bins - low) * width + samples.column
        for total, weights in zip(self._totals, (None, samples.value, samples.t), strict=True):
            total[low:high] += np.bincount(place, weights, (high - low) * width).reshape(-1, width)


def bin_means(t: Array, value: Array, start: float, length: float, n: int) -> Array:
    """Return the mean (n,) of samples (N,) at times t [s] in each of n bins of a length [s]; nan in an empty bin."""
    place = np.floor((t - start) / length + 1e-6).astype(np.intp)
    inside = (place >= 0) & (place < n)
    with np.errstate(invalid="ignore", divide="ignore"):
        count = np.bincount(place[inside], minlength=n)
        return np.asarray(np.bincount(place[inside], value[inside], minlength=n) / count)


def _bridge(mean: Array, since: Array, count: Array, centre: Array) -> None:
    """Fill the bins between samples of slower channels by lines: mean, mean time [s], count (N, channels), in place.

    The samples are shared among the bins: n samples are worth no more than n.  For channels of the vehicle only, whose
    mass lets them change slowly: what a wheel does swings with its load at 1.5 to 3 Hz.  One lost sample doubles the
    gap, so a gap of more than one and a half times the channel's usual one stays empty.
    """
    filled = count > 0.0
    n_filled = filled.sum(0)
    for channel in np.flatnonzero((n_filled > 2) & (n_filled < len(filled))):
        at = np.flatnonzero(filled[:, channel])
        step = np.diff(at)
        usual = np.median(step)
        if usual < 2.0:
            continue
        step = np.where(step <= 1.5 * usual, step, 1)
        between = np.concatenate([np.arange(i + 1, i + n) for i, n in zip(at, step, strict=False)])
        mean[between, channel] = np.interp(centre[between], since[at, channel], mean[at, channel])
        since[between, channel] = centre[between]
        count[np.concatenate([at, between]), channel] = count[:, channel].sum() / (len(at) + len(between))


def _at_centres(mean: Array, since: Array, centre: Array) -> tuple[Array, Array]:
    """Bin means (N, channels) at the bins' centres [s], by the slope between neighbours, and the share they are worth.

    Messages of different phase have different mean times in a bin; a few ms matter where slip changes within a second.
    A shift by d bins multiplies the variance by 1 + d^2 / 2: the slope is between two neighbours with the same noise.
    """
    if len(mean) < 3:
        return mean, np.ones(mean.shape)
    step = (mean[1:] - mean[:-1]) / (since[1:] - since[:-1])
    slope = np.concatenate([step[:1], (mean[2:] - mean[:-2]) / (since[2:] - since[:-2]), step[-1:]])
    for aside in (step[:-1], step[1:]):
        slope[1:-1] = np.where(np.isfinite(slope[1:-1]), slope[1:-1], aside)
    known = np.isfinite(slope)
    away = np.where(known, centre[:, None] - since, 0.0)
    return mean + np.where(known, slope, 0.0) * away, 1.0 / (1.0 + (away / (centre[1] - centre[0])) ** 2 / 2.0)
