"""`python -m tests.lab.fleet`: a simulated fleet whose vehicles hide effects of the blind generator.

    true      an effect named that is hidden there: in the vehicle, in all vehicles of the type, or in the soil of a log
    false     any other effect named
    found     hidden faults that are named, and the faulty vehicle's own effects by the log from which on they are there

`--rivals` says instead what the logs with a fault, alone, can show of it at all:

    P <= 1 / (1 + exp(-(F - F') / 2 T)),   F, F': fall of -2 log evidence by the hidden effect and by the best other one

with T the temperature of `diagnosis.verdict`, and with T = 1, as if the formulas were those of the field.

Each vehicle drives logs on soils of its own, with sensor gains of its own.  Effects are in the formulas of
`tests.lab.blind`, in other ones than the catalogue's where these differ; the diagnosis is the real one.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soilbus.diagnosis.fleet import by_name, diagnose_type, named
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.vehicle_type import own_probabilities
from soilbus.estimation.assembly import possible_effects, prior_of
from soilbus.offline.manoeuvre import record_of_recording
from soilbus.report.table import table
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


FAULTS = (
    Fault("wheel_load_offset:one", 500.0, 1),
    Fault("draft_gain:gain", 0.12, 1),
    Fault("rolling_radius:one_axle", 0.06, 1),
    Fault("draft_offset:constant", 600.0, 1),
)
"""Faults of vehicles, between barely visible and as great as they get."""
SHARED = (Fault("drivetrain_loss:constant", 60.0), Fault("drivetrain_loss:efficiency", 0.07))
"""Effects of a type."""


@dataclass(frozen=True)
class Fleet:
    """Vehicles of one type: the records of each, the fault that each has, and what all have."""

    vehicles: tuple[tuple[Record, ...], ...]
    faults: Mapping[int, Fault]
    shared: Fault | None


class Named(NamedTuple):
    """One name that was given: effect, vehicle (None: the type), log from which on, probability."""

    effect: str
    vehicle: int | None
    first: int
    probability: float


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


def names_given(of: Fleet) -> list[Named]:
    """The real diagnosis of a fleet, as `soilbus batch --diagnose` does it."""
    config = reference_configuration()
    catalogue = possible_effects(config)
    shared, found = diagnose_type(of.vehicles, prior_of(config), catalogue)
    own = own_probabilities([each.places for each in found], len(catalogue))
    of_record = {effect.name for effect in catalogue if effect.of_record}
    candidates = [Named(one.effect.name, None, 0, one.probability) for one in shared]
    for v, (each, places) in enumerate(zip(found, own, strict=True)):
        for name, p in by_name(places).items():
            if name not in of_record:
                candidates.append(Named(name, v, each.onsets[name].first if name in each.onsets else 0, p))
    given = named([one.probability for one in candidates])
    return [one for one, is_given in zip(candidates, given, strict=True) if is_given]


def is_true(one: Named, of: Fleet) -> bool:
    """Whether a name is that of a hidden effect of the vehicle, or of the type."""
    if one.vehicle is None:
        return of.shared is not None and one.effect == of.shared.effect
    return one.vehicle in of.faults and one.effect == of.faults[one.vehicle].effect


def faults_of(seed: int) -> dict[int, Fault]:
    """Three vehicles with faults by turns."""
    rng = np.random.default_rng([seed, 7])
    kinds = [FAULTS[i] for i in rng.choice(len(FAULTS), 3, replace=False)]
    return dict(zip(rng.choice(VEHICLES, 3, replace=False).tolist(), kinds, strict=True))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each fleet and the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.fleet", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seed", type=int, default=1, help="of the first fleet (1)")
    parser.add_argument("--fleets", type=int, default=2, help="fleets of each kind (2)")
    parser.add_argument("--only-shared", action="store_true", help="no fleets without an effect of the type")
    chosen = parser.parse_args(arguments)
    rows = []
    for effects in (SHARED,) if chosen.only_shared else (SHARED, ()):
        faults = found = since = types = types_found = sound = sound_named = true = given = 0
        for seed in range(chosen.seed, chosen.seed + chosen.fleets):
            of = fleet(seed, faults_of(seed), effects[seed % len(effects)] if effects else None)
            names = names_given(of)
            right = [one for one in names if is_true(one, of)]
            print(f"seed {seed}, {of.shared and of.shared.form}, {dict(of.faults)}:", flush=True)
            for one in names:
                print(f"  {'true' if one in right else 'FALSE'} {one}", flush=True)
            own = [one for one in right if one.vehicle is not None]
            faults, found = faults + len(of.faults), found + len(own)
            since += sum(of.faults[one.vehicle].first == one.first for one in own if one.vehicle is not None)
            types, types_found = types + (of.shared is not None), types_found + len(right) - len(own)
            sound += VEHICLES - len(of.faults)
            sound_named += len({one.vehicle for one in names if one.vehicle is not None} - of.faults.keys())
            true, given = true + len(right), given + len(names)
        rows.append((
            "shared effect" if effects else "none shared", f"{found} of {faults}", f"{since} of {found}",
            f"{types_found} of {types}", f"{sound_named} of {sound}", f"{given - true} of {given}",
        ))  # fmt: skip
    head = ("fleets", "faults named", "onset right", "type effects named", "sound vehicles named", "false names")
    print(table(head, rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
