"""What was known before a window, as residuals of soil and gains beside those of its data."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.belief import Belief
from soilbus.estimation.posterior import PARAMETERS, SoilPrior

Array = NDArray[np.float64]

_SOIL = len(PARAMETERS)
_K_C = PARAMETERS.index("k_c")


class Known(NamedTuple):
    """What was known before, as a parabola of coordinates and active gains: information, half its gradient, cost.

    of_data: of the gradient, what data told of which k_c is Gaussian.
    """

    information: Array
    gradient: Array
    cost: float
    of_data: Array


class Earlier:
    """What was known before of the free parameters and active gains (F + A).

    Each has a residual: its logarithm's, or the gain's, deviation.  Of what data alone told
    (Belief.apart_from) k_c's is that of k_c itself, in units of the soil's known before, and the prior of
    its logarithm, which they do not hold, is one more: R are F + A, or one more.

    precision (R, R) is that of the residuals; surplus is what data and the prior of k_c cost together at
    least, which no cost counts.
    """

    def __init__(self, before: Belief, prior: SoilPrior, active: NDArray[np.intp]) -> None:
        """Active are the gains that are not held; raises ValueError where `before` has no proper covariance."""
        self._before, self._prior, self._free, self._active = before, prior, prior.free, active
        kept = np.concatenate([self._free, _SOIL + active])
        inverse = solved(before.covariance[kept[:, None], kept], np.zeros(len(kept)))
        if inverse is None:
            raise ValueError("what was known before has no proper covariance")
        self.precision = inverse[1]
        self._mean = np.concatenate([np.log(before.soil[self._free]), before.gains[active]])
        self._none = np.zeros(len(kept))
        self.surplus = 0.0
        self._of_data = before.k_c_off is not None and _K_C in self._free
        if self._of_data:
            self.precision = np.pad(self.precision, (0, 1))
            self.precision[-1, -1] = prior.log_std[_K_C] ** -2
            self.surplus = self._least()

    def seen_from(self, soil: Array, gains: Array, by_logs: Array) -> Known:
        """From a soil (6,) with gains (G,); by_logs (F + A, F + A): derivatives of logarithms and gains."""
        off, slopes = self.off(soil, gains), self.slopes(soil, by_logs)
        pull = self.precision @ off
        gradient, of_data = slopes.T @ pull, self._none
        if self._of_data:
            of_data = gradient.copy()
            of_data[_K_C] -= pull[-1]
        return Known(slopes.T @ self.precision @ slopes, gradient, float(off @ pull) - self.surplus, of_data)

    def off(self, soil: Array, gains: Array) -> Array:
        """The residuals (R,) of a soil (6,) with gains (G,)."""
        off = np.concatenate([np.log(soil[self._free]), gains[self._active]]) - self._mean
        if not self._of_data:
            return np.asarray(off)
        of_prior = np.log(soil[_K_C] / self._prior.median[_K_C])
        off[_K_C] = soil[_K_C] / self._before.soil[_K_C] - 1.0 - self._before.k_c_off
        return np.append(off, of_prior)

    def by_mean(self, soil: Array, gains: Array, shift: Array) -> tuple[Array, Array, Array]:
        """Derivatives (R, M) of the residuals by what shifts the mean by (6 + G, M), with precision and residuals."""
        by_mean = -shift[np.concatenate([self._free, _SOIL + self._active])]
        if self._of_data:
            by_mean[_K_C] *= 1.0 + (self._before.k_c_off or 0.0)
            by_mean = np.vstack([by_mean, np.zeros((1, by_mean.shape[1]))])  # the prior of its logarithm stays
        return by_mean, self.precision, self.off(soil, gains)

    def slopes(self, soil: Array, by_logs: Array, by_k_c: Array | None = None) -> Array:
        """Derivatives (R, M) of the residuals, from those (F + A, M) of logarithms and gains by some M.

        by_k_c (M,) are those of the relative change of k_c, where they are not its logarithm's.
        """
        if not self._of_data:
            return by_logs
        slopes = np.vstack([by_logs, by_logs[_K_C]])
        slopes[_K_C] = by_logs[_K_C] if by_k_c is None else by_k_c
        slopes[_K_C] *= soil[_K_C] / self._before.soil[_K_C]
        return slopes

    def _least(self) -> float:
        """Least cost that what data told of k_c and its prior have together."""
        before, spread = self._before, self._prior.log_std[_K_C]
        deviation = np.linspace(-4.0, 4.0, 161)
        k_c = self._prior.median[_K_C] * np.exp(spread * deviation) / before.soil[_K_C]
        off = k_c - 1.0 - before.k_c_off
        return float(np.min(off**2 / before.covariance[_K_C, _K_C] + deviation**2))


def solved(information: Array, gradient: Array) -> tuple[Array, Array] | None:
    """information^-1 gradient and information^-1, (F,) and (F, F); None where it is singular."""
    scale = 1.0 / np.sqrt(information.diagonal())
    scales = scale[:, None] * scale
    try:
        inverse = np.linalg.inv(information * scales)
    except np.linalg.LinAlgError:
        return None
    inverse = inverse * scales
    return (inverse @ gradient, inverse) if np.isfinite(inverse).all() else None
