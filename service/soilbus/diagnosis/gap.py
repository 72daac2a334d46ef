"""How far a model is from the data: reduced chi-square of blocks, each predicted from all others (`blocks`).

1 is what noise leaves, and the chi-square of N residuals has a sd of sqrt(2 N).  Where loads are computed, their
covariance holds what they leave open too, so that a sound machine whose loads hardly vary is below 1.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.diagnosis.options import DEFAULT, DiagnosisOptions
from soilbus.diagnosis.verdict import gap_limit


class Gap(NamedTuple):
    """Reduced chi-square, 1 where noise alone is left, of this number of residuals."""

    value: float
    rows: int

    def limit(self, options: DiagnosisOptions = DEFAULT) -> float:
        """The value up to which noise alone explains it."""
        return gap_limit(self.rows, options)

    def exceeds_noise(self, options: DiagnosisOptions = DEFAULT) -> bool:
        """Whether it is above that."""
        return not self.value <= self.limit(options)


def gap_of(fitted: FittedModel) -> Gap:
    """The gap of a fitted model; infinite where its residuals are no numbers."""
    rows = int(fitted.blocks.rows.sum())
    value = float(fitted.blocks.chi2.sum()) / max(rows, 1)
    return Gap(value if math.isfinite(value) else math.inf, rows)
