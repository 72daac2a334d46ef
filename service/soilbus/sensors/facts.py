"""A recording decoded whole, in bins beside its configuration, and the thresholds from which it contradicts it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.can.admission import Admission
from soilbus.can.candump import Frame
from soilbus.can.channels import Column, Reason
from soilbus.config.model import Config
from soilbus.estimation.assembly import rig_of
from soilbus.estimation.instrumentation import completed
from soilbus.estimation.window import forward, turning
from soilbus.grouping import grouped
from soilbus.sensors.bins import Bins, bin_means
from soilbus.sensors.consistency import change, without
from soilbus.terra.vehicle import slip_ratio

Columns = dict[str, tuple[Array, Array]]
"""Times [s] and values (SI) by channel name."""

BATCH_SIZE = 5000
"""Number of frames that are decoded at a time."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Thresholds from which a recording contradicts its configuration, beside those of `sensors.options`.

    Where nothing else is said, recordings of the field vehicle and simulated drives stay well within them.
    """

    least_seconds: float = 10.0
    """Least time [s] of straight driving for any comparison."""
    refused: float = 0.05
    """Share of refused values from which a warning is given; four times this share is a fault."""
    rate: float = 0.8
    """Share of the DBC's rate below which a signal is too slow."""
    least_rate: float = 5.0
    """Least rate [1/s] for windows of 0.1 s bins."""
    instant: float = 1.5
    """Samples of a wheel's channel in a bin below which the bin holds a value of one instant; twice as many of another
    are a mean, and with loads that shake the two then differ."""
    weight: float = 0.15
    """Share of the weight by which loads may differ (fuel, driver, freight); half of it gives a warning."""
    skid: float = 0.2
    """Largest median slip below zero of any wheel: those towed through soft soil skid by 0.1 to 0.2 (Wong 2008)."""
    wheel_apart: float = 0.15
    """Difference of one wheel's median slip from the median of all."""
    never_less: float = 0.45
    """Slip exceeded in 95 % of a drive, from which the speeds are implausible."""
    idle_slip: float = 0.03
    """Slip [1] of a rolling wheel from which its radius is in doubt: tyres' rolling radii are known to 0.02."""
    scale: tuple[float, float] = (0.6, 1.3)
    """Range of what one force, load or speed changes by when another changes by one."""
    excited: float = 0.008
    """Sd of changes of draft or thrust within 1 s, over the weight [1], below which balance and slip stay open."""
    rolling: float = 0.05
    """Thrust over weight [1] up to which wheels only roll: tyres have 0.02 to 0.05 on firm ground (Wong 2008)."""
    most_thrust: float = 0.9
    """Largest median thrust over weight that soil can bear for long."""
    tilted: float = 0.004
    """Sd of the slope [rad] that shows whether an accelerometer feels gravity: four times `noise.pitch`."""
    side_sd: float = 4.0
    """Standard deviations by which a regression coefficient must have the wrong sign, or lie outside `scale`."""
    jump: float = 0.3
    """Median change from value to value, as a share of the median value; a vehicle's inertia keeps it lower."""
    jump_sd: float = 10.0
    """The same, in standard deviations of the configured noise."""
    windows: float = 0.2
    """Share of windows in which a sensor contradicts the others."""


LIMITS = Limits()


class Finding(NamedTuple):
    """One line of text; `fatal` if estimates would be wrong; names of the channels concerned."""

    text: str
    fatal: bool
    channels: tuple[str, ...] = ()


def fault(text: str, *channels: str) -> Finding:
    """Return a finding that makes estimates wrong."""
    return Finding(text, True, channels)


class UndecidableError(Exception):
    """Error of a recording that cannot decide a check; the text says which and why."""


def longest_part(admission: Admission, frames: Iterable[Frame]) -> tuple[Columns, Counter[tuple[str, Reason]], int]:
    """Return the samples of the longest part with one clock, and refused values and number of frames of all parts.

    admission: of the channels wanted, it is fed and emptied; frames: of one recording.
    """
    parts: list[list[tuple[str, Column]]] = [[]]
    refused: Counter[tuple[str, Reason]] = Counter()
    n = 0

    def take() -> None:
        decoded = admission.take()
        refused.update({key: len(t) for key, t in decoded.refused.items()})
        parts[-1].extend((name, column) for name, column in decoded.columns.items() if len(column.t))

    def begin_part() -> None:
        take()
        parts.append([])

    admission.at_break = begin_part
    for n, (t, identifier, extended, data, remote, error) in enumerate(frames, 1):
        if not error:
            admission.feed(t, identifier, extended, data, remote)
        if n % BATCH_SIZE == 0:
            take()
    take()
    longest = grouped(max(parts, key=lambda part: sum(len(c.t) for _, c in part)), lambda named: named[0])
    times = {name: np.concatenate([c.t for _, c in columns]) for name, columns in longest.items()}
    return {name: (t, np.concatenate([c.value for _, c in longest[name]])) for name, t in times.items()}, refused, n


