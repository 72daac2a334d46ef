"""Estimates soil parameters of tractors from their CAN bus.

    wheel_forces    load, drawbar pull and torque of one wheel on a soil
    estimate        from the rows of a single-wheel test rig to a soil with standard deviations
    replay          from recorded logs to a table of windows
    diagnose        what the model misses in logs
    signals         the decoded, admitted samples of a log as a table
    simulate        a drive of the reference tractor or of another one, as a log
    paper           the tables and figures of Xi et al. 2024 by our equations

Each is loaded with what it needs when it is first used (`__init__.pyi` has the types): the daemon loads none of them.
"""

import os
from importlib import import_module
from typing import Any

__version__ = "0.2.0"
"""Version of this package: the one place where it stands, which the build, `soilbus --version` and the bus read."""

_MODULES = {
    "Soil": "soilbus.terra.wheel",
    "SingleWheelRig": "soilbus.api.estimate",
    "diagnose": "soilbus.api.recordings",
    "estimate": "soilbus.api.estimate",
    "load_config": "soilbus.config.file",
    "replay": "soilbus.api.recordings",
    "signals": "soilbus.api.recordings",
    "simulate": "soilbus.api.recordings",
    "soil_named": "soilbus.terra.soils",
    "wheel_forces": "soilbus.api.wheel",
}
"""Where each name of the library is."""

__all__ = ["__version__", *_MODULES]

# Our matrices are too small to be shared out among threads: waiting for each other they would take 1.7 times the
# processor time, and more wall time.  Numpy reads this when it is loaded, here or in a process that we start.
os.environ.setdefault("OMP_NUM_THREADS", "1")


def __getattr__(name: str) -> Any:
    if name == "paper":
        return import_module("soilbus.api.paper")
    if name not in _MODULES:
        raise AttributeError(f"module 'soilbus' has no attribute {name!r}")
    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, "paper"})
