"""Measured columns -> the bins of a window, each mean with its variance.

Sensors run at their own rates and phases.  Averaging over short bins brings them onto one
time base and makes the noise small enough to be carried through the model linearly.  A
bin without an admitted sample holds nan: missing is never zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.terra.vehicle import Chassis

Array = NDArray[np.float64]

WHEEL_QUANTITIES = ("torque", "load", "speed", "sinkage")
VEHICLE_QUANTITIES = ("ground_speed", "draft", "pitch", "acceleration")


class SensorNoise(NamedTuple):
    """Sd of a sample (parts add in quadrature) and sd of a fixed relative gain error."""

    absolute: float = 0.0
    relative: float = 0.0
    of_mean: float = 0.0
    gain: float = 0.0


@dataclass(frozen=True, slots=True)
class Rig:
    """The vehicle as the estimator sees it: W wheels, their geometry, the sensors' noise.

    radius and width [m] have shape (W,); front tells which wheels are on the front axle;
    chassis is None for a test rig, whose drawbar pull is then measured directly as draft.
    """

    wheels: tuple[str, ...]
    radius: Array
    width: Array
    front: NDArray[np.bool_]
    chassis: Chassis | None
    noise: Mapping[str, SensorNoise]

    @property
    def channels(self) -> tuple[str, ...]:
        """Every channel name the rig may have, wheel quantities first."""
        per_wheel = tuple(f"{q}.{w}" for q in WHEEL_QUANTITIES for w in self.wheels)
        return per_wheel + VEHICLE_QUANTITIES


@dataclass(frozen=True, slots=True)
class Window:
    """Bin means of one window and the variances of those means; nan where missing.

    torque [N m], load [N], speed [rad/s], sinkage [m] have shape (N, W); ground_speed
    [m/s], draft [N], pitch [rad], acceleration [m/s^2] have shape (N,).  `variance` holds
    an array of the same shape for each.  `has` names the quantities with any sample.
    """

    t: Array
    torque: Array
    load: Array
    speed: Array
    sinkage: Array
    ground_speed: Array
    draft: Array
    pitch: Array
    acceleration: Array
    variance: Mapping[str, Array]
    samples: int

    def rows(self, keep: NDArray[np.intp]) -> Window:
        """The window with only these bins."""
        values = {q: getattr(self, q)[keep] for q in (*WHEEL_QUANTITIES, *VEHICLE_QUANTITIES)}
        variance = {q: v[keep] for q, v in self.variance.items()}
        return Window(t=self.t[keep], variance=variance, samples=self.samples, **values)


class BinStore:
    """Sums and counts of samples by bin and channel, over a sliding span of time.

    Bins are counted from `origin`; each sample is added once, however many windows it
    ends up in.
    """

    def __init__(self, rig: Rig, bin_length: float, origin: float) -> None:
        self.rig = rig
        self.bin_length = bin_length
        self.origin = origin
        self._index = {name: i for i, name in enumerate(rig.channels)}
        self._noise = _NoiseTable.of(rig)
        self._first = 0
        self._totals = np.zeros((3, 0, len(self._index)))  # count, sum of values, sum of times

    def add(self, samples: Mapping[str, tuple[Array, Array]]) -> None:
        """Add samples (t [s], value in SI; both (N,)) by channel; those before the span are dropped."""
        if not samples:
            return
        rows = [self._index[name] for name in samples]
        column = np.repeat(rows, [len(t) for t, _ in samples.values()])
        since = np.concatenate([t for t, _ in samples.values()]) - self.origin
        value = np.concatenate([v for _, v in samples.values()])
        bins = np.floor(since / self.bin_length + 1e-9).astype(int) - self._first
        keep = bins >= 0
        if not keep.all():
            bins, column, since, value = bins[keep], column[keep], since[keep], value[keep]
        if not len(bins):
            return
        low, end = int(bins.min()), int(bins.max()) + 1
        self._grow(end)
        shape = end - low, len(self._index)
        place = (bins - low) * shape[1] + column
        for total, weights in zip(self._totals, (None, value, since), strict=True):
            total[low:end] += np.bincount(place, weights, shape[0] * shape[1]).reshape(shape)

    def _grow(self, length: int) -> None:
        short = length - self._totals.shape[1]
        if short > 0:
            pad = np.zeros((3, max(short, 64), len(self._index)))
            self._totals = np.concatenate([self._totals, pad], axis=1)

    def drop_before(self, t: float) -> None:
        """Forget the bins that end before t."""
        gone = int(np.floor((t - self.origin) / self.bin_length + 1e-9)) - self._first
        if gone > 0:
            self._totals = self._totals[:, gone:]
            self._first += gone

    def window(self, start: float, end: float) -> Window:
        """The bins from start to end [s], both rounded to whole bins."""
        low = round((start - self.origin) / self.bin_length) - self._first
        high = round((end - self.origin) / self.bin_length) - self._first
        self._grow(high)
        low = max(low, 0)
        count, total, time = self._totals[:, low:high]
        with np.errstate(invalid="ignore", divide="ignore"):
            mean, since = total / count, time / count
        centre: Array = (self._first + low + np.arange(len(mean), dtype=np.float64) + 0.5) * self.bin_length
        mean = _at_centres(mean, since, centre)
        return _make_window(self._noise, self.origin + centre, mean, count)


def _at_centres(mean: Array, since: Array, centre: Array) -> Array:
    """Bin means moved to the bins' centres along the slope between neighbouring bins.

    mean and since (mean sample time) are (N, channels), centre is (N,).  Messages of
    different phase have different mean times in a bin; a few ms matter where slip
    changes within a second.
    """
    if len(mean) < 3:
        return mean
    slope = np.full(mean.shape, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        step = (mean[1:] - mean[:-1]) / (since[1:] - since[:-1])
        slope[1:-1] = (mean[2:] - mean[:-2]) / (since[2:] - since[:-2])
    slope[0], slope[-1] = step[0], step[-1]
    slope[1:-1] = np.where(np.isfinite(slope[1:-1]), slope[1:-1], step[:-1])
    slope[1:-1] = np.where(np.isfinite(slope[1:-1]), slope[1:-1], step[1:])
    return mean + np.where(np.isfinite(slope), slope, 0.0) * (centre[:, None] - since)


class _NoiseTable(NamedTuple):
    """A rig's noise, column by column of its channels: variance, relative and of_mean (channels,)."""

    n_wheels: int
    variance: Array
    relative: Array
    of_mean: Array

    @classmethod
    def of(cls, rig: Rig) -> _NoiseTable:
        noise = [rig.noise[name.partition(".")[0]] for name in rig.channels]
        return cls(
            len(rig.wheels),
            np.array([n.absolute**2 for n in noise]),
            np.array([n.relative for n in noise]),
            np.array([n.of_mean for n in noise]),
        )


