"""`python -m tests.lab.snow DIR`: measured immobilisations, and when soilbus warned of them.

    warned     a warning begins from a second before the marked begin on, before the vehicle stands
    lead       standstill - begin of the first such warning [s]
    early      warnings that begin more than a second before the marked begin

DIR holds what `shared/field/snow-convert.py` makes of a public data set: logs, DBC, configuration, and of each log the
truth (begin and end of the immobilisation, the alarms of its author).  By this count the author's detector has 17 of
17, 1.93 s and 8.  Each log goes through `replay`; a warning that only lasts does not begin again.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from soilbus.can.dbc_files import load_databases
from soilbus.config.file import load_config
from soilbus.config.model import Config
from soilbus.offline.replay import fed
from soilbus.pipeline.pipeline import Pipeline
from soilbus.report.table import table

TUNED = frozenset(f"event_1_{i}" for i in range(1, 7))
"""Events on which `[warning]` was tuned.  The others were looked at between changes of structure, and of settings that
are alike on the six one was taken that is better on them: their figures are those of a fit, not of a forecast."""
TOLERANCE = 1.0
"""Time [s] before the marked begin from which a warning counts as in time: the marks were set by hand."""


class Event(NamedTuple):
    """One log: its name, begin of the immobilisation and standstill [s], when warnings began [s]."""

    name: str
    begin: float
    end: float
    warnings: tuple[float, ...]

    @property
    def lead(self) -> float:
        """Time [s] from the first warning in time to standstill; nan without one."""
        in_time = [t for t in self.warnings if self.begin - TOLERANCE <= t < self.end]
        return self.end - in_time[0] if in_time else math.nan

    @property
    def early(self) -> int:
        """Number of warnings long before."""
        return sum(t < self.begin - TOLERANCE for t in self.warnings)


def warnings_of(log: Path, config: Config) -> tuple[float, ...]:
    """When warnings begin in a replay of a log [s]."""
    pipeline = Pipeline(config, load_databases(config))
    results = [result for now in fed(pipeline.intake, log, None) for result in pipeline.advance(now)]
    results += pipeline.finish(pipeline.admission.newest)
    return tuple(t for result in results for t in result.warnings.begun)


def events(folder: Path) -> Iterable[Event]:
    """Every log of the folder that has a truth beside it."""
    config = load_config(folder / "snow.toml")
    for path in sorted(folder.glob("*.truth.json")):
        truth, name = json.loads(path.read_text()), path.name.removesuffix(".truth.json")
        yield Event(name, truth["begin"], truth["end"], warnings_of(folder / f"{name}.log", config))


def summary(found: Sequence[Event]) -> str:
    """How many were warned of, mean lead [s], early warnings."""
    leads = [event.lead for event in found if not math.isnan(event.lead)]
    mean = float(np.mean(leads)) if leads else math.nan
    early = sum(event.early for event in found)
    return f"{len(leads)} of {len(found)} warned of, {mean:.2f} s before standstill, {early} warnings long before"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.snow", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path)
    found = list(events(parser.parse_args(arguments).folder))
    rows = [
        (e.name, f"{e.end - e.begin:.1f}", "-" if math.isnan(e.lead) else f"{e.lead:.1f}", str(e.early)) for e in found
    ]
    print(table(("event", "lasts, s", "warned before standstill, s", "early"), rows))
    print("tuned on:  ", summary([event for event in found if event.name in TUNED]))
    print("the others:", summary([event for event in found if event.name not in TUNED]))
    print("over all:  ", summary(found))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
