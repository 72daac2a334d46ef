"""A recording in bins beside its configuration, and the thresholds from which it contradicts it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array, Mask
from soilbus.config.model import Config
from soilbus.estimation.window import Rig, Window
from soilbus.sensors.consistency import change, without
from soilbus.terra.vehicle import slip_ratio


@dataclass(frozen=True, slots=True)
class Limits:
    """Thresholds from which a recording contradicts its configuration.

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
    """Samples of a wheel's channel in a bin below which the bin holds a value of one instant."""
    mean_of: float = 3.0
    """Samples of another channel in the same bin from which they are a mean: with loads that shake the two then
    differ."""
    weight: float = 0.15
    """Share of the weight by which the loads may differ (fuel, driver, freight); half of it is a warning."""
    axle: float = 0.12
    """The same for one axle: centre of gravity and hitch height are known to this accuracy."""
    gear: float = 0.03
    """Relative difference of motor and wheel speed, due to resolution and phase; any other gear step is larger."""
    locked: float = 0.015
    """Median difference of two wheel speeds over their mean, from which no shaft connects them: each sensor's noise and
    gain error are 0.003 and 0.002 (`noise.speed`)."""
    pushed: float = -0.2
    """Least median slip of driving wheels."""
    never_less: float = 0.45
    """Slip exceeded in 95 % of a drive, from which the speeds are implausible."""
    wheel_apart: float = 0.15
    """Difference of one wheel's median slip from the median of all."""
    free: float = 0.25
    """Largest median slip, either way, of a wheel that rolls freely: wheels towed through soft soil skid by 0.1 to 0.2
    (Wong 2008, ch. 4). None drives: above `idle_slip` its radius is in doubt."""
    transfer: float = 0.75
    """Least share of the load transfer by moments: 0 where a front and a rear cell are swapped, -1 where both are."""
    scale: tuple[float, float] = (0.6, 1.3)
    """Range of the regression slope of thrust on draft."""
    turn: float = 0.5
    """Relative difference [1] of an axle's speeds from yaw rate times track that still is a turn's, not a spin's."""
    excited: float = 0.008
    """Sd of the draft's changes within 1 s, or of an axle's thrust, as a share of the weight, below which the balance
    or the slip cannot be decided."""
    pull: float = 0.02
    """Median pull, as a share of the weight, from which thrust and pull are compared."""
    less_thrust: float = 0.9
    """Least thrust over pull: the thrust includes rolling resistance, at least a hundredth of the weight."""
    most_thrust: float = 0.9
    """Largest median thrust over weight that soil can bear for long."""
    least_slip: float = 0.03
    """Slip [1] that comes with a thrust of the load, at least. Cars on dry asphalt have as much (Gustafsson 1997,
    Automatica 33:1087), tractors 0.25 and more, a speed computed from an axle's wheels none."""
    tilted: float = 0.004
    """Sd of the slope [rad] from which it shows whether an accelerometer feels gravity: four times the sensor's own
    noise (`noise.pitch`)."""
    rolling: float = 0.05
    """Thrust over weight [1] up to which wheels only roll: tyres have 0.02 to 0.05 on firm ground (Wong 2008)."""
    idle_slip: float = 0.03
    """Slip [1] of a rolling wheel from which its radius is in doubt: tyres' rolling radii are known to 0.02."""
    side_sd: float = 4.0
    """Standard deviations by which a regression coefficient must have the wrong sign, or lie outside `scale`."""
    side_torque: float = 0.05
    """Sd of the difference of an axle's torques, over their mean, below which it tells nothing of load and slip: the
    motors are then given the same torque."""
    side_offset: float = 0.3
    """Constant difference of the torques of an axle, as a share of their mean."""
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


class UndecidableError(Exception):
    """Error of a recording that cannot decide a check; the text says which and why."""


class Facts(NamedTuple):
    """Recording in N bins, as the checks of `check --log` see it.

    raw, window: as measured, and turned forward; straight (N,): where the vehicle drives straight on; motor (N, W):
    motor speeds [rad/s]; shaft: those of motors of axles (N,), by axle; mapped: names of the mapped channels;
    by_radius: wheels whose speed is measured in m/s.
    """

    config: Config
    rig: Rig
    raw: Window
    window: Window
    straight: Mask
    motor: Array
    shaft: Mapping[str, Array]
    mapped: frozenset[str]
    by_radius: frozenset[str]

    @property
    def slip(self) -> Array:
        """Slip (N, W), nan where the vehicle does not drive straight on."""
        ground = np.where(self.straight, self.window.ground_speed, np.nan)[:, None]
        return np.asarray(slip_ratio(self.rig.radius, self.window.speed, ground))

    @property
    def thrust(self) -> Array:
        """Torque over radius [N] (N, W), nan where the vehicle does not drive straight on."""
        return np.where(self.straight[:, None], self.window.torque / self.rig.radius, np.nan)

    def less(self, channels: Iterable[str]) -> Facts:
        """Return the recording without these channels."""
        gone = set(channels)
        motor = np.where([f"motor_speed.{w}" in gone for w in self.rig.wheels], np.nan, self.motor)
        return self._replace(
            raw=without(self.raw, self.rig, gone), window=without(self.window, self.rig, gone), motor=motor
        )


def regression(y: Array, x: Array) -> tuple[Array, Array]:
    """Return the least-squares coefficients (K,) of y (N,) on the columns of x (N, K), and their std."""
    inverse = np.linalg.pinv(x.T @ x)
    factors = inverse @ x.T @ y
    residual_variance = float(((y - x @ factors) ** 2).sum()) / max(len(y) - x.shape[1], 1)
    return factors, np.sqrt(residual_variance * np.diag(inverse))


def steps(facts: Facts) -> tuple[int, int]:
    """Return the bins over which changes are compared (a second) and averaged (half a second)."""
    bin_length = facts.config.estimator.bin
    return max(round(1.0 / bin_length), 1), max(round(0.5 / bin_length), 1)


def changes(facts: Facts, *columns: Array, least: float | None = None) -> Array | None:
    """Return the changes (N, K) of K columns over a second, in means over half a second, where all are known.

    None where fewer than `least` bins are known, by default those of 20 s.
    """
    lag, block = steps(facts)
    return settled(np.stack([change(column, lag) for column in columns], axis=1), block, least)


def settled(rows: Array, block: int, least: float | None = None) -> Array | None:
    """Return the means (N, K) of each `block` known rows; None where fewer than `least` (40 blocks) are known."""
    rows = rows[np.isfinite(rows).all(axis=1)]
    return block_means(rows, block) if len(rows) >= (40 * block if least is None else least) else None


def spread(values: Array) -> float:
    """Return the standard deviation of the known values; 0 of none."""
    known = values[np.isfinite(values)]
    return float(known.std()) if len(known) else 0.0


def block_means(values: Array, n: int) -> Array:
    """Return the means of each n rows."""
    whole = len(values) // n * n
    return np.asarray(values[:whole].reshape(-1, n, values.shape[1]).mean(axis=1))
