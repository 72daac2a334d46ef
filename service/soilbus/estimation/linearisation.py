"""Linearisation of a window's residuals: rows and columns by name, latents, derivatives, and the end point of a fit.

rows of an instant     torques | balance | sinkages
columns                residual | soil | sensor gains | effect parameters
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.terra.wheel import Soil

RESIDUAL = 0
"""Column of `Linearisation.rows` with the residual."""
SOIL = slice(1, 1 + len(Soil._fields))
"""Columns with the derivatives by the soil parameters."""
FIRST_GAIN = SOIL.stop
"""Column of the first nuisance parameter: the sensor gains, then the effect parameters."""


class Layout(NamedTuple):
    """Named slices of rows (m), latents (2 W + 1), gains (G,) and columns of W wheels, in this order."""

    torques: slice
    balance: int
    sinkages: slice
    n_latents: int
    loads: slice
    speeds: slice
    ground_speed: int
    torque_gains: slice
    latent_gains: slice
    draft_gain: int
    standing: slice
    effects: slice
    soil_columns: slice
    sensor_columns: slice
    effect_columns: slice

    @classmethod
    @lru_cache(64)
    def of(cls, W: int, n_sensors: int) -> Layout:
        """The slices for W wheels; without columns of the sensor gains where n_sensors is 0."""
        wheels, column = slice(W), FIRST_GAIN + n_sensors
        return cls(
            torques=wheels, balance=W, sinkages=slice(W + 1, None),
            n_latents=2 * W + 1, loads=wheels, speeds=slice(W, 2 * W), ground_speed=2 * W,
            torque_gains=wheels, latent_gains=slice(W, 3 * W + 1),
            draft_gain=3 * W + 1, standing=slice(3 * W + 2, n_sensors), effects=slice(n_sensors, None),
            soil_columns=SOIL, sensor_columns=slice(FIRST_GAIN, column), effect_columns=slice(column, None),
        )  # fmt: skip


class Latents(NamedTuple):
    """Latent unknowns of each instant: load [N], speed [rad/s], entry_angle [rad] (N, W); ground_speed [m/s] (N,)."""

    load: Array
    speed: Array
    ground_speed: Array
    entry_angle: Array

    def joined(self) -> Array:
        """Loads, speeds and ground speed (N, 2 W + 1)."""
        return np.concatenate([self.load, self.speed, self.ground_speed[:, None]], axis=1)


@dataclass(slots=True)
class Linearisation:
    """Residuals and their derivatives at one point, and the derivatives that update the latents."""

    rows: Array  # (R, 1 + 6 + G), R = N m, with the columns of `Layout`; zero without a measurement
    weighed: Array  # the inverse covariance of each instant times `rows`
    normal: Array  # rows' weighed: chi-square, half its gradient, the information
    by_latents: Array  # (N, m, 2 W + 1) by the observations of the latents
    inverse: Array  # (N, m, m) inverse covariance of the rows of each instant
    corrected: Array  # (N, 2 W + 1) observations of the latents over 1 + gain
    variance: Array  # (N, 2 W + 1) variance of `corrected`
    by_gain: Array  # (N, 2 W + 1) minus the derivative of `corrected` by its own gain
    by_delay: Array  # (P, N, 2 W + 1) derivatives of `corrected` by the effect parameters; P = 0 without delays
    response: Response  # of the wheels; its derivatives of the load move the entry angles
    rolling_slip: Array  # (N, F) slips of the free wheels after a Newton step
    side_load: Array  # (N, S) loads left less right behind differentials after a Newton step
    by_sides: Array  # (N, S, m) derivatives of the rows by those of equal torques, which are used up for these loads

    @property
    def chi2(self) -> float:
        """Sum of squares of the whitened residuals."""
        return float(self.normal[0, 0])


@dataclass(slots=True)
class Optimum:
    """End point of a fit: soil (6,) in SI, gains (G,), latents at times t (N,) [s], and the linearisation there."""

    t: Array
    soil: Array
    gains: Array
    latents: Latents
    at: Linearisation


class Response(NamedTuple):
    """Drawbar pull [N], torque [N m], sinkage [m] of wheels that carry the latent loads, and derivatives at held load.

    Derivatives of the load are at the latent entry angle; load_residual [N] is the latent load less the model's.
    """

    value: Array  # (3, N, W)
    by_load: Array  # (3, N, W), as the next two
    by_speed: Array
    by_ground: Array
    by_soil: Array  # (3, 6, N, W)
    load_by_slip: Array  # (N, W)
    load_by_soil: Array  # (6, N, W)
    load_by_effects: Array  # (P, N, W)
    load_slope: Array  # (N, W), by the entry angle
    load_residual: Array
    by_effects: Array  # (3, P, N, W)

    def rolling(self, free: NDArray[np.bool_]) -> Response:
        """The response with the slips of free wheels (mask (W,)) eliminated; nothing depends on their speeds."""
        by_slip = self.by_speed.copy()
        for values in (self.value, self.by_load, self.by_soil, self.by_effects, self.by_speed):
            self.eliminate_slip(values, by_slip, free)
        self.by_ground[:, :, free] = 0.0
        return self

    @staticmethod
    def eliminate_slip(values: Array, by_slip: Array, free: NDArray[np.bool_]) -> None:
        """Take the slips of free wheels (mask (W,)) out of values (3, ..., N, W) by T = 0, to first order, in place.

        y <- y - (dy/ds) / (dT/ds) T, where y is pull, torque and sinkage, or their derivatives by something.  by_slip
        (3, N, W): their derivatives by the slip, or by the wheel's speed.
        """
        torque = by_slip[1][:, free]
        ratio = by_slip[:, :, free] / np.where(torque == 0.0, np.inf, torque)
        values[..., free] -= ratio.reshape(3, *[1] * (values.ndim - 3), *torque.shape) * values[1][..., free]


class DelayTerms(NamedTuple):
    """Measurements without delay less those taken, and their derivatives by the P effect parameters."""

    rows: Array  # (N, W + 1), of torques [N m] and demand [N]
    measured: Array  # (N, 2 W + 1), of the latents
    by_rows: Array  # (P, N, W + 1)
    by_measured: Array  # (P, N, 2 W + 1)
