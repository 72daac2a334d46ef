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
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from soilbus.arrays import Array, Indices
from soilbus.estimation.local_cubics import PHASE_PARTS, Curve, curve_of, variance_of_one
from soilbus.estimation.window import NoiseTable, Window, made_window
from soilbus.sensors.bins import Bins

NEEDED = ("torque", "load", "speed", "ground_speed", "draft")
"""Quantities without which the model has no residual."""

_Channel = tuple[Array, Curve]
"""Values (N,) of the samples of one channel, and their curve, which has their times from the store's origin."""


def resolved_window(store: Bins, end: float) -> Window:
    """Return all samples of a store from its origin to `end` [s], in bins as short as its spectrum asks for.

    The store's bins are the longest.  The window has the channels' curves.
    """
    samples = store.screened(end)
    whole = store.window(store.origin, end)  # which decides what is an outlier
    noise, names = NoiseTable.of(store.rig), store.rig.channels
    channels: dict[int, _Channel] = {}
    for column in np.unique(samples.column).tolist():
        own = samples.pick(samples.column == column)
        channels[column] = own.value, curve_of(own.t, own.value, noise.of_samples(own.value, column))
    curves = {names[column]: curve._replace(t=curve.t + store.origin) for column, (_, curve) in channels.items()}
    needed = [channel for column, channel in channels.items() if names[column].partition(".")[0] in NEEDED]
    span = end - store.origin
    length = _bin_length(needed, store.bin_length, span, store.options.max_loss)
    if length >= store.bin_length:
        return replace(whole, curves=curves)
    n = int(np.floor(span / length + 1e-9))
    mean: Array = np.full((n, len(names)), np.nan)
    worth, counted = np.zeros(mean.shape), 0
    centre: Array = store.origin + (np.arange(n, dtype=np.float64) + 0.5) * length
    for column, channel in channels.items():
        bins, samples_of, mean_of, worth_of = _binned(channel, length, n)
        mean[bins, column], worth[bins, column] = mean_of, worth_of
        counted += int(samples_of.sum())
    return replace(made_window(noise, centre, mean, worth, counted), curves=curves)


def _bin_length(needed: Iterable[_Channel], longest: float, span: float, max_loss: float) -> float:
    """Length of the bins [s]: the longest / k, k = 1, 2, ..., at which no needed channel loses more than `max_loss`."""
    known = [(value, curve) for value, curve in needed if curve.step > 0.0]
    slowest = max((curve.step for _, curve in known), default=longest)
    counted = [(v, curve) for v, curve in known if 2.0 / len(v) < max_loss**2]  # the loss of fewer is too uncertain
    lengths = itertools.takewhile(lambda length: length > slowest, (longest / parts for parts in itertools.count(1)))
    few = (length for length in lengths if all(_lost(c, length, int(span / length)) <= max_loss for c in counted))
    return next(few, min(longest, slowest))


def _lost(channel: _Channel, length: float, n: int) -> float:
    """Share of the samples lost by taking values at the centres."""
    bins, samples, _, worth = _binned(channel, length, n)
    return 1.0 - float(worth.sum() / samples.sum()) if len(bins) else 0.0


def _binned(channel: _Channel, length: float, n: int) -> tuple[Indices, Array, Array, Array]:
    """Of the bins 0..n-1 from time 0 on that have samples (B,): number, samples, value at the centre, their worth."""
    value, curve = channel
    number = np.floor(curve.t / length + 1e-9).astype(np.intp)
    kept = (number >= 0) & (number < n)
    t, number = curve.t[kept], number[kept]
    bins, which = np.unique(number, return_inverse=True)
    count = np.asarray(np.bincount(which, minlength=len(bins)), np.float64)
    centre = np.asarray((bins + 0.5) * length, np.float64)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(which, values, len(bins)) / count)

    rest = mean(value[kept] - curve.at(t)[0])
    step = curve.step or length
    phase = np.rint((centre - mean(t)) / step * PHASE_PARTS).astype(int)
    worth = np.ones(len(bins))  # where the curve is straight lines from sample to sample
    if curve.half_width:
        kinds, which = np.unique(np.stack([count.astype(int), phase]), axis=1, return_inverse=True)
        of_kind = [1.0 / variance_of_one(curve.half_width, *kind) for kind in kinds.T.tolist()]
        worth = np.minimum(np.array(of_kind)[which.ravel()], count)
    return bins, count, rest + curve.at(centre)[0], worth
