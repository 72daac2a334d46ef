"""A whole recording at the resolution that its own rates and spectrum give.

    x(c) = mean_j (y_j - s(t_j)) + s(c)

is the value at the centre c of a bin by the samples y_j in it, with s the channel's curve (see `local_cubics`): not
a mean over the bin but the value of one instant, whatever the phases of the messages.  So a nonlinear model needs no
second-order term.  It is a weighted sum of samples, and its variance that of the sum: it is worth fewer than n.

The bin is the longest at which this loses at most MOST_LOST of what the n samples are worth, in each channel that
the model needs; none shorter than the slowest of these channels' periods, at which every bin still has a sample.
Then a bin is short beside the span of samples through which a cubic goes within noise, and a cubic between bins, as
delays need it, errs by less than noise: by at most 3/128 of the fourth difference.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.local_cubics import PHASE_PARTS, Curve, Series, curve_of, faithful, variance_of_one
from soilbus.estimation.window import NoiseTable, Window, made_window
from soilbus.sensors.bins import Bins
from soilbus.sensors.outliers import Samples

MOST_LOST = 0.1
"""Share of a bin's samples that its value at one instant may cost: less than the noise itself is known to."""
NEEDED = ("torque", "load", "speed", "ground_speed", "draft")
MOST_PARTS = 10
"""Into how many parts the configured bin is divided at most."""


class _Channel(NamedTuple):
    column: int
    t: Array
    value: Array
    curve: Curve
    needed: bool

    def series(self) -> Series:
        """The curve, and a faithful one."""
        return Series(self.curve, faithful(self.curve, self.value))


class _Binned(NamedTuple):
    """Each bin (B,) with samples: its number, how many, the value at the centre, how many samples that is worth."""

    bins: NDArray[np.intp]
    samples: Array
    value: Array
    worth: Array


def resolved_window(store: Bins, end: float) -> Window:
    """All samples of a store from its origin to `end` [s]; its own window where longer bins lose nothing."""
    samples = store.screened(end)
    whole = store.window(store.origin, end)  # which decides what is an outlier
    noise = NoiseTable.of(store.rig)
    channels = list(_channels(samples, store, noise))
    span = end - store.origin
    names = store.rig.channels
    curves = {names[c.column]: c.series().later(store.origin) for c in channels}
    length = _bin_length(channels, store.bin_length, span)
    if length >= store.bin_length:
        return replace(whole, curves=curves)
    n = int(np.floor(span / length + 1e-9))
    mean: Array = np.full((n, len(names)), np.nan)
    worth, count = np.zeros(mean.shape), np.zeros(mean.shape)
    centre: Array = store.origin + (np.arange(n, dtype=np.float64) + 0.5) * length
    for channel in channels:
        found = _binned(channel, length, n)
        at = found.bins, channel.column
        mean[at], worth[at], count[at] = found.value, found.worth, found.samples
    return replace(made_window(noise, centre, mean, worth, count), curves=curves)


def _channels(samples: Samples, store: Bins, noise: NoiseTable) -> Iterator[_Channel]:
    for column in np.unique(samples.column).tolist():
        own = samples.column == column
        t, value = samples.t[own], samples.value[own]
        variance = noise.of_samples(value, column)
        needed = store.rig.channels[column].partition(".")[0] in NEEDED
        yield _Channel(column, t, value, curve_of(t, value, variance), needed)


def _bin_length(channels: Iterable[_Channel], longest: float, span: float) -> float:
    """Length of the bins [s]: the longest part of the longest one at which no needed channel loses too much."""
    needed = [c for c in channels if c.needed and c.curve.step > 0.0]
    slowest = max((c.curve.step for c in needed), default=longest)
    counted = [c for c in needed if 2.0 / len(c.t) < MOST_LOST**2]  # mean squares of fewer are not known so well
    for parts in range(1, MOST_PARTS + 1):
        length = longest / parts
        if length <= slowest:
            break
        if all(_lost(c, length, int(span / length)) <= MOST_LOST for c in counted):
            return length
    return min(longest, slowest)


def _lost(channel: _Channel, length: float, n: int) -> float:
    """Share of the samples that values at the centres cost."""
    found = _binned(channel, length, n)
    return 1.0 - float(found.worth.sum() / found.samples.sum()) if len(found.bins) else 0.0


def _binned(channel: _Channel, length: float, n: int) -> _Binned:
    """The bins 0..n-1 of this length from time 0 on that have samples."""
    number = np.floor(channel.t / length + 1e-9).astype(np.intp)
    kept = (number >= 0) & (number < n)
    t, number = channel.t[kept], number[kept]
    bins, which = np.unique(number, return_inverse=True)
    count = np.asarray(np.bincount(which, minlength=len(bins)), np.float64)
    centre = np.asarray((bins + 0.5) * length, np.float64)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(which, values, len(bins)) / count)

    left = mean(channel.value[kept] - channel.curve.at(t)[0])
    step = channel.curve.step or length
    phase = np.rint((centre - mean(t)) / step * PHASE_PARTS).astype(int)
    worth = np.ones(len(bins))  # of straight lines from sample to sample
    if channel.curve.half_width:
        kinds, which = np.unique(np.stack([count.astype(int), phase]), axis=1, return_inverse=True)
        of_kind = [1.0 / variance_of_one(channel.curve.half_width, *kind) for kind in kinds.T.tolist()]
        worth = np.minimum(np.array(of_kind)[which.ravel()], count)
    return _Binned(bins, count, left + channel.curve.at(centre)[0], worth)
