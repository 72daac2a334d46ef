"""Single outliers: readings that fit neither their noise nor the readings around them.

    outlier    |y - line(t)| > max(a sd, a sd_v, b q)     a, b: outlier_sd, quartile_distances

The line joins the medians of the four samples before and of the four after (Hampel identifier with the trend taken out;
cf. Davies & Gather, J. Am. Stat. Assoc. 88, 1993, 782-792).  sd is the sensor's noise, sd_v the channel's own scatter,
q the distance of the quartiles of the nine samples less their trend.  sd_v and q widen the limit in vibration, steps
and bends, so that only one or two samples that stand out alone are outliers.  Longer runs, frozen sensors and offsets
are found by `consistency` or by the fit of the model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array, Indices, Mask
from soilbus.sensors.options import RECEPTION, ReceptionOptions

OUTLIER = "outlier"
"""Reason under which outliers are counted."""
SIDE = 4
"""Samples on each side that a sample is compared with."""
SPAN = 2 * SIDE + 1
MEDIAN_SECOND_DIFFERENCE = 1.65
"""Median second difference of normal samples, in their standard deviation."""


class Samples(NamedTuple):
    """Samples of many channels: column of the channel, time [s], value in SI, whether they are settled; each (N,)."""

    column: NDArray[np.int16]
    t: Array
    value: Array
    settled: Mask

    def pick(self, which: Mask | Indices) -> Samples:
        """Return the samples of a mask (N,) or of indices."""
        return Samples(self.column[which], self.t[which], self.value[which], self.settled[which])


def outlier_test(
    samples: Samples, sd: Callable[[Indices, Array, Array], Array], options: ReceptionOptions = RECEPTION
) -> tuple[Samples, Mask, Indices]:
    """Return samples in order, which of them are outliers, and how many of their channel follow each one; each (N,).

    sd: of the samples (N,), by the number in each channel (C,), expected magnitudes (N,), their means by channel (C,).
    A channel of fewer than nine is not judged; the first and last four of others by the line nearest to them.
    """
    samples = samples.pick(np.lexsort((samples.value, samples.t, samples.column)))
    column, t, value, _ = samples
    n = len(t)
    count = np.bincount(column)
    end = np.cumsum(count)
    here = np.arange(n)
    later = np.repeat(end, count) - here - 1
    outlier = np.zeros(n, bool)
    if n < SPAN:
        return samples, outlier, later
    line = np.clip(here - SIDE, np.repeat(end - count, count), np.repeat(np.maximum(end - SPAN, 0), count))
    slope, level, when = _lines(t, value).take(line, axis=1)
    expected = level + slope * (t - when)
    off = np.abs(value - expected)
    size = np.abs(expected)
    noise = sd(count, size, np.bincount(column, size) / np.maximum(count, 1))
    far = np.flatnonzero(off > options.outlier_sd * noise)
    far = far[count[column[far]] >= SPAN]
    if len(far):
        first = line[far, None]
        nine = first + np.arange(SPAN)
        level = np.sort(value[nine] - slope[far, None] * (t[nine] - t[first]), axis=1)
        spread = options.quartile_distances * (level[:, SIDE + 2] - level[:, SIDE - 2])
        scatter = options.outlier_sd * _vibration(value, noise, end - count, end, column[far]) * noise[far]
        outlier[far] = off[far] > np.maximum(spread, scatter)
    return samples, outlier, later


def _lines(t: Array, value: Array) -> Array:
    """Robust lines through four samples before and four after each one: slopes, levels and their times (3, N - 8).

    They join the medians of both fours (Brown & Mood, 1951).
    """
    fours = np.sort([value[i : len(value) - 3 + i] for i in range(4)], axis=0)
    four = np.stack([(fours[1] + fours[2]) * 0.5, (t[1:-2] + t[2:-1]) * 0.5])
    before, after = four[:, : -SIDE - 1], four[:, SIDE + 1 :]
    rise, run = after - before
    slope = np.divide(rise, run, where=run > 0.0, out=np.zeros(len(run)))  # 0 where the nine are of two channels
    return np.stack([slope, *(before + after) * 0.5])


def _vibration(value: Array, noise: Array, begin: Indices, end: Indices, column: NDArray[np.int16]) -> Array:
    """How many sd of the noise the second differences of these columns (M,) show.

    value[begin:end], of (C,), are the samples of one column.
    """
    vibration = np.zeros(len(begin))
    for c in np.unique(column):
        second_difference = np.diff(value[begin[c] : end[c]], 2) / noise[begin[c] + 1 : end[c] - 1]
        vibration[c] = np.median(np.abs(second_difference)) / MEDIAN_SECOND_DIFFERENCE
    return vibration[column]


def joined(parts: Sequence[Samples]) -> Samples:
    """Return all samples of the parts."""
    return Samples(*map(np.concatenate, zip(*(parts or (NO_SAMPLES,)), strict=True)))


NO_SAMPLES = Samples(np.zeros(0, np.int16), np.zeros(0), np.zeros(0), np.zeros(0, bool))
