"""How far a model is from the data: reduced chi-square of blocks that it was not fitted to, each held out in turn.

Of the blocks that a diagnosis holds out alone the noise is a few per cent, as much as a
tenth of many a gap.  So a model that was found is fitted once more to each other choice of
blocks, from where it stands (cross-validation: Stone 1974, J. R. Stat. Soc. B 36:111).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.records import HELD_OUT, Record
from soilbus.estimation.multistart import Start
from soilbus.estimation.posterior import SoilPrior

CLEAR = 1.5
"""Gap from which the noise of that of a third of the blocks does not matter."""


class Gap(NamedTuple):
    """Reduced chi-square of held-out residuals, and how many they are."""

    value: float
    rows: int


def gap_of(records: Sequence[Record], prior: SoilPrior, found: FittedModel) -> Gap:
    """The gap of a model that was fitted to these records, over all blocks, each held out in turn.

    Over those held out already where that tells enough (beyond CLEAR), where others cannot be
    held out (tables), and where the model or a fit did not converge.
    """
    alone = Gap(found.gap, found.checked_rows)
    if not found.converged or found.gap > CLEAR:
        return alone
    chi2, rows = found.gap * found.checked_rows, found.checked_rows
    for fold in range(HELD_OUT):
        turned = [record.with_held_out(fold) for record in records]
        parts = [record for record in turned if record is not None]
        if len(parts) < len(records):
            return alone
        starts = [_start(record, fold, start) for record, start in zip(records, found.as_starts(), strict=True)]
        again = fit_model(parts, prior, found.effects, starts)
        if again is None or not math.isfinite(again.gap):
            return alone
        chi2 += again.gap * again.checked_rows
        rows += again.checked_rows
    return Gap(chi2 / max(rows, 1), rows)


def _start(record: Record, fold: int, end: Start) -> Start:
    """Where a fit ended, as a start of one to other blocks of the recording."""
    if end.latents is None or end.checked is None or record.fold is None:
        return end._replace(latents=None, checked=None)
    held_out = record.fold == HELD_OUT
    places = np.concatenate([np.flatnonzero(~held_out), np.flatnonzero(held_out)])
    whole = end.latents.followed_by(len(end.latents.load), end.checked).part(np.argsort(places))
    return end._replace(latents=whole.part(record.fold != fold), checked=whole.part(record.fold == fold))
