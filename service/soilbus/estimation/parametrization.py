"""Mean and covariance of a posterior along the share of k_c in K_L, which short windows tell badly.

Tyres of different width tell the share s of k_c in K_L = k_c/b + k_phi, and the model is
all but linear in it; what was known before is Gaussian in log k_c and log k_phi, and so in
log s and log (1 - s) given K_L.  Where the data tell s well, all that is one Gaussian.  Where
they do not, the posterior of log s falls off fast towards large s and as slowly as the
prior towards small s: the curvature at its mode says little of its spread, and less of
that of k_phi and n, which make up for k_c.  Given s the rest is Gaussian, so an integral
over s alone gives its moments (cf. Rue, Martino & Chopin, J. R. Stat. Soc. B 71, 2009, 319).

Coordinates in which a window's cost is closest to a parabola.

Logarithms of the free parameters, but for k_phi the logarithm of the bearing pressure at
a typical depth and tyre width: a window determines that well and k_c, k_phi and n apart
badly, so in plain logarithms the optimum lies in a long curved valley.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.posterior import PARAMETERS, SoilPrior

NODES = 81
REACH = 6.0
"""How far the integral goes, in standard deviations of log s by what was known before."""
MAX_SHARE = 0.99


class Moments(NamedTuple):
    """Mean (P,) of deviations from the mode and covariance (P, P) about the mean: log s, then the others."""

    mean: Array
    covariance: Array


def moments_along_share(quadratic: Array, gradient: Array, share: float) -> Moments | None:
    """Moments of a posterior with its mode at this share; None where the others are not determined.

    With d the deviation of log s and o (P - 1,) those of the others, -2 log posterior is
    z' quadratic z + 2 gradient' z, up to a constant, for z (P + 2,) of the changes of s (over
    s), log s and log (1 - s), and o.
    """
    told = np.diag(quadratic)[3:]
    if not np.all(told > 0.0):
        return None
    scale = 1.0 / np.sqrt(told)
    scaled = quadratic[3:, 3:] * np.outer(scale, scale)
    try:
        np.linalg.cholesky(scaled)  # rounding may have left it without
        inverse = np.linalg.inv(scaled) * np.outer(scale, scale)
    except np.linalg.LinAlgError:
        return None
    along = -inverse @ quadratic[3:, :3]
    own = quadratic[:3, :3] + quadratic[:3, 3:] @ along
    first, second = _over_share(own, gradient[:3] + along.T @ gradient[3:], share)
    spread = np.vstack([[0.0, 1.0, 0.0], along])
    mean, covariance = spread @ first, spread @ second @ spread.T
    mean[1:] -= inverse @ gradient[3:]
    covariance[1:, 1:] += inverse
    return Moments(mean, covariance) if np.isfinite(covariance).all() else None


def _over_share(own: Array, slope: Array, share: float) -> tuple[Array, Array]:
    """Mean (3,) of the changes of s, log s and log (1 - s), and covariance (3, 3) about it.

    The mean is that over log k_c and log k_phi, as the prior counts.  The covariance is taken with Jeffreys'
    measure, the root of the information there: intervals then hold a soil as often as
    they say also where the data tell s and the prior does not (Welch & Peers, J. R. Stat.
    Soc. B 25, 1963, 318).
    """
    at_mode = np.array([1.0, 1.0, -share / (1.0 - share)])
    scale = 1.0 / np.sqrt(at_mode @ own @ at_mode)
    widest = np.arcsinh(REACH / np.sqrt(own[1, 1]) / scale)
    at = np.linspace(-widest, widest, NODES)
    d = np.minimum(scale * np.sinh(at), np.log(MAX_SHARE / share))
    left = 1.0 - share * np.exp(d)
    changes = np.stack([np.expm1(d), d, np.log(left / (1.0 - share))])
    slopes = np.stack([np.exp(d), np.ones(NODES), 1.0 - 1.0 / left])
    cost = (changes * (own @ changes)).sum(0) + 2.0 * slope @ changes
    density = np.cosh(at) * (scale * np.sinh(at) <= d) * np.exp(-0.5 * (cost - cost.min()))
    of_prior = density / left
    mean = changes @ of_prior / of_prior.sum()
    density *= np.sqrt((slopes * (own @ slopes)).sum(0))
    off = changes - mean[:, None]
    return mean, (off * density / density.sum()) @ off.T


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

    def curvature(self, gradient: Array) -> Array:
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

    def step_share(self, soil: Array, step: Array) -> float:
        """Share of a step (F,) from a soil (6,) that is no longer than steps may be and stays within the bounds."""
        low, high = self._log_bounds
        change = self.log_directions(soil)[self.free] @ step
        room = np.where(change > 0.0, high, low) - np.log(soil[self.free])
        longest = MAX_STEP / max(float(np.abs(step).max(initial=0.0)), 1e-12)
        return min(longest, step_share_within(room, change))

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


def step_share_within(room: Array, step: Array) -> float:
    """Share of a step (M,), 1 at most, that leaves everything within the room (M,) there is; inf: no end of it."""
    cramped = np.abs(step) > np.abs(room) + EDGE
    if not cramped.any():
        return 1.0
    return max(float((room[cramped] / step[cramped]).min(initial=1.0)), 0.0)