class Facts:
    """Recording in N bins, as the checks of `check --log` see it.

    raw, window: as measured, and turned forward; straight (N,): where the vehicle drives straight on; motor (N, W):
    motor speeds [rad/s]; shaft: those of motors of axles (N,), by axle; mapped: names of the mapped channels;
    by_radius: wheels whose speed is measured in m/s.
    """

    def __init__(self, config: Config, mapped: Iterable[str], heard: Columns, by_radius: Collection[str]) -> None:
        self.config, self.rig, self.mapped, self.by_radius = config, rig_of(config), {*mapped}, {*by_radius}
        settings, known = config.estimator, {n: heard[n] for n in self.rig.channels if n in heard}
        start = min((float(t[0]) for t, _ in known.values()), default=0.0)
        end = max((float(t[-1]) for t, _ in known.values()), default=0.0)
        store = Bins(self.rig, settings.bin, start)
        store.add(known)
        self.raw = store.window(start, end)
        self.window = completed(forward(self.raw), self.rig)
        self.straight = np.abs(self.window.ground_speed) > settings.min_speed
        self.straight &= ~turning(self.window, self.rig, settings.max_turn)

        def binned(name: str) -> Array:
            t, value = heard.get(name, (np.empty(0), np.empty(0)))
            return bin_means(t, value, start, settings.bin, len(self.raw.t))

        self.motor = np.stack([binned(f"motor_speed.{wheel}") for wheel in self.rig.wheels], axis=1)
        self.shaft = {a.name: binned(f"speed.{a.name}") for a in config.axle if f"speed.{a.name}" in heard}

    @property
    def slip(self) -> Array:
        """Slip (N, W), nan where the vehicle does not drive straight on."""
        ground = np.where(self.straight, self.window.ground_speed, np.nan)[:, None]
        return np.asarray(slip_ratio(self.rig.radius, self.window.speed, ground))

    @property
    def thrust(self) -> Array:
        """Torque over radius [N] (N, W), nan where the vehicle does not drive straight on."""
        return np.where(self.straight[:, None], self.window.torque / self.rig.radius, np.nan)

    def bins(self, seconds: float) -> int:
        """Return how many bins a time [s] has, at least one."""
        return max(round(seconds / self.config.estimator.bin), 1)

    def less(self, channels: Iterable[str]) -> Facts:
        """Return the recording without these channels."""
        gone, other = set(channels), copy(self)
        other.motor = np.where([f"motor_speed.{w}" in gone for w in self.rig.wheels], np.nan, self.motor)
        other.raw, other.window = (without(of, self.rig, gone) for of in (self.raw, self.window))
        return other


def regression(y: Array, x: Array) -> tuple[Array, Array]:
    """Return the least-squares coefficients (K,) of y (N,) on the columns of x (N, K), and their std."""
    inverse = np.linalg.pinv(x.T @ x)
    factors = inverse @ x.T @ y
    residual_variance = float(((y - x @ factors) ** 2).sum()) / max(len(y) - x.shape[1], 1)
    return factors, np.sqrt(residual_variance * np.diag(inverse))


def changes(facts: Facts, *columns: Array, least: float = 20.0) -> Array | None:
    """Return the changes (N, K) of K columns over a second, in means over half a second, where all are known.

    None where less than `least` [s] is known.
    """
    lag = facts.bins(1.0)
    return settled(np.stack([change(column, lag) for column in columns], axis=1), facts.bins(0.5), facts.bins(least))


def settled(rows: Array, block: int, least: int) -> Array | None:
    """Return the means (N, K) of each `block` known rows; None where fewer than `least` are known."""
    rows = rows[np.isfinite(rows).all(axis=1)]
    whole = len(rows) // block * block
    return np.asarray(rows[:whole].reshape(-1, block, rows.shape[1]).mean(axis=1)) if len(rows) >= least else None
