"""Ours: soilbus.estimation, a posterior of all six parameters from the window's whole noise model."""

from __future__ import annotations

from soilbus.estimation.multistart import fit_window
from tests.lab.peers.windows import B_REF, Z_REF, Answer, Case


def estimate(case: Case) -> Answer | None:
    """Parameters given exactly are held; c and K have the assumed values as prior, the rest the configuration's."""
    fit = fit_window(case.problem, case.prior)
    if fit is None or not fit.converged:
        return None
    free = {name: e for name, e in fit.posterior.parameters().items() if e.std > 0.0}
    return free | {"bearing": fit.posterior.bearing_pressure(Z_REF, B_REF)}
