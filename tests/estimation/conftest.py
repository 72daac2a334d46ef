"""A simulated drive as the estimator sees it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pytest

from soilbus.config.model import Config
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.window import Rig, Window
from soilbus.sensors.bins import Bins
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.wheel import Soil

SPREAD = float(np.sqrt(np.log1p(0.25**2)))
"""Sd of the logarithm of a parameter known to 25 %."""


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


def case(soil: Soil, seed: int, overrides: Iterable[str] = (), without: Iterable[str] = ()) -> Case:
    """10 s with slip swept from 0.05 to 0.4; c and K are known to 25 %, so their priors miss by as much."""
    miss = np.exp(SPREAD * np.random.default_rng([seed, 77]).standard_normal(2))
    means = {"c": soil.c * miss[0], "K": soil.K * miss[1]}
    settings = [f"soil.{name}.{key}={v * f}" for name, v in means.items() for key, f in (("value", 1.0), ("std", 0.25))]
    config = reference_configuration([*settings, *overrides])
    scenario = Scenario(10.0, (Patch(0.0, "this", soil),), slip=Swing(0.05, 0.40))
    rig = rig_of(config)
    channels = simulate(config, scenario, seed).channels
    wanted = [name for name in rig.channels if name in channels and name.partition(".")[0] not in without]
    store = Bins(rig, config.estimator.bin, 0.0)
    store.add({name: (channels[name].t, channels[name].value) for name in wanted})
    return Case(soil, config, rig, store.window(0.0, 10.0))


@pytest.fixture(scope="session")
def simulated():
    """`case`, for tests that need their own."""
    return case
