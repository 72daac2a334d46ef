"""How far a model is from the data: reduced chi-square of held-out blocks, each fold held out in turn.

    gap = sum over folds of chi-square / sum over folds of residuals

The gap of the one fold that a diagnosis holds out has a noise of a few per cent, often a tenth of its excess over 1.
So a model that was found is fitted once more with each other fold held out, from its optimum (cross-validation: Stone
1974, J. R. Stat. Soc. B 36:111).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.records import Record
from soilbus.estimation.multistart import Start
from soilbus.estimation.posterior import SoilPrior


class Gap(NamedTuple):
    """Reduced chi-square of held-out residuals, and the number of these."""

    value: float
    rows: int


def gap_of(records: Sequence[Record], prior: SoilPrior, fitted: FittedModel) -> Gap:
    """The gap of a model that was fitted to these records, over all folds.

    Over the one fold only where its gap exceeds `max_cross_validated`, where no other can be held out (tables), and
    where the model or a further fit did not converge.
    """
    options, one_fold = records[0].options, Gap(fitted.gap, fitted.checked_rows)
    if not fitted.converged or fitted.gap > options.max_cross_validated:
        return one_fold
    chi2, rows = fitted.gap * fitted.checked_rows, fitted.checked_rows
    for fold in range(options.folds - 1):
        divided = [record.with_held_out(fold) for record in records]
        parts = [record for record in divided if record is not None]
        if len(parts) < len(records):
            return one_fold
        starts = [_start(record, fold, start) for record, start in zip(records, fitted.as_starts(), strict=True)]
        refitted = fit_model(parts, prior, fitted.effects, starts)
        if refitted is None or not math.isfinite(refitted.gap):
            return one_fold
        chi2 += refitted.gap * refitted.checked_rows
        rows += refitted.checked_rows
    return Gap(chi2 / max(rows, 1), rows)


def _start(record: Record, fold: int, end: Start) -> Start:
    """Where a fit ended, as a start of one to other blocks of the recording."""
    if end.latents is None or end.checked is None or record.fold is None:
        return end._replace(latents=None, checked=None)
    held_out = record.fold == record.options.folds - 1
    indices = np.concatenate([np.flatnonzero(~held_out), np.flatnonzero(held_out)])
    whole = end.latents.followed_by(len(end.latents.load), end.checked).part(np.argsort(indices))
    return end._replace(latents=whole.part(record.fold != fold), checked=whole.part(record.fold == fold))
