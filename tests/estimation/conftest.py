"""A simulated drive as the estimator sees it."""

from collections.abc import Iterable
from dataclasses import dataclass

import pytest

from driven_windows import c_and_K_missed
from soilbus.config.model import Config
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.window import Rig, Window
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.wheel import Soil
from soilbus.trials.windows import bins_of


@dataclass(frozen=True)
class Case:
    """One window of an excited drive on a soil, with a prior of c and K that is off."""

    soil: Soil
    config: Config
    rig: Rig
    window: Window

    @property
    def prior(self) -> SoilPrior:
        return prior_of(self.config)

    def problem(self, window: Window | None = None, rig: Rig | None = None) -> ObservationModel:
        return ObservationModel(window or self.window, rig or self.rig, model_of(self.config), 0.2)


def case(soil: Soil, seed: int, overrides: Iterable[str] = (), without: Iterable[str] = (), **scenario: Swing) -> Case:
    """10 s, unless told otherwise with slip swept from 0.05 to 0.4; c and K are known to 25 %, so priors miss them."""
    config = reference_configuration([*c_and_K_missed(soil, seed), *overrides])
    drive = Scenario(10.0, (Patch(0.0, "this", soil),), **({"slip": Swing(0.05, 0.40)} | scenario))
    channels = simulate(config, drive, seed).channels
    wanted = {name: column for name, column in channels.items() if name.partition(".")[0] not in without}
    return Case(soil, config, rig_of(config), bins_of(config, wanted).window(0.0, 10.0))


@pytest.fixture(scope="session")
def simulated():
    """`case`, for tests that need their own."""
    return case
