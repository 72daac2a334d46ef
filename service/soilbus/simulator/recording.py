"""A simulated drive: the truth and what the sensors saw of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from soilbus.can.channels import Column
from soilbus.config.model import Config
from soilbus.simulator.drive import drive
from soilbus.simulator.scenario import Scenario
from soilbus.simulator.sensors import measure
from soilbus.terra.effects.effect import Active

__all__ = ["Recording", "simulate"]


@dataclass(frozen=True, slots=True)
class Recording:
    """Truth by column name (see drive.Drive) and noisy channels by channel name, all in SI.

    `bogged_at` [s] is when the tractor got stuck and the recording ends, None if it did not.
    """

    truth: dict[str, NDArray[Any]]
    channels: dict[str, Column]
    seed: int
    bogged_at: float | None = None


def simulate(config: Config, scenario: Scenario, seed: int, effects: Sequence[Active] = ()) -> Recording:
    """Drive the configured vehicle through the scenario; the same seed gives the same recording.

    With the effects of config.model.effects and `effects` besides.  Raises SimulationError,
    KeyError and ConfigError as `drive.drive`.
    """
    done = drive(config, scenario, seed, effects)
    return Recording(done.columns, measure(done, config, seed), seed, done.bogged_at)
