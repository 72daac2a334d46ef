"""What the formula of a true effect leaves gets no name, whoever has put that effect into the model."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

from fleet import logs_with
from soilbus.diagnosis.diagnose import diagnose
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.nuisance_parameters import parameters_of
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.effects.catalogue import CATALOGUE
from tests.lab.blind.cases import cases
from tests.lab.blind.trial import record_of_case

PRIOR = prior_of(reference_configuration())
TYRE = CATALOGUE["tyre_deflection"]
"""Hidden below as forms that are not the catalogue's."""


def test_beside_a_large_effect_in_one_search():
    case = next(islice(cases("single", 506), 98, None))
    assert case.hidden == ("grade",)
    candidates = [CATALOGUE[name] for name in ("grade", "bulldozing", "multipass", "draft_offset")]
    found = diagnose([record_of_case(case)], prior_of(case.config), candidates)
    assert [addition.effect.name for addition in found.additions] == ["grade"]


def test_beside_an_effect_of_the_configuration():
    """As `diagnose --model-out` writes it from one log, and a second log is diagnosed beside it."""
    first, second = logs_with("tyre_deflection:spring", 1.1e-6, seed=33)
    fitted = fit_model([first], PRIOR, [TYRE])
    assert fitted is not None
    values = fitted.parameters()[TYRE.name]
    free = [
        replace(f, value=values[f.parameter.name].value, std=values[f.parameter.name].std)
        for f in parameters_of(TYRE, 4)
    ]
    others = [CATALOGUE[name] for name in ("stress_peak_shift", "multipass", "bulldozing")]
    found = diagnose([second.with_effects([TYRE], free)], PRIOR, others)
    assert found.additions == ()
