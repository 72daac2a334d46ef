"""A window's residuals linearised at one point, as fits hand them on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(slots=True)
class Latents:
    """Unknowns of each instant: load [N], speed [rad/s], entry_angle [rad] (N, W); ground_speed [m/s] (N,)."""

    load: Array
    speed: Array
    ground_speed: Array
    entry_angle: Array

    def followed_by(self, shared: int, new: Latents) -> Latents:
        """The last `shared` instants of these and then others."""
        return Latents(
            np.concatenate([self.load[-shared:], new.load]),
            np.concatenate([self.speed[-shared:], new.speed]),
            np.concatenate([self.ground_speed[-shared:], new.ground_speed]),
            np.concatenate([self.entry_angle[-shared:], new.entry_angle]),
        )

    def part(self, instants: NDArray[np.intp] | NDArray[np.bool_]) -> Latents:
        """Those of some instants, in this order."""
        return Latents(
            self.load[instants], self.speed[instants], self.ground_speed[instants], self.entry_angle[instants]
        )


@dataclass(slots=True)
class Linearised:
    """Residuals and derivatives at one point, with what an update of the latents needs.

    The columns of `rows` and `weighed` (R, 1 + 6 + G) are the residual and its derivatives
    by the soil parameters (SI) and the gains (of the effects alone where the sensors' were
    not asked for); `weighed` is `rows` times the inverse
    covariance of its instant, so that `normal`, rows' weighed, holds chi-square and the
    normal equations.  Rows of missing data are zero.
    """

    rows: Array
    weighed: Array
    normal: Array
    by_latents: Array  # (N, m, 2 W + 1)
    corrected: Array  # (N, 2 W + 1) measured latents less their gain errors
    variance: Array  # of these
    by_gain: Array  # and minus their derivatives by the gain errors
    by_late: Array  # (P, N, 2 W + 1) and their derivatives by the effects' parameters; (0, N, 2 W + 1) of none
    off: Array  # (N, W) latent load less the model's
    load_slope: Array  # (N, W) dW/d entry angle
    load_by_slip: Array
    load_by_soil: Array  # (6, N, W)
    load_by_effects: Array  # (P, N, W)

    @property
    def chi2(self) -> float:
        """Sum of squares of the whitened residuals."""
        return float(self.normal[0, 0])

    def followed_by(self, shared: int, new: Linearised) -> Linearised:
        """The last `shared` instants of this and then those of another, linearised at the same soil and gains."""
        first = len(self.off) - shared
        row = first * self.by_latents.shape[1]
        rows, weighed = (np.concatenate([a[row:], b]) for a, b in ((self.rows, new.rows), (self.weighed, new.weighed)))
        return Linearised(
            rows=rows,
            weighed=weighed,
            normal=rows.T @ weighed,
            by_latents=np.concatenate([self.by_latents[first:], new.by_latents]),
            corrected=np.concatenate([self.corrected[first:], new.corrected]),
            variance=np.concatenate([self.variance[first:], new.variance]),
            by_gain=np.concatenate([self.by_gain[first:], new.by_gain]),
            by_late=np.concatenate([self.by_late[:, first:], new.by_late], axis=1),
            off=np.concatenate([self.off[first:], new.off]),
            load_slope=np.concatenate([self.load_slope[first:], new.load_slope]),
            load_by_slip=np.concatenate([self.load_by_slip[first:], new.load_by_slip]),
            load_by_soil=np.concatenate([self.load_by_soil[:, first:], new.load_by_soil], axis=1),
            load_by_effects=np.concatenate([self.load_by_effects[:, first:], new.load_by_effects], axis=1),
        )


@dataclass(slots=True)
class Optimum:
    """Where a fit ended: soil (6,) in SI, gains (G,), latents of the instants t (N,), and the model there."""

    t: Array
    soil: Array
    gains: Array
    latents: Latents
    at: Linearised


class Bend(NamedTuple):
    """Optimum of a window before its data were freed of a bending way, and how large bends (N, K) may be beforehand."""

    optimum: Optimum
    bends: Array
