"""Prior of a run from the end of the last one: the gains that its sensors had then, where the data agree with them."""

from __future__ import annotations

import math

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import PARAMETERS, SoilPrior

_SOIL = len(PARAMETERS)


def prior_from_last_run(
    gaussian: Gaussian, soil: SoilPrior, gain_std: Array, elapsed: float, correlation_time: float
) -> Gaussian:
    """Return the joint prior of a run: the soil's, and the gains `gaussian` of the last run, `elapsed` seconds ago.

    Gain errors are a stationary process (Uhlenbeck & Ornstein 1930, Phys. Rev. 36, 823): a gain g is drawn back to k g
    with variance k^2 var + (1 - k^2) gain_std^2, k = exp(-elapsed / correlation_time).
    """
    kept = math.exp(-elapsed / correlation_time) * (gain_std > 0.0)
    covariance = np.zeros_like(gaussian.covariance)
    covariance[:_SOIL, :_SOIL] = np.diag(soil.log_std**2)
    of_gains = kept[:, None] * gaussian.covariance[_SOIL:, _SOIL:] * kept
    covariance[_SOIL:, _SOIL:] = of_gains + np.diag((1.0 - kept**2) * gain_std**2)
    return Gaussian(soil.median, kept * gaussian.gains, covariance)


def passes_prior_conflict_test(problem: ObservationModel, soil: SoilPrior, joint_prior: Gaussian) -> bool:
    """Return whether a window is at least as likely with the last run's gains as without them.

    A sensor exchanged or calibrated since then has another gain error and fails the test.
    """
    other = fit_window(problem, soil, Gaussian.of(soil, problem.gain_std))
    fit = fit_window(problem, soil, joint_prior)
    if fit is None or not fit.converged:
        return False
    return other is None or not other.converged or fit.neg2_log_evidence <= other.neg2_log_evidence
