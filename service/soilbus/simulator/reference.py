"""Our reference tractor (tractor.toml): for the demo, and for commands without a configuration."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from soilbus.config.file import load_config
from soilbus.config.model import Config

__all__ = ["TRACTOR", "reference_configuration"]

TRACTOR = Path(__file__).with_name("tractor.toml")


def reference_configuration(overrides: Iterable[str] = ()) -> Config:
    """Configuration of the reference tractor; ConfigError for a wrong override."""
    return load_config(TRACTOR, overrides)
