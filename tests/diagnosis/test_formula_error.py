"""What the formula of a true effect leaves gets no name, whoever has put that effect into the model."""

from dataclasses import replace
from itertools import islice

import numpy as np

from soilbus.diagnosis.diagnose import diagnose
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.records import Record
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.nuisance_parameters import parameters_of
from soilbus.offline.manoeuvre import record_of_recording
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.soils import soil_named
from tests.lab.blind.cases import FORMS, SOILS, cases, plain_sinkage
from tests.lab.blind.form import Form, Setting, together
from tests.lab.blind.trial import record_of_case


def log_with(form: Form, size: float, seed: int, log: int) -> Record:
    """A log of 40 s on a soil of its own, in which the form has this size, in its unit."""
    config, rng = reference_configuration(), np.random.default_rng([seed, 1, log])
    name = str(rng.choice(SOILS))
    soil = soil_named(name)
    how = together([form.hide(size, Setting(soil, plain_sinkage(soil), np.random.default_rng([seed])))])
    x = np.cumsum(np.concatenate([[0.0], rng.uniform(12.0, 25.0, 20)]))
    slope = rng.uniform(-0.04, 0.04, len(x))
    drive = Scenario(
        40.0, (Patch(0.0, name),), speed=Swing(0.8, 2.0), slip=Swing(0.05, 0.40),
        slope=tuple(zip(x.tolist(), slope.tolist(), strict=True)), vehicle_seed=1000 * seed + 1,
    )  # fmt: skip
    recording = simulate(how.tractor(config), how.way(drive), int(rng.integers(2**31)), how.effects)
    return record_of_recording(f"{log} {name}", how.after(recording), config)


PRIOR = prior_of(reference_configuration())
TYRE = CATALOGUE["tyre_deflection"]
"""Hidden below as a form that is not the catalogue's."""


def test_beside_a_large_effect_in_one_search():
    case = next(islice(cases("single", 506), 98, None))
    assert case.hidden == ("grade",)
    candidates = [CATALOGUE[name] for name in ("grade", "bulldozing", "multipass", "draft_offset")]
    found = diagnose([record_of_case(case)], prior_of(case.config), candidates)
    assert [addition.effect.name for addition in found.additions] == ["grade"]


def test_beside_an_effect_of_the_configuration():
    """As `diagnose --model-out` writes it from one log, and a second log is diagnosed beside it."""
    spring = next(form for form in FORMS if form.title == "tyre_deflection:spring")
    first, second = (log_with(spring, 1.1e-6, 33, log) for log in range(2))
    fitted = fit_model([first], PRIOR, [TYRE])
    values = fitted.parameters()[TYRE.name]
    free = [
        replace(f, value=values[f.parameter.name].value, std=values[f.parameter.name].std)
        for f in parameters_of(TYRE, 4)
    ]
    others = [CATALOGUE[name] for name in ("stress_peak_shift", "multipass", "bulldozing")]
    found = diagnose([second.with_effects([TYRE], free)], PRIOR, others)
    assert found.additions == ()
