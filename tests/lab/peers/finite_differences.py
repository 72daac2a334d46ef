"""scipy.optimize.least_squares on our residuals, parameters and priors, with finite differences.

What one would write without our derivatives by the soil (`soilbus.trials.bench.window`).
"""

from __future__ import annotations

from soilbus.estimation.posterior import Posterior
from soilbus.trials.bench.window import by_finite_differences
from tests.lab.peers.windows import B_REF, Z_REF, Answer, Case


def estimate(case: Case) -> Answer | None:
    """None where least_squares does not converge."""
    posterior = fit(case)
    if posterior is None:
        return None
    free = {name: e for name, e in posterior.parameters().items() if e.std > 0.0}
    return free | {"bearing": posterior.bearing_pressure(Z_REF, B_REF)}


def fit(case: Case) -> Posterior | None:
    """The posterior of the soil alone."""
    try:
        return by_finite_differences(case.problem, case.prior)
    except ValueError:  # a residual that is not finite
        return None
