"""The generator hides what it says, by formulas that are not the catalogue's, the same way each time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soilbus.simulator.recording import Recording, simulate
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import WheelModel, state_on, wheel_forces
from tests.lab.blind import outside
from tests.lab.blind.cases import FORMS, KINDS, SOILS, Case, cases
from tests.lab.blind.form import Form
from tests.lab.blind.rim import rim_forces


def titles(forms: tuple[Form, ...]) -> list[str]:
    return [form.title for form in forms]


def shorter(case: Case, seconds: float) -> Case:
    return replace(case, scenario=replace(case.scenario, duration=seconds))


def alike(one: Recording, other: Recording) -> bool:
    same_names = one.channels.keys() == other.channels.keys()
    return same_names and all(np.array_equal(one.channels[n].value, other.channels[n].value) for n in one.channels)


def test_the_rim_integral_is_that_of_the_product_where_nothing_is_hidden():
    angle, slip = np.meshgrid([0.15, 0.35, 0.6], [0.03, 0.2, 0.45])
    for name in SOILS:
        state = state_on(soil_named(name), angle, slip, 0.55, 0.3)
        for how, model in (
            ({}, WheelModel()),
            ({"peak": 0.3}, WheelModel(peak_c1=0.3)),
            ({"leave": -0.4 * angle}, WheelModel(exit_ratio=-0.4)),
        ):
            assert rim_forces(state, **how) == pytest.approx(wheel_forces(state, model), rel=2e-4), (name, how)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_gives_the_same_cases(kind):
    first, again, other = (list(cases(kind, seed)) for seed in (3, 3, 4))
    assert [case.id for case in first] == [case.id for case in again]
    assert not {case.id for case in first} & {case.id for case in other}
    one, same, another = (shorter(cs[1], 3.0) for cs in (first, again, other))
    assert one.config == same.config
    assert alike(one.recording, same.recording)
    assert not alike(one.recording, another.recording)


def test_the_halves_share_no_formula_and_a_case_stays_in_its_half():
    of_all = [case for kind in KINDS for case in cases(kind, 1)]
    assert len({case.id for case in of_all}) == len(of_all)
    tune, report = (
        {form for case in of_all if case.half == half for form in case.forms} for half in ("tune", "report")
    )
    assert not tune & report
    assert tune | report == {*titles(FORMS), *titles(outside.FORMS)}
    for kind in KINDS:
        halves = [case.half for case in of_all if case.kind == kind]
        assert min(halves.count("tune"), halves.count("report")) > 0.15 * len(halves), kind
        assert ("mixed" in halves) == (kind == "pair")
    mixed = next(case for case in of_all if case.half == "mixed")
    assert {mixed.forms[0] in tune, mixed.forms[1] in tune} == {True, False}
    frozen = replace(of_all[0], forms=("grade:hill",))
    assert (frozen.half, replace(frozen, forms=(), id="plain/loam/bare/1.1").half) == ("tune", "report")


def test_every_effect_of_the_catalogue_and_five_others_are_hidden():
    assert {form.effect for form in FORMS} == set(CATALOGUE)
    assert len([form for form in outside.FORMS if not form.imitable]) >= 5
    assert all(form.effect == "" for form in outside.FORMS)
    assert all(2.0 * max(form.small) <= form.large for form in (*FORMS, *outside.FORMS))
    singles = list(cases("single", 1))
    assert {case.forms for case in singles} == {(title,) for title in titles(FORMS)}
    assert {case.soil_name for case in singles} == set(SOILS)
    assert 0.3 < np.mean([case.with_sinkage for case in singles]) < 0.7


def test_the_diagnosis_knows_neither_effect_nor_soil():
    for kind in KINDS:
        for case in cases(kind, 2):
            assert case.config.model.effects == []
            for parameter in ("c", "K"):
                prior, true = getattr(case.config.soil, parameter), getattr(case.soil, parameter)
                off = abs(prior.value / true - 1.0)
                assert (0.30 if kind == "hard" else 0.20) <= off <= (0.40 if kind == "hard" else 0.25)
                assert 0.24 * prior.value < prior.std < 0.41 * prior.value
            assert all((wheel.sinkage is not None) == case.with_sinkage for wheel in case.config.wheel)
            assert case.config.noise.torque.gain == (0.015 if kind == "hard" else 0.005)


@pytest.mark.parametrize("kind", ["plain", "hard", "shaking"])
def test_nothing_is_hidden_in_nulls(kind):
    nulls = list(cases(kind, 1))
    assert {(case.hidden, case.forms, case.size) for case in nulls} == {((), (), "")}
    for case in (shorter(case, 4.0) for case in nulls[:4]):
        assert alike(case.recording, simulate(case.config, case.scenario, case.seed))


@pytest.mark.parametrize("form", [*FORMS, *outside.FORMS], ids=titles((*FORMS, *outside.FORMS)))
def test_every_form_leaves_its_mark_and_the_tractor_drives_on(form):
    kind = "single" if form.effect else "outside"
    case = next(case for case in cases(kind, 1) if case.forms == (form.title,) and case.size == "large")
    case = shorter(case, 60.0 if form.effect == "grade" else 4.0)  # a hill comes later
    hidden = case.recording
    assert hidden.bogged_at is None
    assert case.hidden == ((form.effect,) if form.effect else ())
    assert all(np.isfinite(column.value).all() for column in hidden.channels.values())
    plain = replace(case, parts=()).recording
    sd = {"torque": 20.0, "load": 60.0, "speed": 0.006, "ground_speed": 0.01, "draft": 40.0, "sinkage": 0.004}
    marks = [
        np.sqrt(np.mean((column.value - plain.channels[name].value) ** 2)) / sd[name.split(".")[0]]
        for name, column in hidden.channels.items()
        if name.split(".")[0] in sd
    ]
    assert max(marks) > 0.5
