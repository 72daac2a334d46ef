"""Which known soil is it?  Probabilities over the table of soils, "none of them" included.

Bayesian multiple models (Ray 2008, Proc. SPIE 6962:505): each known soil is a class, and its probability that
of the class beforehand times the likelihood of what was measured, averaged over the soils
of the class.  Here that average has a closed form: the posterior is Gaussian in the
coordinates of `coordinates` and the classes are too.

A class is the soil of the table with a spread, for no field has exactly the soil of a
table.  Nobody measured the spread of every row, so all have the same one, taken from
repeated measurements: see WITHIN.  `unknown` is a soil of another kind: spread as widely
as the rows of the table are about their mean.

What the posterior owes to a prior that is only a guess is not evidence, and is taken out.
What is held counts neither for nor against a class, nor does k_c: a window tells at best
that it is not large, which no Gaussian of its logarithm can say.
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

PRIOR_UNKNOWN = 0.5
"""Probability of `unknown` before any window; the kinds of the table share the rest evenly."""
WITHIN = {"k_c": 0.5, "k_phi": 0.25, "n": 0.16, "phi": 0.10, "c": 0.45, "K": 0.45}
"""Sd of the logarithm of each parameter within a class; for k_phi that of the bearing pressure.

One prepared sand bed: phi 33.1 deg +- 8.7 %, c +- 58 %, pressure +- 9 %, n +- 16 % (Jayakumar
et al. 2014, J. Terramech. 54:37, as in the code of its second author).  The two rows of Wong's
table for one snow differ by 1.4 times these sds: phi 0.12, c 0.36, pressure 0.13, k_c 0.40.
Within a field: phi up to 12 %, strength 20 to 40 % (Phoon & Kulhawy 1999, Can. Geotech. J.
36:612).  K is no part of Wong's table: planning figures, right to half of themselves.
"""
NO_EVIDENCE = 1e-3
"""Information, in units of what `unknown` knows, below which a direction was not measured."""
FEW = 6
"""Instants of a window that soils of the table are compared with."""
ROUGHLY = 0.1
"""Share by which a soil of the table may miss torque, pull and sinkage: a field is not the table's."""
TOLD = 1e3
"""Sd of a logarithm that stands for no guess."""

_K_C = PARAMETERS.index("k_c")


@dataclass(frozen=True)
class SoilClasses:
    """The classes as seen by tyres of a mean width [m]."""

    names: tuple[str, ...]
    centre: Array
    """Coordinates (C, 6); `unknown` is the last class."""
    spread: Array
    """Their sds (C, 6)."""
    width: float

    @classmethod
    def of_table(cls, width: float) -> SoilClasses:
        """Every kind of the table, and unknown."""
        everything = Coordinates(SoilPrior(np.ones(len(PARAMETERS)), np.ones(len(PARAMETERS))), width)
        known = np.array([everything.position(np.asarray(SOILS[name])) for name in KINDS])
        within = np.array([WITHIN[name] for name in PARAMETERS])
        among = np.sqrt(known.var(axis=0, ddof=1) + within**2)
        spread = np.vstack([np.broadcast_to(within, known.shape), among])
        return cls((*KINDS, UNKNOWN), np.vstack([known, known.mean(axis=0)]), spread, width)

    def probabilities(self, posterior: Posterior, guess: SoilPrior) -> dict[str, float]:
        """Probability of each class given a window's posterior, the largest first.

        `guess` is that part of the posterior's prior that was only a guess (see `guessed`).
        """
        measured = _evidence(posterior, guess, self.width, self.spread[-1])
        centre, spread = self.centre[:, measured.parameters], self.spread[:, measured.parameters]
        off = measured.value - centre @ measured.direction.T
        covariance = np.einsum("mp,cp,np->cmn", measured.direction, spread**2, measured.direction)
        covariance += np.diag(measured.variance)
        distance = np.einsum("cm,cm->c", off, np.linalg.solve(covariance, off[:, :, None])[:, :, 0])
        log = -0.5 * (distance + np.linalg.slogdet(covariance)[1]) + np.log(self._prior)
        share = np.exp(log - log.max())
        share /= share.sum()
        return {self.names[i]: float(share[i]) for i in np.argsort(-share, kind="stable")}

    @property
    def _prior(self) -> Array:
        known = len(self.names) - 1
        return np.append(np.full(known, (1.0 - PRIOR_UNKNOWN) / known), PRIOR_UNKNOWN)


def guessed(prior: SoilPrior, default: SoilPrior) -> SoilPrior:
    """The prior without what somebody who knows the field said: where it differs from the default."""
    same = (prior.median == default.median) & (prior.log_std == default.log_std)
    return SoilPrior(prior.median, np.where(same, prior.log_std, TOLD))


@dataclass(frozen=True)
class _Evidence:
    """What the data say: M combinations of the coordinates of some parameters (P,).

    direction (M, P) times the coordinates is value (M,) with variance (M,), independently.
    """

    parameters: NDArray[np.intp]
    direction: Array
    value: Array
    variance: Array


def _evidence(posterior: Posterior, guess: SoilPrior, width: float, scale: Array) -> _Evidence:
    """The posterior (6) with the guess taken out, in units of `scale` (6,)."""
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

    known = information(posterior.log_covariance[np.ix_(free, free)])
    owed = information(np.diag(guess.log_std[free] ** 2))
    strength, direction = np.linalg.eigh(known - owed)
    towards = known @ (here[counted] / scale) - owed @ (centre[counted] / scale)
    told = strength > NO_EVIDENCE
    strength, direction = strength[told], direction[:, told].T
    return _Evidence(free[counted], direction / scale, direction @ towards / strength, 1.0 / strength)


def ranked_by_likelihood(problem: ObservationModel, soils: Sequence[Soil]) -> list[Soil]:
    """The soils, those first that foretell torque, pull and sinkage of a window best at its loads and slips."""
    few = problem.thinned(FEW)
    radius, shape = few.rig.radius, (len(soils), *few.load.shape)
    each = Soil(*np.array(soils).T[:, :, None, None])
    slip = np.broadcast_to(np.where(few.usable, few.slip, 0.0), shape)
    state = state_on(each, np.nan, slip, radius, few.rig.width)
    angle = entry_angle_for_load(np.broadcast_to(few.load, shape), state, few.model, tolerance=ROUGHLY**2)
    _, pull, torque = wheel_forces(state._replace(entry_angle=angle), few.model)
    depth = sinkage(angle, radius)
    typical = np.abs(few.torque).sum() / max(np.count_nonzero(few.has_torque), 1) + 1.0
    by_torque = np.where(few.has_torque, torque - few.torque, 0.0) / (ROUGHLY * typical)
    by_pull = np.where(few.has_balance, pull.sum(axis=2) - few.demand, 0.0) / (ROUGHLY * typical * (1.0 / radius).sum())
    by_depth = np.where(few.has_sinkage, depth - few.sinkage, 0.0) / (ROUGHLY * depth + np.sqrt(few.sinkage_var))
    miss = (by_torque**2).sum((1, 2)) + (by_pull**2).sum(1) + (by_depth**2).sum((1, 2))
    return [soils[i] for i in np.argsort(np.where(np.isfinite(miss), miss, np.inf), kind="stable")]
