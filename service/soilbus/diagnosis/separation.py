"""How well further data would tell rival models apart.

    d = f_A(theta_A) - f_B(theta_B)              difference of the two fitted models' predictions of a drive
    S(A, B) = d' (Sigma + J P J')^-1 d           J, P: Jacobian and posterior covariance of B

Sigma is the covariance of the drive's measurements, latents included; J P J' is what B's gains and effects may still
change, and any soil within its prior.  So S is the criterion of T-optimum designs (Atkinson & Fedorov 1975, Biometrika
62:57) with the rival's parameters as open as the data have left them: the fall of -2 log likelihood that the drive is
expected to add where A is true.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import FittedModel, HeldOutCheck, check
from soilbus.diagnosis.search import Addition
from soilbus.diagnosis.verdict import probabilities
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.observation_model import inverse_covariance
from soilbus.estimation.observation_with_effects import ObservationModelWithEffects
from soilbus.estimation.posterior import Posterior, SoilPrior
from soilbus.terra.effects.effect import Active
from soilbus.terra.wheel import Soil


@dataclass(frozen=True, slots=True)
class Truth:
    """A fitted model as what is truly driven: soil and effects with values."""

    name: str
    soil: Soil
    effects: tuple[Active, ...]


def contested(rivals: Sequence[FittedModel]) -> tuple[str, ...]:
    """Of each rival, the name of the effect that the others have not."""
    shared = frozenset.intersection(*(frozenset(rival.names) for rival in rivals))
    return tuple(next(name for name in rival.names if name not in shared) for rival in rivals)


def truths(rivals: Sequence[FittedModel]) -> tuple[Truth, ...]:
    """Each rival at its optimum, under the soil of the last recording."""
    found = []
    for name, rival in zip(contested(rivals), rivals, strict=True):
        mode, problem = rival.fits[-1].mode, rival.checks[-1].problem
        effects = problem.active(mode.gains[problem.n_sensors :])
        found.append(Truth(name, Soil(*mode.soil.tolist()), tuple(effects)))
    return tuple(found)


def separations(
    drive: ObservationModelWithEffects, prior: SoilPrior, rivals: Sequence[FittedModel], true: int
) -> tuple[float, ...]:
    """S of a drive, for each rival in the place of B; 0 for the one in the place of A.

    Parameters
    ----------
    drive
        Noise-free measurements of the drive, with the noise of the sensors.
    prior
        Of the soil.
    rivals
        Fitted models.
    true
        Index of A, with which the drive was computed.
    """
    at = [check(drive.with_effects(rival.effects, rival.free), prior, rival.fits[-1]) for rival in rivals]
    predicted = at[true].at.rows[:, 0]
    return tuple(
        0.0 if i == true else _squared_distance(one, rival.fits[-1].mode, prior, one.at.rows[:, 0] - predicted)
        for i, (one, rival) in enumerate(zip(at, rivals, strict=True))
    )


def _squared_distance(rival: HeldOutCheck, posterior: Gaussian, prior: SoilPrior, difference: Array) -> float:
    """Squared Mahalanobis distance of a difference (R,) of residuals from a rival's predictive distribution.

    The drive is a further recording: its soil has the prior, gains and effects have the posterior of those before.
    """
    variance, row_var = rival.problem.variances(posterior.gains)
    inverse = inverse_covariance(rival.at.by_latents, variance, row_var)
    weighed = np.einsum("nij,nj->ni", inverse, difference.reshape(len(inverse), -1)).ravel()
    scale = np.concatenate([posterior.soil, np.ones(len(posterior.gains))])  # the covariance is of log soil
    jacobian, weighed_jacobian = (rows[:, 1:] * scale for rows in (rival.at.rows, rival.at.weighed))
    gradient, information = weighed_jacobian.T @ difference, jacobian.T @ weighed_jacobian
    covariance = posterior.with_prior_soil(prior).covariance
    shrunk = covariance @ np.linalg.solve(np.eye(len(covariance)) + information @ covariance, gradient)
    return float(difference @ weighed - gradient @ shrunk)


def expected_posterior(drive: ObservationModelWithEffects, prior: SoilPrior, soil: Soil) -> Posterior:
    """The posterior that a drive is expected to give: prior and Fisher information at a soil, by a noise-free drive."""
    joint_prior, gains = Gaussian.of(prior, drive.gain_std), np.zeros(len(drive.gain_std))
    at = drive.linearise(soil, gains, drive.start(soil, gains))
    scale = np.concatenate([np.array(soil), np.ones(len(gains))])
    information = (scale[:, None] * at.normal[1:, 1:]) * scale
    covariance = joint_prior.covariance
    shrunk = np.linalg.solve(np.eye(len(covariance)) + covariance @ information, covariance)
    return Posterior(soil, shrunk[: len(soil), : len(soil)])


def expected_probability(addition: Addition, true: str, gained: dict[str, float]) -> float:
    """Probability of the true name once the drive has been driven and diagnosed with the recordings.

    Parameters
    ----------
    addition
        The comparison so far.
    true
        Name that is true.
    gained
        S by name of the rivals.
    """
    names = {addition.effect.name, *addition.alternatives}
    least = min(gain for name, gain in gained.items() if name != true)
    most = max(gained.values())
    further = {name: most - gained.get(name, least) for name in names}  # a block more of the drive's own
    return probabilities({name: np.append(addition.by_block[name], further[name]) for name in names})[true]
