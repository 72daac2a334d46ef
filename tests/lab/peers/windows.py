"""Noisy windows of the full simulator, what the methods are given beside them, and the form of their answers."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.assembly import model_of
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.options import ESTIMATOR, HELD, SolverOptions
from soilbus.estimation.posterior import PARAMETERS, Estimate, SoilPrior
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.wheel import Soil, WheelModel
from soilbus.trials.windows import observed

Answer = dict[str, Estimate]
"""Estimates by name: parameters of Soil, and "bearing"; std is nan where the method has none."""
Method = Callable[["Case"], Answer | None]
"""A window's answer; None where the method itself says that it failed."""

Z_REF, B_REF = 0.02, 0.3
"""Depth and width [m] of the bearing pressure that is compared."""
ASSUMED_SD = 0.25
"""Sd of the assumed value of a parameter over that value."""
SPREAD = float(np.sqrt(np.log1p(ASSUMED_SD**2)))
LENGTH = 10.0


@dataclass(frozen=True)
class Case:
    """A window, and for each parameter an assumed value: exact, or off by a quarter (one sd).

    `exact` names the parameters that are given exactly; `soil` is the truth, for scoring only.
    """

    soil: Soil
    assumed: Soil
    exact: frozenset[str]
    problem: ObservationModel

    @property
    def known(self) -> Soil:
        """What a method that holds parameters fixed takes for them."""
        return Soil(*(getattr(self.soil if name in self.exact else self.assumed, name) for name in PARAMETERS))

    @cached_property
    def prior(self) -> SoilPrior:
        """The configuration's prior, but c and K as given; what is given exactly is held."""
        values = configured_prior() | {
            name: (getattr(self.assumed, name), ASSUMED_SD * getattr(self.assumed, name)) for name in ("c", "K")
        }
        return SoilPrior.from_value_std(values | {name: (getattr(self.soil, name), 0.0) for name in self.exact})

    def knowing(self, exact: Collection[str]) -> Case:
        """The same window with other parameters given exactly."""
        return Case(self.soil, self.assumed, frozenset(exact), self.problem)


@cache
def configured_prior() -> dict[str, tuple[float, float]]:
    """Value and std of each soil parameter that our reference configuration has as prior."""
    return {name: (p.value, p.std) for name, p in reference_configuration().soil_prior.items()}


@cache
def fit_model() -> WheelModel:
    """The wheel model that all methods but the linear one integrate."""
    return model_of(reference_configuration())


def assumed_of(soil: Soil, rng: np.random.Generator) -> Soil:
    """Assumed values of the parameters: log-normal about the truth, sd over value ASSUMED_SD."""
    return Soil(*(np.asarray(soil) * np.exp(SPREAD * rng.standard_normal(6))).tolist())


AS_PEERS = replace(ESTIMATOR, standing=HELD, search=replace(ESTIMATOR.search, cold=SolverOptions(100)))
"""The peers know no relaxation, inertia and lateness, and go on to the end of a descent."""


def simulated_case(soil: Soil, seed: int, noise_free: bool = False) -> Case:
    """10 s of the full simulator, slip swept between 0.05 and 0.4, bins of 0.1 s."""
    config = reference_configuration()
    quiet = config.model_copy(update={"noise": config.noise.scaled(0.0)}) if noise_free else config
    scenario = Scenario(LENGTH, (Patch(0.0, "this", soil),), slip=Swing(0.05, 0.40))
    recording = simulate(quiet, scenario, seed)
    problem = observed(config, recording.channels, LENGTH, AS_PEERS)
    return Case(soil, assumed_of(soil, np.random.default_rng([seed, 77])), frozenset(), problem)


def entry_angles(problem: ObservationModel) -> Array:
    """Entry angles [rad] (N, W) from the sinkage sensors (eq. 1)."""
    return np.arccos(1.0 - np.maximum(problem.sinkage, 1e-4) / problem.rig.radius)


def bearing_pressure(K_L: float, n: float, std: float = np.nan) -> Estimate:
    """Bearing pressure [Pa] at Z_REF from the lumped modulus at B_REF."""
    return Estimate(float(K_L * Z_REF**n), std)
