"""A window whose derivatives do not know the noise that they are weighed against.

Loads and speeds are latent unknowns of every instant, and derivatives are taken where they
were fitted.  These fits keep part of the noise, and so even a window without any
variation seems to have some: n is told from k_phi by loads that differ, and those fitted do.
With ever more instants this grows like information, though no noise tells of a soil.  (Too
many unknowns: Neyman & Scott 1948, Econometrica 16:1.)

Instead, the derivatives are taken at what the latents are expected to be given their fits,
which leaves the score without bias and makes the information its variance (the
conditional score of Stefanski & Carroll 1987, Biometrika 74:703), and weights and the effect of
the latents' noise are those of the optimum.  What is left is a plain nonlinear regression
with known regressors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.linearised import Latents, Linearised, Optimum
from soilbus.estimation.residuals import WindowProblem
from soilbus.estimation.weights import inverse_covariance
from soilbus.terra.wheel import Soil

Array = NDArray[np.float64]


class DenoisedProblem(WindowProblem):
    """The problem near one of its optima, with latents as they are expected to be: only the entry angles follow."""

    def __init__(self, problem: WindowProblem, optimum: Optimum) -> None:
        self.__dict__.update(vars(problem))
        self._problem = problem
        W, fitted = problem.n_wheels, optimum.latents
        latents = np.concatenate([fitted.load, fitted.speed, fitted.ground_speed[:, None]], axis=1)
        self._expected = expected(latents, optimum.at.variance)
        load, speed, ground_speed = self._expected[:, :W], self._expected[:, W : 2 * W], self._expected[:, 2 * W]
        soil = Soil(*optimum.soil.tolist())
        self.latents = self.carried(Latents(load, speed, ground_speed, fitted.entry_angle), soil, optimum.gains)
        self._by_noise = problem.linearise(soil, optimum.gains, self.latents).by_latents
        *_, variance, row_var = self._corrected(optimum.gains)
        self._inverse = inverse_covariance(self._by_noise, variance, row_var, W)

    def allowed(self, gains: Array) -> Array:
        """As the problem itself, like all that follows."""
        return self._problem.allowed(gains)

    def gain_bounds(self) -> tuple[Array, Array]:
        """Least and greatest value that each of the gains may have, (G,) each."""
        return self._problem.gain_bounds()

    def carried(self, latents: Latents, soil: Soil, gains: Array | None = None) -> Latents:
        """The same latents with the entry angles at which this soil carries their loads."""
        return self._problem.carried(latents, soil, gains)

    def sinkages(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """Sinkage [m] of each wheel at each instant (N, W)."""
        return self._problem.sinkages(soil, gains, latents)

    def linearise(self, soil: Soil, gains: Array, latents: Latents, by_sensors: bool = True) -> Linearised:
        """Residuals and derivatives at the expected latents, weighed as at the optimum; updates leave these alone."""
        at = self._problem.linearise(soil, gains, latents, by_sensors)
        W, change = self.n_wheels, self._by_noise - at.by_latents
        rows = at.rows.reshape(*change.shape[:2], -1)
        rows[:, :, 0] += (change @ (at.corrected - self._expected)[:, :, None])[:, :, 0]
        if by_sensors:
            rows[:, :, 7 + W : 6 + self.n_sensors] -= change * at.by_gain[:, None, :]
        if len(at.by_late):
            rows[:, :, -len(at.by_late) :] += np.einsum("nml,pnl->nmp", change, at.by_late)
        weighed = (self._inverse @ rows).reshape(at.rows.shape)
        nothing = np.zeros_like(at.variance)
        return replace(
            at,
            weighed=weighed,
            normal=at.rows.T @ weighed,
            by_latents=self._by_noise,
            corrected=self._expected,
            variance=nothing,
            by_gain=nothing,
            by_late=at.by_late[:0],
        )


def expected(fitted: Array, variance: Array) -> Array:
    """Latents (N, L) as they are expected to be, given fits with noise of this variance (N, L).

    Best linear prediction from the window itself: whatever varies no more than noise does, in
    any direction, is the window's mean (singular values shrunk as by Gavish & Donoho 2017, IEEE
    Trans. Inf. Theory 63:2137, eq. 7).  What is known exactly stays as it is.
    """
    n = len(fitted)
    scale = np.sqrt(variance.mean(0))
    noisy = np.flatnonzero(scale > 0.0)
    mean = fitted.mean(0)
    left, size, right = np.linalg.svd((fitted - mean)[:, noisy] / scale[noisy], full_matrices=False)
    square, ratio = size**2 / n, len(noisy) / n
    kept = np.sqrt(np.maximum((square - ratio - 1.0) ** 2 - 4.0 * ratio, 0.0)) / np.maximum(square, 1e-300)
    kept[square <= (1.0 + np.sqrt(ratio)) ** 2] = 0.0
    calm = fitted.copy()
    calm[:, noisy] = mean[noisy] + (left * (size * kept)) @ right * scale[noisy]
    return calm
