"""Records of simulated fleets whose vehicles hide effects of the blind generator, in its formulas."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soilbus.diagnosis.records import Record
from soilbus.offline.manoeuvre import record_of_recording
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import soil_named
from tests.lab.blind.cases import FORMS, SOILS, plain_sinkage
from tests.lab.blind.form import Setting, together

VEHICLES, LOGS, SECONDS = 8, 2, 40.0
"""Of a fleet: vehicles, logs of each, and seconds of a log."""


class Fault(NamedTuple):
    """A form of the blind generator by its title, its size in the form's unit, and the first log that has it."""

    form: str
    size: float
    first: int = 0

    @property
    def effect(self) -> str:
        """Its name in the catalogue."""
        return self.form.partition(":")[0]


@dataclass(frozen=True)
class Fleet:
    """Vehicles of one type: the records of each, the fault that each has, and what all have."""

    vehicles: tuple[tuple[Record, ...], ...]
    faults: Mapping[int, Fault]
    shared: Fault | None


def fleet(
    seed: int, faults: Mapping[int, Fault], shared: Fault | None, vehicles: int = VEHICLES, logs: int = LOGS,
    seconds: float = SECONDS,
) -> Fleet:  # fmt: skip
    """A fleet; the same for the same seed."""
    all_records = []
    for v in range(vehicles):
        records = []
        for log in range(logs):
            own = faults[v] if v in faults and log >= faults[v].first else None
            records.append(_record(seed, v, log, own, shared, seconds))
        all_records.append(tuple(records))
    return Fleet(tuple(all_records), faults, shared)


def _record(
    seed: int, vehicle: int, log: int, own: Fault | None, shared: Fault | None = None, seconds: float = SECONDS
) -> Record:
    config, rng = reference_configuration(), np.random.default_rng([seed, vehicle, log])
    name = str(rng.choice(SOILS))
    soil, forms = soil_named(name), {form.title: form for form in FORMS}
    # what a form draws for itself, such as a sign, is the type's or the vehicle's
    drawn = ((shared, [seed]), (own, [seed, vehicle]))
    settings = [(one, Setting(soil, plain_sinkage(soil), np.random.default_rng(of))) for one, of in drawn if one]
    how = together([forms[one.form].hide(one.size, setting) for one, setting in settings])
    x = np.cumsum(np.concatenate([[0.0], rng.uniform(12.0, 25.0, 20)]))
    slope = rng.uniform(-0.04, 0.04, len(x))
    drive = Scenario(
        seconds, (Patch(0.0, name),), speed=Swing(0.8, 2.0), slip=Swing(0.05, 0.40),
        slope=tuple(zip(x.tolist(), slope.tolist(), strict=True)), vehicle_seed=1000 * seed + vehicle,
    )  # fmt: skip
    recording = simulate(how.tractor(config), how.way(drive), int(rng.integers(2**31)), how.effects)
    return record_of_recording(f"{vehicle}.{log} {name}", how.after(recording), config)
