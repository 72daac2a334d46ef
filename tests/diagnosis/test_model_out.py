"""The completed model as a configuration file: what is written reads back as the same model."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from records import recorded
from soilbus.config.edit import with_effects_text
from soilbus.config.file import load_config, located, shipped_dbc
from soilbus.config.model import ConfigError
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.model_out import effect_tables
from soilbus.estimation.assembly import effects_and_parameters_of, prior_of, rig_of
from soilbus.simulator.reference import TRACTOR, reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE


def written(tmp_path: Path, tables, overrides=(), notes=()) -> Path:
    path = tmp_path / "out.toml"
    path.write_text(with_effects_text(TRACTOR, overrides, tables, tmp_path, notes))
    return path


def test_what_is_written_is_the_model_that_was_fitted(tmp_path):
    effects = [CATALOGUE[name] for name in ("draft_offset", "wheel_load_offset", "soil_drift")]
    fitted = fit_model([recorded(excited("loam", 30.0), 2)], prior_of(reference_configuration()), effects)
    tables, notes = effect_tables(fitted)
    config = load_config(written(tmp_path, tables, notes=notes))
    kept, free = effects_and_parameters_of(config)
    assert [effect.name for effect in kept] == ["draft_offset", "wheel_load_offset"]
    reported = fitted.parameters()
    of_wheels = [reported["wheel_load_offset"][f"offset_{w}"] for w in rig_of(config).wheels]
    expected = [reported["draft_offset"]["offset"], *of_wheels]
    found = [f for f in free if f.parameter.name == "offset"]
    np.testing.assert_allclose([(f.value, f.std) for f in found], [(e.value, e.std) for e in expected], rtol=1e-5)
    assert all((f.value, f.std) == (f.parameter.neutral, 0.0) for f in free if f not in found)  # of that record
    text = (tmp_path / "out.toml").read_text()
    assert all(start in text for start in ("# soil_drift (", "# draft_offset (drift", "# wheel_load_offset (drift_FL"))
    assert all(note.endswith("is left out") for note in notes)


numbers = st.floats(0.001, 0.3)


@settings(max_examples=25)
@given(numbers, numbers, st.lists(st.sampled_from(["FL", "FR", "RL", "RR"]), unique=True, min_size=1))
def test_values_and_stds_read_back(tmp_path_factory, value, std, wheels):
    tables = [
        {"name": "slip_sinkage", "exponent": {"value": value, "std": std}},
        {"name": "wheel_load_offset", "offset": {w: {"value": value, "std": std} for w in wheels}},
    ]
    config = load_config(written(tmp_path_factory.mktemp("x"), tables))
    _, free = effects_and_parameters_of(config)
    by_name = {f.name: (f.value, f.std) for f in free}
    assert by_name["slip_sinkage.exponent"] == (value, std)
    for i, wheel in enumerate(rig_of(config).wheels):
        assert by_name[f"wheel_load_offset.offset.{i}"] == ((value, std) if wheel in wheels else (0.0, 0.0))


def test_overrides_and_comments_are_kept(tmp_path):
    overrides = ["wheel.FL.radius=0.51", "signals.ground_speed.timeout=2.5", "model.shear_law=rational"]
    path = written(tmp_path, [{"name": "exponential_shear", "share": 0.9}], overrides)
    config = load_config(path)
    assert config.model_dump(exclude={"model"}) == load_config(TRACTOR, overrides).model_dump(exclude={"model"})
    assert config.model.shear_law == "rational"
    assert "# Reference tractor of soilbus" in path.read_text()
    tomllib.loads(path.read_text())


@pytest.mark.parametrize("effects", [[], [{"name": "lugs", "height": 0.03}, {"name": "multipass", "stiffness": 0.5}]])
@pytest.mark.parametrize("notes", [(), ("grade (slope) is left out", "lugs (height) is at its edge")])
@pytest.mark.parametrize(
    "model",
    [
        "",
        "model = { effects = [], shear_law = 'rational' }  # inline",
        "model.effects = []",
        "model.effects = []\nmodel.shear_law = 'rational'",
        "[model]\nshear_law = 'rational'  # own",
        "[[model.effects]]\nname = 'lugs'",
    ],
)
def test_effects_and_notes_go_into_every_form_of_the_table(model, notes, effects, tmp_path):
    path = tmp_path / "any.toml"
    path.write_text(f"{model}\n{TRACTOR.read_text()}")
    text = with_effects_text(path, [], effects, tmp_path, notes)
    expected = tomllib.loads(path.read_text())
    expected.setdefault("model", {})["effects"] = effects
    assert tomllib.loads(text) == expected
    assert [note for note in notes if f"# {note}\n" not in text] == []
    assert [comment for comment in ("# inline\n", "# own\n") if comment in model + "\n" and comment not in text] == []


def test_dbc_files_are_found_from_the_new_place(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    (here / "dbc").mkdir(parents=True), there.mkdir()
    config = here / "c.toml"
    (here / "dbc/own.dbc").write_text(shipped_dbc("tractor.dbc").read_text())
    (there / "iso11783.dbc").write_text("another file of the same name")
    config.write_text(TRACTOR.read_text().replace('"tractor.dbc"', '"dbc/own.dbc", "iso11783.dbc"'))
    for place in (there, here, Path("/")):
        names = tomllib.loads(with_effects_text(config, [], [], place))["dbc"]["input"]
        expected = [here / "dbc/own.dbc", shipped_dbc("iso11783.dbc")]
        assert [located(place, name).resolve() for name in names] == [path.resolve() for path in expected]
    assert tomllib.loads(with_effects_text(config, [], [], here))["dbc"]["input"] == ["dbc/own.dbc", "iso11783.dbc"]


def test_our_own_dbc_is_found_beside_another_file_of_its_name(tmp_path):
    (tmp_path / "soilbus.dbc").write_text("another file of the same name")
    text = TRACTOR.read_text()
    assert "[output]" not in text
    made = tomllib.loads(with_effects_text(TRACTOR, [], [], tmp_path))
    assert located(tmp_path, made["output"]["dbc"]).resolve() == shipped_dbc("soilbus.dbc").resolve()


def test_a_configuration_that_cannot_be_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="unknown key"):
        with_effects_text(TRACTOR, ["modell.effects=[]"], [], tmp_path)
