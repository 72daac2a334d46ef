"""How much of a hidden effect a recording can show to the service's own observation model, where loads are computed.

    E = min over soil and gains of  chi-square + their prior,  of the drive without sensors' noise

The weights contain the uncertainty of computed loads; soil and gains have the priors of the diagnosis.  E is the
expected fall of -2 log likelihood from no effect to the true effect at its true size, by its own formula.
"""

from __future__ import annotations

import math

from soilbus.diagnosis.search import FitCache
from soilbus.estimation.assembly import prior_of
from soilbus.offline.manoeuvre import record_of_recording
from soilbus.terra.effects.catalogue import CATALOGUE
from tests.lab.blind.cases import Case
from tests.lab.blind.visible import driven_without_noise

LEAST = 2.0 * math.log(len(CATALOGUE))
"""E below which no effect is named: the fall from which an effect is more probable than none."""


def bound(case: Case) -> float | None:
    """E of a case; None where all loads are measured, as `visible.shown` is that bound there, and where no fit ends."""
    record = record_of_recording(case.id, driven_without_noise(case, case.parts), case.config)
    if not record.training.computes_loads:
        return None
    fitted = FitCache([record], prior_of(case.config), record.options).fit(record.training.effects)
    return None if fitted is None else fitted.neg2_log_posterior + fitted.held_out_chi2 * fitted.checked_rows
