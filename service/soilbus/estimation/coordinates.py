"""Coordinates in which a window's cost is closest to a parabola.

Logarithms of the free parameters, but for k_phi the logarithm of the bearing pressure at
a typical depth and tyre width: a window determines that well and k_c, k_phi and n apart
badly, so in plain logarithms the optimum lies in a long curved valley.
"""

from __future__ import annotations

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

_K_C, _K_PHI, _N = (PARAMETERS.index(name) for name in ("k_c", "k_phi", "n"))


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
        free = self.free
        directions = np.zeros((len(soil), len(free)))
        directions[free, np.arange(len(free))] = 1.0
        column = self._column
        if _K_PHI in column:
            k_phi = soil[_K_PHI]
            K_L = k_phi + soil[_K_C] / self.width
            directions[_K_PHI, column[_K_PHI]] = K_L / k_phi
            if _K_C in column:
                directions[_K_PHI, column[_K_C]] = -soil[_K_C] / self.width / k_phi
            if _N in column:
                directions[_K_PHI, column[_N]] = -K_L / k_phi * soil[_N] * np.log(TYPICAL_DEPTH)
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
            K_L = soil[_K_PHI] + soil[_K_C] / self.width
            logs[self._column[_K_PHI]] = np.log(K_L) + soil[_N] * np.log(TYPICAL_DEPTH)
        return logs

    def soil_at(self, position: Array) -> Array:
        """The soil (6,) with these coordinates (F,), kept near the prior."""
        free = self.free
        soil = self.prior.median.copy()
        soil[free] = np.exp(position)
        if _K_PHI in self._column:
            K_L = np.exp(position[self._column[_K_PHI]] - soil[_N] * np.log(TYPICAL_DEPTH))
            soil[_K_PHI] = max(K_L - soil[_K_C] / self.width, 0.01 * K_L)
        low, high = self._bounds
        soil[free] = np.minimum(np.maximum(soil[free], low), high)
        return soil

    @cached_property
    def _column(self) -> dict[int, int]:
        """Place among the coordinates of each free parameter."""
        return {parameter: i for i, parameter in enumerate(self.free.tolist())}

    @cached_property
    def _bounds(self) -> tuple[Array, Array]:
        centre, bound = self.prior.median[self.free], np.exp(BOUND * self.prior.log_std[self.free])
        return centre / bound, centre * bound

    def moved(self, soil: Array, step: Array) -> Array:
        """The soil (6,) after a step (F,) of the coordinates, shortened where it is long."""
        step = step * min(1.0, MAX_STEP / max(float(np.max(np.abs(step), initial=0.0)), 1e-12))
        return self.soil_at(self.position(soil) + step)
