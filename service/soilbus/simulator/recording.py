"""A recording: a simulated drive with its true values and what the sensors made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from soilbus.can.channels import Column
from soilbus.config.model import Config
from soilbus.simulator.drive import Drive, drive
from soilbus.simulator.scenario import Scenario
from soilbus.simulator.sensors import measure
from soilbus.terra.effects.effect import Active

__all__ = ["Recording", "recorded", "simulate"]


@dataclass(frozen=True, slots=True)
class Recording:
    """A simulated drive: true values (see drive.Drive) and noisy samples by channel name, in SI, of one seed.

    `bogged_at` is the time [s] at which the tractor got stuck and the recording ends; None where it did not.
    """

    truth: dict[str, NDArray[Any]]
    channels: dict[str, Column]
    seed: int
    bogged_at: float | None = None


def simulate(config: Config, scenario: Scenario, seed: int, effects: Sequence[Active] = ()) -> Recording:
    """Drive the configured vehicle through a scenario and measure it; the same seed gives the same recording.

    Effects are those of config.model.effects and `effects`. The seed picks slips, loads, noise and gain errors. Errors
    are those of `drive.drive`.
    """
    return recorded(drive(config, scenario, seed, effects), config, scenario, seed)


def recorded(done: Drive, config: Config, scenario: Scenario, seed: int) -> Recording:
    """Return the recording of a drive through a scenario, by the sensors of `config` (as `simulate`)."""
    return Recording(done.columns, measure(done, config, seed, scenario.vehicle_seed), seed, done.bogged_at)
