"""Drives drawn at random, the prior of each, and the processes that simulate them."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from typing import Any, TypeVar

import numpy as np

from soilbus.allocator import keep_freed_memory
from soilbus.config.model import Config, Prior
from soilbus.estimation.parametrization import MAX_PHI
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.simulator.drive import SimulationError
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.scenario import Scenario
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import Soil
from soilbus.workers import workers

MAX_DRAWS = 100
"""Drawn scenarios that are tried until the tractor drives one to its end."""
_PHI = PARAMETERS.index("phi")

_T = TypeVar("_T")

Each = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""Map of a work over tasks, here or in other processes: results in the order of the tasks."""


@contextmanager
def processes(count: int) -> Iterator[Each]:
    """Give a map over `count` processes of one thread each; the built-in map for fewer than two."""
    if count < 2:
        keep_freed_memory()
        yield map
        return
    with workers(count, "spawn", keep_freed_memory) as pool:
        yield partial(pool.map, chunksize=4)


def first_drive(
    config: Config, draw: Callable[[], tuple[_T, Scenario]], seed: int, draws: int | None = None
) -> tuple[_T, Recording]:
    """Return the first drawn scenario that the vehicle drives to its end, with its draw and recording.

    Raises SimulationError, that of the last scenario, where the vehicle drives none of `draws` (MAX_DRAWS).
    """
    for left in reversed(range(draws or MAX_DRAWS)):
        drawn, scenario = draw()
        with suppress(SimulationError) if left else nullcontext():
            recording = simulate(config, scenario, seed)
            if recording.bogged_at is None:
                return drawn, recording
    raise SimulationError(f"the tractor gets stuck on {scenario.soils[0].name}")


def prior_about(prior: SoilPrior, soil: Soil, rng: np.random.Generator) -> SoilPrior:
    """Return a prior of the same spread with medians drawn about this soil; held parameters are right."""
    while True:
        median = np.asarray(soil) * np.exp(prior.log_std * rng.standard_normal(len(soil)))
        if median[_PHI] < MAX_PHI:
            return SoilPrior(median, prior.log_std)


def drawn_soil(name: str, log_sd: float, rng: np.random.Generator) -> Soil:
    """Return a soil drawn log-normally about those of the table, with an angle that the model can have."""
    while True:
        soil = Soil(*(np.asarray(soil_named(name)) * np.exp(log_sd * rng.standard_normal(len(PARAMETERS)))).tolist())
        if soil.phi < MAX_PHI:
            return soil


def seeds_of(seed: int, name: str, count: int) -> list[int]:
    """Return seeds of `count` drives of a kind, which do not depend on those of other kinds."""
    return [int(s) for s in np.random.SeedSequence([seed, zlib.crc32(name.encode())]).generate_state(count)]


def with_prior(config: Config, prior: SoilPrior) -> Config:
    """Return the configuration with another prior of the soil."""
    std = prior.median * np.sqrt(np.expm1(prior.log_std**2))
    pairs = zip(PARAMETERS, prior.median.tolist(), std.tolist(), strict=True)
    soil = config.soil.model_copy(update={name: Prior(value=value, std=s) for name, value, s in pairs})
    return config.model_copy(update={"soil": soil})
