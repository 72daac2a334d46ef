"""Coordinates in which a window's cost is closest to a parabola.

Logarithms of the free parameters, but for k_phi the logarithm of the bearing pressure at
a typical depth and tyre width: a window determines that well and k_c, k_phi and n apart
badly, so in plain logarithms the optimum lies in a long curved valley.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.posterior import PARAMETERS, SoilPrior

Array = NDArray[np.float64]

TYPICAL_DEPTH = 0.03
MAX_STEP = 0.7
"""Longest step of a coordinate."""
BOUND = 4.0
"""Prior standard deviations of the logarithm to which a free parameter is confined."""
EDGE = 1e-4
"""Distance from a bound that is none, of a logarithm or in standard deviations of an effect's parameter."""
LITTLE, MUCH = 0.03, 0.4
"""Shares of k_c in the modulus under a mean tyre, on either side of what most windows can tell from none."""
MAX_PHI = 1.2
"""Largest free friction angle [rad], beyond any soil's: the model ends at a right angle."""

_LOG_DEPTH = math.log(TYPICAL_DEPTH)
_K_C, _K_PHI, _N, _PHI = (PARAMETERS.index(name) for name in ("k_c", "k_phi", "n", "phi"))


@dataclass(frozen=True)
class Coordinates:
    """The free parameters' coordinates (F,) for a prior and a mean tyre width [m]."""

    prior: SoilPrior
    width: float

    @cached_property
    def free(self) -> NDArray[np.intp]:
        """Indices of the free parameters, one coordinate each."""
        return self.prior.free

    def log_directions(self, soil: Array) -> Array:
        """Derivatives (6, F) of the parameters' logarithms by the coordinates."""
        directions, column = self._own_directions.copy(), self._column
        if _K_PHI in column:
            k_c, k_phi, n = soil[:3].tolist()
            K_L = k_phi + k_c / self.width
            directions[_K_PHI, column[_K_PHI]] = K_L / k_phi
            if _K_C in column:
                directions[_K_PHI, column[_K_C]] = -k_c / self.width / k_phi
            if _N in column:
                directions[_K_PHI, column[_N]] = -K_L / k_phi * n * _LOG_DEPTH
        return directions

    def bend(self, gradient: Array) -> Array:
        """Curvature (F, F) that the coordinates themselves add to chi-square, by its gradient (F,).

        The model is all but linear in k_c, and so curved in its logarithm; of that, what
        shortens steps.
        """
        curvature = np.zeros((len(gradient), len(gradient)))
        if _K_C in self._column:
            i = self._column[_K_C]
            curvature[i, i] = max(gradient[i], 0.0)
        return curvature

    def position(self, soil: Array) -> Array:
        """Coordinates (F,) of a soil (6,)."""
        logs = np.log(soil[self.free])
        if _K_PHI in self._column:
            k_c, k_phi, n = soil[:3].tolist()
            logs[self._column[_K_PHI]] = math.log(k_phi + k_c / self.width) + n * _LOG_DEPTH
        return logs

    def soil_at(self, position: Array) -> Array:
        """The soil (6,) with these coordinates (F,), kept near the prior."""
        free = self.free
        soil = self.prior.median.copy()
        soil[free] = np.exp(position)
        if _K_PHI in self._column:
            K_L = np.exp(position[self._column[_K_PHI]] - soil[_N] * _LOG_DEPTH)
            soil[_K_PHI] = max(K_L - soil[_K_C] / self.width, 0.01 * K_L)
        return self.within(soil)

    def across(self, soil: Array) -> Array | None:
        """A soil (6,) that carries a mean tyre as this one does, with much of k_c instead of little, or the reverse.

        The cost is all but a parabola in k_c, but not in its logarithm: where k_c is so
        small that it does nothing, only the prior counts, and there may be one optimum
        there and one where k_c does much.  None where k_c and k_phi are not both free.
        """
        if not {_K_C, _K_PHI} <= self._column.keys():
            return None
        K_L = soil[_K_PHI] + soil[_K_C] / self.width
        share = LITTLE if soil[_K_C] / self.width > math.sqrt(LITTLE * MUCH) * K_L else MUCH
        other = soil.copy()
        other[_K_C], other[_K_PHI] = share * K_L * self.width, (1.0 - share) * K_L
        return self.within(other)

    def within(self, soil: Array) -> Array:
        """The soil (6,) with each free parameter brought to the nearest that is near the prior and physical."""
        low, high = self._bounds
        soil[self.free] = np.minimum(np.maximum(soil[self.free], low), high)
        return soil

    def reach(self, soil: Array, step: Array) -> float:
        """Share of a step (F,) from a soil (6,) that is no longer than steps may be and stays within the bounds."""
        low, high = self._log_bounds
        change = self.log_directions(soil)[self.free] @ step
        room = np.where(change > 0.0, high, low) - np.log(soil[self.free])
        longest = MAX_STEP / max(float(np.abs(step).max(initial=0.0)), 1e-12)
        return min(longest, share_of_step(room, change))

    def edges(self, soil: Array) -> Array:
        """Directions (E, F) in which no step can go, since a parameter is at a bound."""
        at = at_edges(np.log(soil[self.free]), *self._log_bounds)
        if not at.any():
            return np.zeros((0, len(at)))
        return np.asarray((at[:, None] * self.log_directions(soil)[self.free])[at != 0.0])

    @cached_property
    def _log_bounds(self) -> tuple[Array, Array]:
        low, high = self._bounds
        return np.log(low), np.log(high)

    @cached_property
    def _own_directions(self) -> Array:
        """As `log_directions`, of coordinates that each are their parameter's logarithm."""
        return np.eye(len(PARAMETERS))[:, self.free]

    @cached_property
    def _column(self) -> dict[int, int]:
        """Place among the coordinates of each free parameter."""
        return {parameter: i for i, parameter in enumerate(self.free.tolist())}

    @cached_property
    def _bounds(self) -> tuple[Array, Array]:
        centre, bound = self.prior.median[self.free], np.exp(BOUND * self.prior.log_std[self.free])
        most = np.where(self.free == _PHI, MAX_PHI, np.inf)
        return centre / bound, np.minimum(centre * bound, most)

    def moved(self, soil: Array, step: Array) -> Array:
        """The soil (6,) after a step (F,) of the coordinates, shortened where it is long."""
        step = step * min(1.0, MAX_STEP / max(float(np.max(np.abs(step), initial=0.0)), 1e-12))
        return self.soil_at(self.position(soil) + step)


def at_edges(place: Array, low: Array, high: Array) -> Array:
    """1 or -1 (M,) where a place (M,) is at its upper or lower bound (M,), else 0."""
    return np.subtract(place >= high - EDGE, place <= low + EDGE, dtype=float)


def share_of_step(room: Array, step: Array) -> float:
    """Share of a step (M,), 1 at most, that leaves everything within the room (M,) there is; inf: no end of it."""
    cramped = np.abs(step) > np.abs(room) + EDGE
    if not cramped.any():
        return 1.0
    return max(float((room[cramped] / step[cramped]).min(initial=1.0)), 0.0)
