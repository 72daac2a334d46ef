"""Our reference machines: the tractor of the demo and of commands without a configuration, and others beside it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from soilbus.config.file import load_config, machine
from soilbus.config.model import Config

__all__ = ["AXLE_MOTORS", "REAR_DRIVE", "REFERENCES", "TRACTOR", "reference_configuration"]

TRACTOR = machine("tractor")
"""Four motors, four load cells."""
REAR_DRIVE = machine("tractor-2wd")
"""One motor on the rear axle, front wheels that roll freely, a load cell of the rear axle."""
AXLE_MOTORS = machine("tractor-axles")
"""A motor on each axle, no load cells, an inertial sensor."""
REFERENCES = {path.stem: path for path in (TRACTOR, REAR_DRIVE, AXLE_MOTORS)}
"""All of them by name: tractor, tractor-2wd, tractor-axles."""


def reference_configuration(overrides: Iterable[str] = (), path: Path = TRACTOR) -> Config:
    """Return the configuration of the reference tractor or another machine; ConfigError for a wrong override."""
    return load_config(path, overrides)
