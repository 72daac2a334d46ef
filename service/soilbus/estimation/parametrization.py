"""Coordinates of the soil in which a window's objective is closest to quadratic, and their bounds.

Equations.  With b the mean tyre width, z the typical depth, and K_L = k_c / b + k_phi,

    coordinates    log k_c, log (K_L z^n), log n, log phi, log c, log K        (free parameters only)
    bounds         |log parameter - log prior median| <= bound_sd prior sd,   phi <= MAX_PHI

A window determines the bearing pressure K_L z^n well and k_c, k_phi and n apart badly.  In plain logarithms
the optimum would lie in a long curved valley; with log pressure in the place of log k_phi it does not.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.options import ESTIMATOR, SearchOptions
from soilbus.estimation.posterior import PARAMETERS, SoilPrior

BOUND_TOLERANCE = 1e-4
"""Distance within which a parameter is at its bound [1: of a logarithm, or in sd of an effect's parameter]."""
MAX_PHI = 1.2
"""Largest free friction angle [rad], beyond any soil's: the model ends at a right angle."""

_K_C, _K_PHI, _N, _PHI, _C = (PARAMETERS.index(name) for name in ("k_c", "k_phi", "n", "phi", "c"))


class Coordinates:
    """The coordinates (F,) of the free parameters, with tyres of a mean width [m].

    The prior decides which parameters are free, the values of the others, and the bounds.
    """

    def __init__(self, prior: SoilPrior, width: float, options: SearchOptions = ESTIMATOR.search) -> None:
        self.prior, self.width, self.options, self.free = prior, width, options, prior.free
        self.log_depth = math.log(options.typical_depth)
        self._column = {parameter: i for i, parameter in enumerate(self.free.tolist())}
        centre, factor = prior.median[self.free], np.exp(options.bound_sd * prior.log_std[self.free])
        self._bounds = centre / factor, np.minimum(centre * factor, np.where(self.free == _PHI, MAX_PHI, np.inf))
        self._log_bounds = np.log(self._bounds[0]), np.log(self._bounds[1])
        self._last = np.zeros(0), np.zeros(0)  # soil and result of the last call of `log_directions`

    def position(self, soil: Array) -> Array:
        """Return the coordinates (F,) of a soil (6,) in SI."""
        logs = np.log(soil[self.free])
        if _K_PHI in self._column:
            k_c, k_phi, n = soil[:3].tolist()
            logs[self._column[_K_PHI]] = math.log(k_phi + k_c / self.width) + n * self.log_depth
        return logs

    def soil_at(self, position: Array) -> Array:
        """Return the soil (6,) in SI with these coordinates (F,), clipped to the bounds."""
        free = self.free
        soil = self.prior.median.copy()
        soil[free] = np.exp(position)
        if _K_PHI in self._column:
            K_L = np.exp(position[self._column[_K_PHI]] - soil[_N] * self.log_depth)
            soil[_K_PHI] = K_L - soil[_K_C] / self.width
        soil[free] = np.clip(soil[free], *self._bounds)
        return soil

    def log_directions(self, soil: Array) -> Array:
        """Return the derivatives (6, F) of the parameters' logarithms by the coordinates."""
        if self._last[0] is soil:
            return self._last[1]
        directions, column = np.eye(len(PARAMETERS))[:, self.free], self._column
        if _K_PHI in column:
            k_c, k_phi, n = soil[:3].tolist()
            K_L = k_phi + k_c / self.width
            directions[_K_PHI, column[_K_PHI]] = K_L / k_phi
            if _K_C in column:
                directions[_K_PHI, column[_K_C]] = -k_c / self.width / k_phi
            if _N in column:
                directions[_K_PHI, column[_N]] = -K_L / k_phi * n * self.log_depth
        directions.flags.writeable = False
        self._last = soil, directions
        return directions

    def stepped(self, soil: Array, step: Array) -> Array:
        """Return the soil (6,) after a step (F,), which is shortened to `max_log_step`."""
        step = step * min(1.0, self.options.max_log_step / max(float(np.max(np.abs(step), initial=0.0)), 1e-12))
        return self.soil_at(self.position(soil) + step)

    def step_fraction(self, soil: Array, step: Array) -> float:
        """Return the fraction of a step (F,) from a soil (6,) within the bounds and `max_log_step`, 1 at most."""
        low, high = self._log_bounds
        change = self.log_directions(soil)[self.free] @ step
        room = np.where(change > 0.0, high, low) - np.log(soil[self.free])
        longest = self.options.max_log_step / max(float(np.abs(step).max(initial=0.0)), 1e-12)
        return min(longest, step_fraction_within(room, change))

    def active_bounds(self, soil: Array) -> Array:
        """Return the outward directions (E, F) of the bounds that a soil (6,) is at."""
        sides = at_bounds(np.log(soil[self.free]), *self._log_bounds)
        if not sides.any():
            return np.zeros((0, len(sides)))
        return np.asarray((sides[:, None] * self.log_directions(soil)[self.free])[sides != 0.0])


@lru_cache(maxsize=16)
def coordinates_of(prior: SoilPrior, width: float, options: SearchOptions) -> Coordinates:
    """Return the coordinates, the same ones for the same prior."""
    return Coordinates(prior, width, options)


def at_bounds(value: Array, low: Array, high: Array) -> Array:
    """Return 1.0 or -1.0 (M,) where a value (M,) is at its upper or lower bound (M,), else 0.0."""
    return np.subtract(value >= high - BOUND_TOLERANCE, value <= low + BOUND_TOLERANCE, dtype=float)


def step_fraction_within(room: Array, step: Array) -> float:
    """Return the fraction of a step (M,), 1 at most, that stays within distances (M,) to the bounds."""
    crosses = np.abs(step) > np.abs(room) + BOUND_TOLERANCE
    if not crosses.any():
        return 1.0
    return max(float((room[crosses] / step[crosses]).min(initial=1.0)), 0.0)
