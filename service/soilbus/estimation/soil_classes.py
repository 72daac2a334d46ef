"""Probabilities of the soils of the table, "unknown" included, given a window's posterior.

Equations.  Class i has probability p_i beforehand and soils x ~ N(m_i, S_i) in the coordinates of
`parametrization`.  The data are D x = y + noise, noise ~ N(0, V), and so

    P(class i | data) ~ p_i N(y; D m_i, D S_i D' + V)              (multiple models: Ray 2008, Proc. SPIE 6962:505)

where D, y and V are the information of the posterior minus that of the part of the prior that is only a guess.

A class is a soil of the table with the spread of repeated measurements (WITHIN_CLASS_SD); `unknown` is spread as widely
as the rows of the table are about their mean.  Held parameters are left out, and so is k_c: a window determines at best
that it is not large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.parametrization import Coordinates
from soilbus.estimation.posterior import PARAMETERS, Posterior, SoilPrior
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import KINDS, SOILS, UNKNOWN
from soilbus.terra.wheel import Soil, sinkage, state_on, wheel_forces

__all__ = ["WITHIN_CLASS_SD", "SoilClasses", "guessed", "ranked_by_likelihood"]

PRIOR_UNKNOWN = 0.5
"""Probability of `unknown` before any window [1]; the kinds of the table share the rest evenly.

No evidence recorded.
"""
WITHIN_CLASS_SD = {"k_c": 0.5, "k_phi": 0.25, "n": 0.16, "phi": 0.10, "c": 0.45, "K": 0.45}
"""Sd of the logarithm of each parameter within a class [1]; for k_phi that of the bearing pressure.

