"""Bayesian multiple models: which of the known soils is it?

Ray 2008 (Proc. SPIE 6962:505).  Assumes: the soil is one of a set of hypotheses, each a
complete wheel-soil model; every instant's readings multiply the hypotheses' probabilities
by their likelihoods; the estimate is the mean over them.  The paper gets the wheel forces
from a Kalman filter on body motion; here torque, pull and sinkage are measured, with the
noise model of ours.  Error bars: the spread of the hypotheses under their probabilities.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import PARAMETERS, Estimate
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil
from tests.lab.peers.windows import B_REF, Z_REF, Answer, Case, at_measured, reading_covariance

DOUBLE = 0.05
"""Relative difference below which two soils of the table count as one."""


def with_the_soil(case: Case) -> Answer | None:
    """The table of soils as hypotheses, the window's own soil among them."""
    return of_hypotheses(case.problem, set(SOILS.values()))


def without_the_soil(case: Case) -> Answer | None:
    """The same table, but without the window's own soil and what is as good as a double of it."""
    return of_hypotheses(case.problem, [soil for soil in set(SOILS.values()) if not _alike(soil, case.soil)])


def _alike(one: Soil, other: Soil) -> bool:
    return all(abs(getattr(one, name) / getattr(other, name) - 1.0) < DOUBLE for name in ("k_phi", "n", "phi"))


def of_hypotheses(problem: ObservationModel, hypotheses: Collection[Soil]) -> Answer | None:
    """Mean and spread of the hypotheses' parameters, equally likely beforehand."""
    log_likelihood = np.array([_log_likelihood(problem, soil) for soil in hypotheses])
    if not np.isfinite(log_likelihood).any():
        return None
    probability = np.exp(log_likelihood - np.nanmax(log_likelihood))
    probability = np.nan_to_num(probability) / np.nansum(probability)
    values = {name: np.array([getattr(soil, name) for soil in hypotheses]) for name in PARAMETERS}
    values["bearing"] = np.array([soil.bearing_pressure(Z_REF, B_REF) for soil in hypotheses])
    return {name: _mean(value, probability) for name, value in values.items()}


def _mean(value: Array, probability: Array) -> Estimate:
    mean = float(probability @ value)
    return Estimate(mean, float(np.sqrt(probability @ (value - mean) ** 2)))


def _log_likelihood(problem: ObservationModel, soil: Soil) -> float:
    """Of a whole window, up to a constant: the product over its instants."""
    with np.errstate(all="ignore"):
        at = at_measured(problem, soil)
        sign, log_det = np.linalg.slogdet(reading_covariance(problem, at))
    value = -0.5 * (at.chi2 + log_det.sum())
    return float(value) if np.isfinite(value) and np.all(sign > 0.0) else np.nan
