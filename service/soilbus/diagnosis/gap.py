"""How far a model is from the data: reduced chi-square of held-out blocks, each fold held out in turn.

    gap = 1 + sum over folds of (chi-square - E[chi-square]) / sum over folds of tr(R C)

With load cells E[chi-square] and tr(R C) are the number of residuals, and the gap is the reduced chi-square.  Where
loads are computed, the residuals' covariance is C + K: C of the sensors' noise, K of what the loads leave open.  The
sensors' noise alone then leaves a chi-square of tr(R C), less than the number of residuals; R are weights that all
models share (`ObservationModel.expected_chi2`).  Loads that shake as `noise.computed_load` says bring the gap to the
number of residuals over tr(R C) (`Gap.open_loads`), but no cell says whether they shake.  Eigenvalues of R C are at
most 1, so that noise gives the gap a sd of at most sqrt(2 / tr(R C)).

The gap of the one fold that a diagnosis holds out has a noise of a few per cent, often a tenth of its excess over 1.
So a model that was found is fitted once more with each other fold held out, from its optimum (cross-validation: Stone
1974, J. R. Stat. Soc. B 36:111).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import FittedModel, HeldOutCheck, fit_model
from soilbus.diagnosis.joint_fit import Start
from soilbus.diagnosis.options import DEFAULT, DiagnosisOptions
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.verdict import gap_limit
from soilbus.estimation.observation_model import RESIDUAL
from soilbus.estimation.posterior import SoilPrior


class Gap(NamedTuple):
    """Reduced chi-square of held-out residuals.

    Attributes
    ----------
    value
        1 where the sensors' noise alone is left.
    rows
        Number of residuals.
    open_loads
        The value where computed loads shake as `noise.computed_load` says; 1 where load cells measure them.
    """

    value: float
    rows: int
    open_loads: float = 1.0

    @property
    def with_open_loads(self) -> float:
        """The value where 1 is noise with all that computed loads leave open."""
        return self.value / self.open_loads

    def limit(self, options: DiagnosisOptions = DEFAULT) -> float:
        """The value up to which noise alone explains it."""
        return gap_limit(self.rows / self.open_loads, options)

    def exceeds_noise(self, options: DiagnosisOptions = DEFAULT) -> bool:
        """Whether more is left than noise alone leaves."""
        return self.value > self.limit(options)


@dataclass(frozen=True, slots=True)
class _Misfit:
    """What a sum of folds misses: chi-square beyond the expected one, residuals, and tr(R C)."""

    excess: float
    rows: int
    degrees: float

    def __add__(self, other: _Misfit) -> _Misfit:
        return _Misfit(self.excess + other.excess, self.rows + other.rows, self.degrees + other.degrees)

    @property
    def gap(self) -> Gap:
        """The reduced chi-square; of residuals that are no numbers infinite."""
        if not (math.isfinite(self.excess) and self.degrees > 0.0):
            return Gap(math.inf, self.rows)
        return Gap(1.0 + self.excess / self.degrees, self.rows, self.rows / self.degrees)


def gap_of_fold(fitted: FittedModel) -> Gap:
    """The gap of a model over the fold that its records hold out."""
    return _misfit(fitted).gap


def _misfit(fitted: FittedModel) -> _Misfit:
    """Of the fold that a model's records hold out."""
    excess, degrees = 0.0, 0.0
    for check, fit in zip(fitted.checks, fitted.fits, strict=True):
        missed, expected = _excess_and_degrees(check, fit.mode.gains)
        excess, degrees = excess + missed, degrees + expected
    return _Misfit(excess, fitted.checked_rows, degrees)


def _excess_and_degrees(check: HeldOutCheck, gains: Array) -> tuple[float, float]:
    """chi-square - E[chi-square] and tr(R C) of the held-out blocks of one recording.

    The chi-square has besides the noise what the fit leaves uncertain, r' S^-1 r has not; where loads are computed,
    weights that all models share take the place of S^-1.
    """
    problem, at = check.problem, check.at
    R, K = problem.common_weights, problem.held_covariance
    if R is None or K is None:
        expected = problem.expected_chi2(at, gains)
        return check.chi2 - expected, expected
    r = at.rows[:, RESIDUAL].reshape(R.shape[:2])
    S = np.linalg.inv(problem.inverse_covariance(at.by_latents, *problem.variances(gains)))
    unknown = r.size - check.rows  # rows without a measurement, of weight and variance 1
    degrees = float(np.sum(R * (S - K))) - unknown
    return check.chi2 - at.chi2 + float(np.einsum("ni,nij,nj->", r, R, r)) - degrees, degrees


def gap_of(records: Sequence[Record], prior: SoilPrior, fitted: FittedModel) -> Gap:
    """The gap of a model that was fitted to these records, over all folds.

    Over the one fold only where no other can be held out (tables), and where the model or a further fit did not
    converge.
    """
    options, of_folds = records[0].options, _misfit(fitted)
    one_fold = of_folds.gap
    if not fitted.converged:
        return one_fold
    for fold in range(options.folds - 1):
        divided = [record.with_held_out(fold) for record in records]
        parts = [record for record in divided if record is not None]
        if len(parts) < len(records):
            return one_fold
        starts = [_start(record, fold, start) for record, start in zip(records, fitted.as_starts(), strict=True)]
        refitted = fit_model(parts, prior, fitted.effects, starts)
        if refitted is None or not math.isfinite(refitted.held_out_chi2):
            return one_fold
        of_folds += _misfit(refitted)
    return of_folds.gap


def _start(record: Record, fold: int, end: Start) -> Start:
    """Where a fit ended, as a start of one to other blocks of the recording."""
    if end.latents is None or end.checked is None or record.fold is None:
        return end._replace(latents=None, checked=None)
    held_out = record.fold == record.options.folds - 1
    indices = np.concatenate([np.flatnonzero(~held_out), np.flatnonzero(held_out)])
    whole = end.latents.followed_by(len(end.latents.load), end.checked).part(np.argsort(indices))
    return end._replace(latents=whole.part(record.fold != fold), checked=whole.part(record.fold == fold))
