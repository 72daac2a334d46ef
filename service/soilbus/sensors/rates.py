"""A whole recording in bins whose length follows from its own sample rates and spectrum.

    x(c) = mean_j (y_j - s(t_j)) + s(c)

x(c) is the value at the centre c of a bin, from its samples y_j and the channel's curve s (see `local_cubics`).  It is
the value at one instant, not a mean over the bin, and does not depend on the phases of the messages; so a nonlinear
model needs no second-order term.  It is a weighted sum of samples with the variance of that sum: it is worth fewer than
n samples.

The bin is the longest at which each channel that the model needs loses at most the share `max_loss` of its samples, and
not shorter than the slowest of these channels' periods, at which every bin still has a sample.  Then a bin is short
compared with the span over which a cubic fits within noise, and cubic interpolation between bins (for delays) has an
error below the noise: at most 3/128 of the fourth difference.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.local_cubics import PHASE_PARTS, Curve, curve_of, variance_of_one
from soilbus.estimation.window import NoiseTable, Window, made_window
from soilbus.sensors.bins import Bins
from soilbus.sensors.outliers import Samples

NEEDED = ("torque", "load", "speed", "ground_speed", "draft")
"""Quantities without which the model has no residual."""


class _Channel(NamedTuple):
    """Samples of one channel (column of the rig), its curve, and whether the model needs it."""

    column: int
    t: Array
    value: Array
    curve: Curve
    needed: bool


def resolved_window(store: Bins, end: float) -> Window:
    """Return all samples of a store from its origin to `end` [s], in bins as short as its spectrum asks for.

    The store's bins are the longest.  The window has the channels' curves.
    """
    samples = store.screened(end)
    whole = store.window(store.origin, end)  # which decides what is an outlier
    noise = NoiseTable.of(store.rig)
    channels = list(_channels(samples, store, noise))
    span = end - store.origin
    names = store.rig.channels
    curves = {names[c.column]: c.curve._replace(t=c.t + store.origin) for c in channels}
    length = _bin_length(channels, store.bin_length, span, store.options.max_loss)
    if length >= store.bin_length:
        return replace(whole, curves=curves)
    n = int(np.floor(span / length + 1e-9))
    mean: Array = np.full((n, len(names)), np.nan)
    worth, counted = np.zeros(mean.shape), 0
    centre: Array = store.origin + (np.arange(n, dtype=np.float64) + 0.5) * length
    for channel in channels:
        bins, samples_of, value, worth_of = _binned(channel, length, n)
        at = bins, channel.column
        mean[at], worth[at] = value, worth_of
        counted += int(samples_of.sum())
    return replace(made_window(noise, centre, mean, worth, counted), curves=curves)


def _channels(samples: Samples, store: Bins, noise: NoiseTable) -> Iterator[_Channel]:
    for column in np.unique(samples.column).tolist():
        own = samples.column == column
        t, value = samples.t[own], samples.value[own]
        variance = noise.of_samples(value, column)
        needed = store.rig.channels[column].partition(".")[0] in NEEDED
        yield _Channel(column, t, value, curve_of(t, value, variance), needed)


def _bin_length(channels: Iterable[_Channel], longest: float, span: float, max_loss: float) -> float:
    """Length of the bins [s]: the longest / k, k = 1, 2, ..., at which no needed channel loses more than `max_loss`."""
    needed = [c for c in channels if c.needed and c.curve.step > 0.0]
    slowest = max((c.curve.step for c in needed), default=longest)
    counted = [c for c in needed if 2.0 / len(c.t) < max_loss**2]  # the loss of fewer samples is too uncertain
    lengths = itertools.takewhile(lambda length: length > slowest, (longest / parts for parts in itertools.count(1)))
    few = (length for length in lengths if all(_lost(c, length, int(span / length)) <= max_loss for c in counted))
    return next(few, min(longest, slowest))


def _lost(channel: _Channel, length: float, n: int) -> float:
    """Share of the samples lost by taking values at the centres."""
    bins, samples, _, worth = _binned(channel, length, n)
    return 1.0 - float(worth.sum() / samples.sum()) if len(bins) else 0.0


def _binned(channel: _Channel, length: float, n: int) -> tuple[NDArray[np.intp], Array, Array, Array]:
    """Of the bins 0..n-1 from time 0 on that have samples (B,): number, samples, value at the centre, their worth."""
    number = np.floor(channel.t / length + 1e-9).astype(np.intp)
    kept = (number >= 0) & (number < n)
    t, number = channel.t[kept], number[kept]
    bins, which = np.unique(number, return_inverse=True)
    count = np.asarray(np.bincount(which, minlength=len(bins)), np.float64)
    centre = np.asarray((bins + 0.5) * length, np.float64)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(which, values, len(bins)) / count)

    rest = mean(channel.value[kept] - channel.curve.at(t)[0])
    step = channel.curve.step or length
    phase = np.rint((centre - mean(t)) / step * PHASE_PARTS).astype(int)
    worth = np.ones(len(bins))  # where the curve is straight lines from sample to sample
    if channel.curve.half_width:
        kinds, which = np.unique(np.stack([count.astype(int), phase]), axis=1, return_inverse=True)
        of_kind = [1.0 / variance_of_one(channel.curve.half_width, *kind) for kind in kinds.T.tolist()]
        worth = np.minimum(np.array(of_kind)[which.ravel()], count)
    return bins, count, rest + channel.curve.at(centre)[0], worth
