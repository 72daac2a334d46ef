"""Windows with braking (negative slip): right within what they say of themselves."""

import numpy as np
import pytest

from soilbus.estimation.multistart import fit_window
from soilbus.simulator.scenario import Swing
from soilbus.terra.soils import SOILS

DRIVES = {
    "driving and braking": {"slip": Swing(-0.2, 0.3)},
    "braking alone": {"slip": Swing(-0.2, -0.02)},
    "harsh": {"slip": Swing(-0.2, 0.3), "speed": Swing(0.8, 2.5, 0.2, 0.5)},  # to 2 m/s^2
}


@pytest.mark.parametrize("what", DRIVES)
def test_errors_are_as_large_as_the_posterior_says(what, simulated):
    away, chi2, braking = [], [], []
    for k, name in enumerate(("loam", "clayey_soil_38", "wet_clay")):
        for seed in range(3):
            case = simulated(SOILS[name], 1000 * k + seed, **DRIVES[what])
            soil, problem = case.soil, case.problem()
            fit = fit_window(problem, case.prior)
            assert fit.converged
            bearing, tan_phi = fit.posterior.bearing_pressure(0.02, 0.3), fit.posterior.tan_phi()
            n = fit.posterior.parameters()["n"]
            truth = soil.bearing_pressure(0.02, 0.3), np.tan(soil.phi), soil.n
            away.append([(e.value - x) / e.std for e, x in zip((bearing, tan_phi, n), truth, strict=True)])
            chi2.append(fit.chi2)
            braking.append(np.mean(problem.slip < 0.0))
    # The rms of 9 normal numbers is between 0.5 and 1.6 in 98.1 % of all cases.
    rms = np.sqrt(np.mean(np.square(away), axis=0))
    assert np.all((rms > 0.5) & (rms < 1.6)), rms
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.05)
    low, high = (0.99, 1.0) if what == "braking alone" else (0.2, 0.5)
    assert low <= np.mean(braking) <= high
