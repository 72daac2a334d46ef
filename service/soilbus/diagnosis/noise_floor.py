"""The noise floor: what the sensors do not repeat, by the recording itself.

    sd^2 of a sensor = [noise]^2 * f,    f = sum of (v_i+k - v_i)^2 / sum of the same of expected squares

v are the sensor's corrections (`variance_components`) in bins that are one sample of it apart, not in the means over
instants that models are fitted to.  What a model
misses moves slowly beside the sampling, and differences cancel it (von Neumann 1941, Ann. Math. Stat. 12:367).  So f
is that of the noise alone, whatever is missing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import FittedModel, check
from soilbus.diagnosis.records import Record
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.variance_components import KINDS, corrections


def with_noise_floor(records: Sequence[Record], prior: SoilPrior, fitted: FittedModel) -> list[Record]:
    """Return the records with the noise that differences of a fitted model's corrections show."""
    found = noise_factors(records, prior, fitted)
    return [
        record.with_noise({kind: record.noise.get(kind, 1.0) * factor for kind, factor in found.items()})
        for record in records
    ]


def noise_factors(records: Sequence[Record], prior: SoilPrior, fitted: FittedModel) -> dict[str, float]:
    """Return the factor on each kind of sensor's variance that differences of its corrections show."""
    squares: dict[str, Array] = {}
    for record, fit in zip(records, fitted.fits, strict=True):
        assert record.bins is not None
        problem = record.bins.with_effects(fitted.effects, fitted.free)
        at = check(problem, prior, fit, options=record.options).at
        values, of_squares, columns = corrections(problem, at, fit.mode.gains)
        for kind, own in columns.items():
            value, expected = values[:, own], of_squares[:, own]
            first, next_ = _neighbours(problem, KINDS[kind])
            known = np.minimum(expected[first], expected[next_]) > 0.0
            change = (value[next_] - value[first])[known]
            of_noise = (expected[first] + expected[next_])[known]
            found = np.array([float(change @ change), float(of_noise.sum()), len(first)])
            squares[kind] = squares.get(kind, np.zeros(3)) + found
    least = records[0].training.options.variance.least_share
    return {
        kind: float(found / noise)
        for kind, (found, noise, n) in squares.items()
        if KINDS[kind] and noise > 2.0 * least * n
    }


def _neighbours(problem: ObservationModel, quantities: Sequence[str]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of instants and of those that are one sample of these quantities later."""
    step = float(np.median(np.diff(problem.t)))
    k = max(round(max(map(problem.sample_time, quantities), default=0.0) / step), 1)
    first = np.arange(max(problem.n - k, 0))
    whole = np.abs(problem.t[first + k] - problem.t[first] - k * step) < 0.5 * step
    return first[whole], first[whole] + k