One prepared sand bed: phi 8.7 %, c 58 %, pressure 9 %, n 16 % (Jayakumar et al. 2014, J. Terramech. 54:37).  The two
rows of Wong's table for one snow differ by 1.4 times these sds.  Within a field: phi up to 12 %, strength 20 to 40 %
(Phoon & Kulhawy 1999, Can. Geotech. J. 36:612).  K is no part of Wong's table: planning figures, right to half of
themselves.
"""

_K_C = PARAMETERS.index("k_c")


@dataclass(frozen=True)
class SoilClasses:
    """Classes of soil in the coordinates of tyres of a mean width."""

    names: tuple[str, ...]  # `unknown` is the last one
    centre: Array  # (C, 6), mean and sd of each coordinate
    spread: Array
    width: float  # mean tyre width [m]

    @classmethod
    def of_table(cls, width: float) -> SoilClasses:
        """Return every kind of the table, and `unknown`, for tyres of a mean width [m]."""
        everything = Coordinates(SoilPrior(np.ones(len(PARAMETERS)), np.ones(len(PARAMETERS))), width)
        known = np.array([everything.position(np.asarray(SOILS[name])) for name in KINDS])
        within = np.array([WITHIN_CLASS_SD[name] for name in PARAMETERS])
        among = np.sqrt(known.var(axis=0, ddof=1) + within**2)
        spread = np.vstack([np.broadcast_to(within, known.shape), among])
        return cls((*KINDS, UNKNOWN), np.vstack([known, known.mean(axis=0)]), spread, width)

    def probabilities(self, posterior: Posterior, guess: SoilPrior) -> dict[str, float]:
        """Return the probability of each class given a window's posterior, the largest first.

        guess is the part of its prior that was only a guess (`guessed`): it is not evidence and is divided out.
        """
        at, direction, value, variance = _evidence(posterior, guess, self.width, self.spread[-1])
        off = value - self.centre[:, at] @ direction.T
        covariance = (direction * self.spread[:, None, at] ** 2) @ direction.T + np.diag(variance)
        distance = np.einsum("cm,cm->c", off, np.linalg.solve(covariance, off[:, :, None])[:, :, 0])
        known = len(self.names) - 1
        prior = np.append(np.full(known, (1.0 - PRIOR_UNKNOWN) / known), PRIOR_UNKNOWN)
        log = -0.5 * (distance + np.linalg.slogdet(covariance)[1]) + np.log(prior)
        share = np.exp(log - log.max())
        share /= share.sum()
        return {self.names[i]: float(share[i]) for i in np.argsort(-share, kind="stable")}


def guessed(prior: SoilPrior, default: SoilPrior) -> SoilPrior:
    """Return the prior, made vague where it differs from the default: there somebody who knows the field has set it."""
    is_default = (prior.median == default.median) & (prior.log_std == default.log_std)
    return SoilPrior(prior.median, np.where(is_default, prior.log_std, 1e3))


def _evidence(
    posterior: Posterior, guess: SoilPrior, width: float, scale: Array
) -> tuple[NDArray[np.intp], Array, Array, Array]:
    """The posterior with the guess divided out, as M independent measurements of P coordinates.

    Indices (P,) of the coordinates, directions (M, P), and what direction times coordinates is: values (M,) with their
    variances (M,).  Information is in units of `scale` (6,)^-2.
    """
    soil = np.asarray(posterior.soil)
    is_free = np.diag(posterior.log_covariance) > 0.0
    free = np.flatnonzero(is_free)
    coordinates = Coordinates(SoilPrior(soil, is_free.astype(float)), width)
    by_log = np.linalg.inv(coordinates.log_directions(soil)[free])
    here = coordinates.position(soil)
    centre = here + by_log @ np.log(guess.median[free] / soil[free])
    counted = np.flatnonzero(free != _K_C)
    scale = scale[free[counted]]

    def information(log_covariance: Array) -> Array:
        covariance = (by_log @ log_covariance @ by_log.T)[np.ix_(counted, counted)]
        return np.asarray(np.linalg.inv(covariance / np.outer(scale, scale)))

    of_posterior = information(posterior.log_covariance[np.ix_(free, free)])
    of_guess = information(np.diag(guess.log_std[free] ** 2))
    strength, direction = np.linalg.eigh(of_posterior - of_guess)
    information_mean = of_posterior @ (here[counted] / scale) - of_guess @ (centre[counted] / scale)
    is_measured = strength > 1e-3  # of the prior of `unknown`: less decides nothing
    strength, direction = strength[is_measured], direction[:, is_measured].T
    return free[counted], direction / scale, direction @ information_mean / strength, 1.0 / strength


def ranked_by_likelihood(problem: ObservationModel, soils: Sequence[Soil]) -> list[Soil]:
    """Return the soils by their likelihood, the best first, by six instants with loads and slips as measured.

    The misfit is the sum of squares of predicted less measured torque, pull and sinkage over
    a tenth of their size: a field is not the table's.
    """
    few, sd = problem.thinned(6), 0.1
    radius, shape = few.rig.radius, (len(soils), *few.load.shape)
    each = Soil(*np.array(soils).T[:, :, None, None])
    slip = np.broadcast_to(np.where(few.usable, few.slip, 0.0), shape)
    state = state_on(each, np.nan, slip, radius, few.rig.width, few.rig.length)
    angle = entry_angle_for_load(np.broadcast_to(few.load, shape), state, few.model, tolerance=sd**2)
    _, pull, torque = wheel_forces(state._replace(entry_angle=angle), few.model)
    depth = sinkage(angle, radius)
    typical = np.abs(few.torque).sum() / max(np.count_nonzero(few.has_torque), 1) + 1.0
    by_torque = np.where(few.has_torque, few.torque_rows(torque) - few.torque, 0.0) / (sd * typical)
    by_pull = np.where(few.has_balance, pull.sum(axis=2) - few.demand, 0.0) / (sd * typical * (1.0 / radius).sum())
    by_depth = np.where(few.has_sinkage, depth - few.sinkage, 0.0) / (sd * depth + np.sqrt(few.sinkage_var))
    misfit = (by_torque**2).sum((1, 2)) + (by_pull**2).sum(1) + (by_depth**2).sum((1, 2))
    return [soils[i] for i in np.argsort(np.where(np.isfinite(misfit), misfit, np.inf), kind="stable")]
