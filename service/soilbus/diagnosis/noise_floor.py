"""The noise floor: what the sensors do not repeat, by the recording itself.

    sd^2 of a sensor = [noise]^2 * f,    f = sum of (v_i - 2 v_i+k + v_i+2k)^2 / sum of the expected squares

v are the sensor's corrections (`variance_components`) in bins, k bins are half of an instant, or a sample where that is
longer.  What a model misses moves slowly beside an instant, and second differences cancel it (Gasser, Sroka &
Jennen-Steinmetz 1986, Biometrika 73:625).  What shakes faster counts there about as much as in the mean of an instant.
So f is what instants do not repeat, whatever is missing.
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
    """Return the records with the noise that differences of a fitted model's corrections show; tables as they are."""
    if any(record.source is None for record in records):
        return list(records)
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
            before, here, after = _triples(problem, KINDS[kind], record.options.instant)
            known = np.minimum(np.minimum(expected[before], expected[here]), expected[after]) > 0.0
            bend = (value[before] - 2.0 * value[here] + value[after])[known]
            of_noise = (expected[before] + 4.0 * expected[here] + expected[after])[known]
            found = np.array([float(bend @ bend), float(of_noise.sum()), len(here)])
            squares[kind] = squares.get(kind, np.zeros(3)) + found
    least = records[0].training.options.variance.least_share
    return {
        kind: float(found / noise)
        for kind, (found, noise, n) in squares.items()
        if KINDS[kind] and noise > 6.0 * least * n
    }


def _triples(
    problem: ObservationModel, quantities: Sequence[str], instant: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of bins, and of those half an instant [s] and an instant later, no less than samples apart."""
    step = float(np.median(np.diff(problem.t)))
    k = max(round(max([instant / 2.0, *map(problem.sample_time, quantities)]) / step), 1)
    first = np.arange(max(problem.n - 2 * k, 0))
    whole = np.abs(problem.t[first + 2 * k] - problem.t[first] - 2 * k * step) < 0.5 * step
    return first[whole], first[whole] + k, first[whole] + 2 * k
