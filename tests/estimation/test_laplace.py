"""The average along n of a window without noise, with the prior's median at the truth."""

from __future__ import annotations

import numpy as np
import pytest

from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.laplace import cold_fit
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import SoilPrior
from soilbus.sensors.bins import Bins
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario
from soilbus.terra.soils import SOILS
from tests.lab.cramer_rao import cramer_rao
from tests.lab.monte_carlo import ROUGHLY_KNOWN, SLIP_RANGE

DURATION = 10.0


@pytest.mark.parametrize("seed", [21, 22])
def test_without_noise_a_window_that_determines_k_c_reports_the_truth(seed):
    # Plain means of logarithms are a third of the bound off: that of k_c, and so those of n and the pressure.
    config, soil = reference_configuration(ROUGHLY_KNOWN), SOILS["wet_clay"]
    rig, truth = rig_of(config), SoilPrior(np.asarray(soil), prior_of(config).log_std)
    drive = simulate(config, Scenario(DURATION, (Patch(0.0, "wet_clay", soil),), slip=SLIP_RANGE), seed)
    store = Bins(rig, config.estimator.bin, 0.0)
    fitted = [name for name in rig.channels if name in drive.channels and not name.startswith("sinkage")]
    times = {name: drive.channels[name].t for name in fitted}
    store.add({name: (t, np.interp(t, drive.truth["t"], drive.truth[name])) for name, t in times.items()})
    problem = ObservationModel(store.window(0.0, DURATION), rig, model_of(config), config.estimator.min_speed)
    reported = cold_fit(problem, truth).reported.posterior
    bound = cramer_rao(problem, truth, soil)
    std = np.sqrt(np.diag(bound.log_covariance))
    off = np.log(np.asarray(reported.soil) / np.asarray(soil)) / std
    assert std[0] < 0.3  # the data determine k_c
    assert np.abs(off).max() < 0.15
    z_ref, b_ref = config.estimator.z_ref, config.estimator.b_ref
    pressure, least = (of.bearing_pressure(z_ref, b_ref) for of in (reported, bound))
    assert abs(pressure.value - least.value) < 0.15 * least.std
