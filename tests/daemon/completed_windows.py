"""`PYTHONPATH=service python tests/daemon/completed_windows.py [EFFECT...]`: a window's time under each.

One recording without effects, estimated with each effect in the model as `diagnose --model-out`
writes it: free within a tenth of the prior std, and half of that from absence, as the data allow.
Values that the data contradict take longer: windows then start anew more often.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.config.model import Config
from soilbus.config.model import Effect as Setting
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.trials.bench.on_log import seconds_of_windows

SECONDS = 14.0
VALUE, STD = 0.05, 0.1
"""In prior std of each parameter."""
EFFECTS = tuple(name for name, effect in CATALOGUE.items() if not effect.of_record)
"""What describes the ground of one recording is no part of the daemon's model."""


class Times(NamedTuple):
    """Processor time [ms] of a window: median and greatest of all but the first, and the first, which is cold."""

    median: float
    most: float
    first: float
    ratio: float
    """Median over the windows of the time in plain windows [1]."""


def completed(name: str) -> Config:
    """The reference configuration with one effect in the model."""
    effect = CATALOGUE[name]
    law = effect.base_law or "exponential"
    config = reference_configuration([f"model.shear_law={law}"])
    values = {p.name: {"value": p.neutral + VALUE * p.std, "std": STD * p.std} for p in effect.parameters}
    model = config.model.model_copy(update={"effects": [Setting(name=name, **values)]})
    return config.model_copy(update={"model": model})


def recorded(folder: Path) -> Path:
    """A drive on loam, as a log."""
    config, log = reference_configuration(), folder / "drive.log"
    write_log(frames(simulate(config, excited("loam", SECONDS), seed=1), config, load_databases(config)), log)
    return log


def times(log: Path, names: Iterable[str] = EFFECTS) -> Iterator[tuple[str, Times]]:
    """All that the service does for a window with each effect, and in turn for the same window without it.

    So a machine that is busy meanwhile slows both.
    """
    for name in names:
        both = zip(*(seconds_of_windows(log, c) for c in (reference_configuration(), completed(name))), strict=True)
        plain, spent = 1e3 * np.array(list(both)).sum(-1).T
        ratio = np.median(spent[1:] / plain[1:])
        yield name, Times(float(np.median(spent[1:])), float(spent[1:].max()), float(spent[0]), float(ratio))


def main() -> int:
    """Print the table."""
    print(f"{'effect':20}{'median':>8}{'most':>8}{'first':>8}  ms a window, in plain ones")
    with tempfile.TemporaryDirectory() as folder:
        for name, spent in times(recorded(Path(folder)), sys.argv[1:] or EFFECTS):
            print(f"{name:20}" + "".join(f"{t:8.1f}" for t in spent), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
