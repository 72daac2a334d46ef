"""Forces and moments of a simulated drive, written out from its columns."""

from collections.abc import Mapping, Sequence

import numpy as np

from soilbus.config.model import Config

GRAVITY = 9.80665
WHEELS = ("FL", "FR", "RL", "RR")


def total(columns: Mapping[str, np.ndarray], quantity: str, wheels: Sequence[str] = WHEELS) -> np.ndarray:
    """Sum of a quantity over wheels, at each instant."""
    return np.asarray(np.sum([columns[f"{quantity}.{wheel}"] for wheel in wheels], axis=0))


def along_the_way(config: Config, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Force [N] that inertia and slope ask for, at each instant."""
    assert config.vehicle is not None
    return np.asarray(config.vehicle.mass * (columns["acceleration"] + GRAVITY * np.sin(columns["pitch"])))


def missing_pull(config: Config, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Pull of the wheels less draft, slope and inertia, as a share of the weight, at each instant."""
    assert config.vehicle is not None
    missing = total(columns, "drawbar_pull") - along_the_way(config, columns) - columns["draft"]
    return np.asarray(missing / (config.vehicle.mass * GRAVITY))


def assert_loads_carry_the_weight(config: Config, columns: Mapping[str, np.ndarray]) -> None:
    """And balance its moment about the rear contact line: what presses the front axle down holds the vehicle level."""
    vehicle = config.vehicle
    assert vehicle is not None
    across = vehicle.mass * GRAVITY * np.cos(columns["pitch"])
    assert np.allclose(total(columns, "load"), across, rtol=1e-12, atol=0.0)
    held = columns["draft"] * vehicle.hitch_height + along_the_way(config, columns) * vehicle.cg_height
    front = total(columns, "load", ("FL", "FR")) * vehicle.wheelbase
    assert np.allclose(front, across * vehicle.cg_ahead_of_rear_axle - held, rtol=1e-9, atol=0.0)
