"""Records of simulated logs of one vehicle that hides an effect of the blind generator, in its formulas."""

from __future__ import annotations

import numpy as np

from soilbus.diagnosis.records import Record
from soilbus.offline.manoeuvre import record_of_recording
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import soil_named
from tests.lab.blind.cases import FORMS, SOILS, plain_sinkage
from tests.lab.blind.form import Form, Setting, together


def logs_with(title: str, size: float, seed: int, vehicle: int = 1, logs: int = 2) -> list[Record]:
    """Logs of 40 s on soils of their own; the form of this title has this size, in its unit, in all of them."""
    form = next(form for form in FORMS if form.title == title)
    return [_record(form, size, seed, vehicle, log) for log in range(logs)]


def _record(form: Form, size: float, seed: int, vehicle: int, log: int) -> Record:
    config, rng = reference_configuration(), np.random.default_rng([seed, vehicle, log])
    name = str(rng.choice(SOILS))
    soil = soil_named(name)
    how = together([form.hide(size, Setting(soil, plain_sinkage(soil), np.random.default_rng([seed])))])
    x = np.cumsum(np.concatenate([[0.0], rng.uniform(12.0, 25.0, 20)]))
    slope = rng.uniform(-0.04, 0.04, len(x))
    drive = Scenario(
        40.0, (Patch(0.0, name),), speed=Swing(0.8, 2.0), slip=Swing(0.05, 0.40),
        slope=tuple(zip(x.tolist(), slope.tolist(), strict=True)), vehicle_seed=1000 * seed + vehicle,
    )  # fmt: skip
    recording = simulate(how.tractor(config), how.way(drive), int(rng.integers(2**31)), how.effects)
    return record_of_recording(f"{vehicle}.{log} {name}", how.after(recording), config)