def _make_window(noise: _NoiseTable, t: Array, mean: Array, count: Array) -> Window:
    """A window from bin means and sample counts, both (N, channels) in the order of rig.channels."""
    variance = _variance_of_means(mean, count, noise)
    values, variances = _by_quantity(mean, noise.n_wheels), _by_quantity(variance, noise.n_wheels)
    return Window(t=t, variance=variances, samples=int(count.sum()), **values)


def _by_quantity(table: Array, n_wheels: int) -> dict[str, Array]:
    """The columns (N, channels) of each quantity: (N, W) of the wheels', (N,) of the vehicle's."""
    wheels = {q: table[:, i * n_wheels : (i + 1) * n_wheels] for i, q in enumerate(WHEEL_QUANTITIES)}
    first = len(WHEEL_QUANTITIES) * n_wheels
    return wheels | {q: table[:, first + i] for i, q in enumerate(VEHICLE_QUANTITIES)}


def _variance_of_means(mean: Array, count: Array, noise: _NoiseTable) -> Array:
    """Variances (N, channels) of bin means; not finite where a bin is empty."""
    of_sample = noise.variance + np.where(noise.relative != 0.0, (noise.relative * mean) ** 2, 0.0)
    if noise.of_mean.any():
        size = np.abs(mean)
        known = np.isfinite(size)
        level = np.where(known, size, 0.0).sum(0) / np.maximum(known.sum(0), 1)
        of_sample += (noise.of_mean * level) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        variance: Array = of_sample / count
    return variance


def window_of_samples(rig: Rig, t: Array, samples: Mapping[str, Array], names: Sequence[str] = ()) -> Window:
    """A window whose every row is one sample of each named channel (tables, tests)."""
    mean = np.full((len(t), len(rig.channels)), np.nan)
    for i, name in enumerate(rig.channels):
        if name in samples and (not names or name in names):
            mean[:, i] = samples[name]
    return _make_window(_NoiseTable.of(rig), np.asarray(t, float), mean, np.isfinite(mean).astype(float))
