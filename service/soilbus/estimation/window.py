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
        self._first = 0
        self._totals = np.zeros((3, 0, len(self._index)))  # count, sum of values, sum of times

    def add(self, channel: str, t: Array, value: Array) -> None:
        """Add samples (t [s], value in SI; both (N,)) of a channel; those before the span are dropped."""
        since = t - self.origin
        bins = np.floor(since / self.bin_length + 1e-9).astype(int) - self._first
        keep = bins >= 0
        if not keep.all():
            bins, value, since = bins[keep], value[keep], since[keep]
        if not len(bins):
            return
        self._grow(int(bins.max()) + 1)
        low = int(bins.min())
        place = bins - low
        sums = [np.bincount(place), np.bincount(place, weights=value), np.bincount(place, weights=since)]
        self._totals[:, low : low + len(sums[0]), self._index[channel]] += sums

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
        centre = (self._first + low + np.arange(len(mean)) + 0.5) * self.bin_length
        mean = _at_centres(mean, since, centre)
        return make_window(self.rig, self.origin + centre, mean, count)


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
        step = np.diff(mean, axis=0) / np.diff(since, axis=0)
        slope[1:-1] = (mean[2:] - mean[:-2]) / (since[2:] - since[:-2])
    slope[0], slope[-1] = step[0], step[-1]
    slope[1:-1] = np.where(np.isfinite(slope[1:-1]), slope[1:-1], step[:-1])
    slope[1:-1] = np.where(np.isfinite(slope[1:-1]), slope[1:-1], step[1:])
    return mean + np.where(np.isfinite(slope), slope, 0.0) * (centre[:, None] - since)


def make_window(rig: Rig, t: Array, mean: Array, count: Array) -> Window:
    """A window from bin means and sample counts, both (N, channels) in the order of rig.channels."""
    n_wheels = len(rig.wheels)
    values: dict[str, Array] = {}
    variance: dict[str, Array] = {}
    column = 0
    for quantity in WHEEL_QUANTITIES + VEHICLE_QUANTITIES:
        wide = n_wheels if quantity in WHEEL_QUANTITIES else 1
        part, n = mean[:, column : column + wide], count[:, column : column + wide]
        column += wide
        variance[quantity] = _variance_of_mean(part, n, rig.noise[quantity])
        values[quantity] = part
        if quantity in VEHICLE_QUANTITIES:
            values[quantity], variance[quantity] = part[:, 0], variance[quantity][:, 0]
    return Window(t=t, variance=variance, samples=int(count.sum()), **values)


def _variance_of_mean(mean: Array, count: Array, noise: SensorNoise) -> Array:
    variance = np.full(mean.shape, noise.absolute**2)
    if noise.relative:
        variance += (noise.relative * mean) ** 2
    if noise.of_mean:
        size = np.abs(mean)
        known = np.isfinite(size)
        level = np.where(known, size, 0.0).sum(0) / np.maximum(known.sum(0), 1)
        variance += (noise.of_mean * level) ** 2
    with np.errstate(divide="ignore"):
        return variance / count


def window_of_samples(rig: Rig, t: Array, samples: Mapping[str, Array], names: Sequence[str] = ()) -> Window:
    """A window whose every row is one sample of each named channel (tables, tests)."""
    mean = np.full((len(t), len(rig.channels)), np.nan)
    for i, name in enumerate(rig.channels):
        if name in samples and (not names or name in names):
            mean[:, i] = samples[name]
    return make_window(rig, np.asarray(t, float), mean, np.isfinite(mean).astype(float))
