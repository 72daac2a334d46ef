"""`import soilbus`: what it loads, and what each function of the library answers."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import soilbus
from other_wheel import Contact, carrying, forces
from single_wheel import NOISE, RADIUS, RIG, WIDTH, noisy, sweep, write_csv
from soilbus.cli.main import main
from soilbus.config.model import ConfigError
from soilbus.diagnosis.diagnose import NotFitted
from soilbus.offline.columns import TableError
from soilbus.offline.replay import LogError
from soilbus.simulator.reference import TRACTOR
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.soils import SOILS
from wheels_around import active

TRUTH = soilbus.Soil(k_c=2e3, k_phi=1.5e6, n=0.8, phi=0.5, c=2e3, K=0.015)
ROLES = ("wheel_load", "slip", "drawbar_pull", "torque", "sinkage")
"""Roles of the columns of a sweep, in its order."""


@pytest.fixture(scope="module")
def measured() -> dict[str, np.ndarray]:
    return noisy(sweep(TRUTH, (800.0, 1500.0), np.linspace(0.03, 0.6, 9)), np.random.default_rng(1))


@pytest.fixture(scope="module")
def columns(measured) -> dict[str, np.ndarray]:
    return dict(zip(ROLES, measured.values(), strict=True))


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    log = tmp_path_factory.mktemp("drive") / "drive.log"
    soilbus.simulate(log, soil="loam", duration=14.0)
    return log


def rig(**more: object) -> soilbus.SingleWheelRig:
    noise = dict(zip(ROLES, ({"relative": NOISE["load"]}, *list(NOISE.values())[1:]), strict=True))
    return soilbus.SingleWheelRig(RADIUS, WIDTH, **{"noise": noise, "tyre": "flexible", **more})


def test_the_import_alone_loads_nothing():
    code = "import sys, soilbus; print(*{m.partition('.')[0] for m in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {"numpy", "scipy", "can", "pandas", "pydantic"}.isdisjoint(loaded)


def test_every_name_is_there_and_typed():
    stub = Path(soilbus.__file__).with_suffix(".pyi").read_text()
    for name in [*soilbus.__all__, "paper"]:
        assert getattr(soilbus, name) is not None
        assert name in dir(soilbus)
        assert name in stub
    with pytest.raises(AttributeError, match="no attribute 'wheel_force'"):
        _ = soilbus.wheel_force


def test_only_public_names_are_shown():
    assert dir(soilbus) == sorted([*soilbus.__all__, "paper"])


def test_an_estimate_has_a_table_residuals_and_a_plot(columns):
    found = soilbus.estimate(columns, rig())
    table = found.to_frame()
    assert table.loc["phi", "value"] == found.values["phi"]
    assert table.loc["phi", "std"] == found.std["phi"]
    left = found.residuals
    assert set(left["channel"]) == {"drawbar_pull", "torque", "sinkage"}
    pull = left[left["channel"] == "drawbar_pull"]
    np.testing.assert_allclose(pull["measured"], columns["drawbar_pull"])
    assert np.abs(pull["residual"]).median() < 0.05 * np.abs(pull["measured"]).max()
    assert len(found.plot().axes) == 9


def test_a_diagnosis_has_residuals_and_a_plot_of_held_out_readings(drive):
    found = soilbus.diagnose(drive, TRACTOR)
    left = found.residuals
    assert set(left["wheel"]) >= {"FL", "RR"}
    np.testing.assert_allclose(left["residual"], left["measured"] - left["modelled"])
    drawn = found.plot()
    assert [axis.get_xlabel() for axis in drawn.axes[1:3]] == ["slip", "load [N]"]
    assert drawn._repr_png_()[1:4] == b"PNG"  # what a notebook shows


def test_signals_of_what_has_none_are_refused_in_a_line(tmp_path, drive, columns):
    with pytest.raises(ValueError, match="2 logs: give one"):
        soilbus.signals([drive, drive], TRACTOR)
    with pytest.raises(ValueError, match="test rig's table holds no signals over time"):
        soilbus.signals(write_csv(tmp_path / "t.csv", columns), rig().configuration(columns))
    other = tmp_path / "other.log"
    other.write_text("(1.0) can0 123#00\n")
    with pytest.raises(LogError, match="none of its 1 frames is in the DBC"):
        soilbus.signals(other, TRACTOR)


def test_signals_are_the_admitted_samples_in_si(drive):
    recording = soilbus.simulate(soil="loam", duration=14.0)
    frame = soilbus.signals(drive, TRACTOR)
    assert frame.attrs["units"]["torque.FL"] == "N.m"
    value = recording.channels["draft"].value
    got = frame["draft [N]"].dropna()
    assert len(got) == len(value)
    np.testing.assert_allclose(got, value, atol=5.0)


@pytest.mark.parametrize("law", ["exponential", "rational"])
def test_forces_are_those_of_an_independent_integration(law):
    load, slip = np.array([1500.0, 3000.0, 6000.0]), np.array([0.1, 0.2, 0.5])
    contact = Contact(rational=law == "rational")
    angle = carrying(TRUTH, contact, load, slip, 0.5, 0.3)
    _, pull, torque = forces(TRUTH, contact, angle, slip, 0.5, 0.3)
    found = soilbus.wheel_forces(TRUTH, load, slip, radius=0.5, width=0.3, model=law)
    np.testing.assert_allclose(found.entry_angle, angle, rtol=1e-4)
    np.testing.assert_allclose(found.drawbar_pull, pull, rtol=1e-3, atol=1.0)
    np.testing.assert_allclose(found.torque, torque, rtol=1e-3)
    np.testing.assert_allclose(found.sinkage, 0.5 * (1.0 - np.cos(angle)), rtol=2e-4)


def test_load_and_sinkage_are_each_others_inverse_in_any_shape():
    slip = np.linspace(-0.1, 0.6, 4)[:, None]
    by_load = soilbus.wheel_forces("loam", [2000.0, 6000.0], slip, radius=0.5, width=0.3)
    assert by_load.torque.shape == by_load.load.shape == (4, 2)
    back = soilbus.wheel_forces("loam", None, slip, radius=0.5, width=0.3, sinkage=by_load.sinkage)
    np.testing.assert_allclose(back.load, by_load.load, rtol=1e-6)
    np.testing.assert_allclose(back.drawbar_pull, by_load.drawbar_pull, rtol=1e-6)
    alone = soilbus.wheel_forces("loam", 2000.0, -0.1, radius=0.5, width=0.3)
    assert isinstance(alone.torque, float)
    assert alone.torque == pytest.approx(by_load.torque[0, 0])


@pytest.mark.parametrize(("name", "value"), [("slip_sinkage", 0.5), ("lugs", 0.02), ("hardpan", 3.0)])
def test_effects_act_as_in_the_catalogue(name, value):
    first = CATALOGUE[name].parameters[0].name
    wanted = sweep(TRUTH, (800.0, 1500.0), (0.05, 0.3, 0.6), [active(name, **{first: value})])
    found = soilbus.wheel_forces(
        TRUTH, wanted["load"], wanted["slip"], radius=RADIUS, width=WIDTH, effects={name: value}
    )
    np.testing.assert_allclose(found.drawbar_pull, wanted["pull"], rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(found.torque, wanted["torque"], rtol=1e-6)
    np.testing.assert_allclose(found.sinkage, wanted["sink"], rtol=1e-6)
    heavy = soilbus.wheel_forces(TRUTH, [800.0, 1e9], 0.2, radius=RADIUS, width=WIDTH, effects={name: value})
    assert np.isnan(heavy.torque).tolist() == [False, True]


def test_what_is_not_known_or_not_carried_stays_unknown():
    found = soilbus.wheel_forces("loam", [np.nan, 1e9, 6000.0], 0.2, radius=0.5, width=0.3)
    for values in (found.load, found.drawbar_pull, found.torque, found.entry_angle, found.sinkage):
        assert np.isnan(values).tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"soil": "lome"}, "no soil is named lome"),
        ({"radius": 0.0}, "radius must be above 0"),
        ({"width": [0.3, -0.3]}, "width must be above 0"),
        ({"slip": 20.0}, "is it in per cent"),
        ({"load": [6000.0, -1.0]}, "a load of -1 N is below 0"),
        ({"load": None}, "either the load or the sinkage"),
        ({"sinkage": 0.05}, "either the load or the sinkage"),
        ({"load": None, "sinkage": 0.5}, "sinkage must be above 0 and below"),
        ({"model": "linear"}, "no shear law is named linear"),
        ({"effects": {"slipsinkage": 0.4}}, "no effect is named slipsinkage; did you mean slip_sinkage"),
        ({"effects": {"hardpan.width": 0.4}}, "hardpan has no parameter width; known: stiffness, depth"),
        ({"effects": {"draft_offset": 40.0}}, "draft_offset does not act on a single wheel"),
        ({"effects": {"lugs": 0.01, "multipass": 0.5}}, "multipass does not act on a single wheel"),
        ({"effects": {"lugs": 0.01}, "load": None, "sinkage": 0.05}, "effects need the load"),
    ],
)
def test_a_wrong_wheel_is_refused_in_a_line(change, complaint):
    arguments = {"soil": "loam", "load": 6000.0, "slip": 0.2, "radius": 0.5, "width": 0.3} | change
    with pytest.raises(ValueError, match=complaint) as error:
        soilbus.wheel_forces(**arguments)
    assert "\n" not in str(error.value)


def test_an_estimate_is_that_of_replay_on_the_same_table(tmp_path, measured, columns):
    config = tmp_path / "rig.toml"
    config.write_text(RIG)
    assert main(["replay", "--config", str(config), str(write_csv(tmp_path / "t.csv", measured)), "--json",
                 str(tmp_path / "out.jsonl")]) == 0  # fmt: skip
    soil = json.loads((tmp_path / "out.jsonl").read_text())["soil"]
    by_path = soilbus.estimate(measured, config)
    by_rig = soilbus.estimate(pd.DataFrame(columns, index=np.arange(18)[::-1]), rig())
    for name, written in soil.items():
        for found in (by_path, by_rig):
            assert found.values[name] == pytest.approx(written["value"], rel=1e-9)
            assert found.std[name] == pytest.approx(written["std"], rel=1e-9)
    off = [(by_rig.values[name] - true) / by_rig.std[name] for name, true in TRUTH._asdict().items()]
    assert max(map(abs, off)) < 3.0


def test_an_estimate_prints_every_parameter_with_unit_and_prior(columns):
    found = soilbus.estimate(columns, rig(soil={"K": (0.015, 0.0)}))
    text = repr(found)
    assert "rows used          = 18 (left out: none)" in text
    assert "status             = valid" in text
    assert f"phi:   {np.degrees(found.values['phi']):.1f} +/- " in text
    assert "K:     15 (held)" in text
    assert "kPa" in text
    assert "C(k_phi, n) = +" in text
    assert found.std["K"] == 0.0
    assert "c:     0 (held)" in repr(soilbus.estimate(columns, rig(soil={"c": (0.0, 0.0)})))
    assert np.isnan(found.correlation[5]).all()
    assert max(map(len, text.splitlines())) < 100


def test_rows_that_cannot_be_used_are_counted_and_missing_cells_are_missing(columns):
    with_gaps = pd.DataFrame(columns)
    with_gaps.loc[0, "wheel_load"] = np.nan
    with_gaps["torque"] = with_gaps["torque"].astype(object)
    with_gaps.loc[1, "torque"] = None
    with_gaps.loc[2, "torque"] = pd.NA
    found = soilbus.estimate(with_gaps, rig())
    assert (found.rows, dict(found.left_out)) == (17, {"no_load": 1})
    whole = soilbus.estimate(columns, rig())
    assert found.std["phi"] > whole.std["phi"]


def test_replay_of_a_table_says_which_soil_bed_a_row_is_of(tmp_path, columns):
    both = {role: np.tile(cells, 2) for role, cells in columns.items()} | {"run": np.repeat(["firm", "loose"], 18)}
    table = soilbus.replay(write_csv(tmp_path / "t.csv", both), rig().configuration(both))
    assert table["log"].tolist() == ["t.csv, firm", "t.csv, loose"]


def test_each_soil_bed_has_its_own_estimate(columns):
    other = noisy(sweep(SOILS["dry_sand"], (800.0, 1500.0), np.linspace(0.03, 0.6, 9)), np.random.default_rng(2))
    both = {role: np.concatenate([columns[role], more]) for role, more in zip(ROLES, other.values(), strict=True)}
    both["run"] = np.repeat(["firm", "loose"], 18)
    firm, loose = (soilbus.estimate(both, rig(), run=bed) for bed in ("firm", "loose"))
    assert firm.values == soilbus.estimate(columns, rig()).values
    assert loose.bearing_pressure.value < firm.bearing_pressure.value / 2.0
    with pytest.raises(TableError, match="2 soil beds: say which by run: firm, loose"):
        soilbus.estimate(both, rig())
    with pytest.raises(TableError, match="no soil bed lose; did you mean loose"):
        soilbus.estimate(both, rig(), run="lose")
    with pytest.raises(TableError, match=r"no usable row of the soil bed loose .slip_range"):
        soilbus.estimate(both | {"slip": np.where(both["run"] == "loose", 99.0, both["slip"])}, rig(), run="loose")
    with pytest.raises(TableError, match="no column says"):
        soilbus.estimate(columns, rig(), run="firm")


@pytest.mark.parametrize(
    ("change", "more", "error", "complaint"),
    [
        ({"wheel_load": None}, {}, TableError, "no column wheel_load; it has slip"),
        (dict.fromkeys(ROLES), {}, TableError, "no column wheel_load"),
        ({"torque": None, "torqe": [1.0] * 18}, {}, TableError, "torqe; did you mean torque"),
        ({"torque": [1.0]}, {}, TableError, "not of one length"),
        ({"torque": 1.0}, {}, TableError, "not of one length"),
        ({"torque": ["strong"] * 18}, {}, TableError, "row 1, column torque: 'strong' is not a number"),
        ({"slip": [120.0] * 18}, {}, TableError, "no usable row in it .slip_range"),
        ({"drawbar_pull": None, "torque": None, "sinkage": None}, {}, ConfigError, "at least one of"),
        ({}, {"noise": {"load": 1.0}}, TableError, "noise of load; known: wheel_load"),
        ({}, {"radius": 300.0}, ConfigError, "is it in mm"),
    ],
)  # fmt: skip
def test_wrong_data_or_a_wrong_rig_is_refused_in_a_line(columns, change, more, error, complaint):
    data = {name: cells for name, cells in (columns | change).items() if cells is not None}
    with pytest.raises(error, match=complaint) as refused:
        soilbus.estimate(data, soilbus.SingleWheelRig(**{"radius": RADIUS, "width": WIDTH} | more))
    assert "\n" not in str(refused.value)


def test_replay_is_the_json_lines_as_a_table(tmp_path, drive):
    windows = soilbus.replay(drive, TRACTOR)
    assert main(["replay", "--config", str(TRACTOR), str(drive), "--json", str(tmp_path / "out.jsonl")]) == 0
    lines = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert len(windows) == len(lines) > 2
    for (_, row), line in zip(windows.iterrows(), lines, strict=True):
        assert row["t"] == line["t"]
        assert row["soil.phi.std"] == pytest.approx(line["soil"]["phi"]["std"], rel=1e-6)
        assert row["slip.RR"] == pytest.approx(line["slip"]["RR"], rel=1e-6)
        assert row["bearing_pressure.z_driven.1"] == pytest.approx(line["bearing_pressure"]["z_driven"][1], rel=1e-6)
    assert windows["traversability.max_draft.value"].dtype == float


def test_replay_without_pandas_is_a_list_of_rows(monkeypatch, drive):
    import soilbus.api.recordings as recordings

    table = soilbus.replay([drive, drive], TRACTOR)
    monkeypatch.setattr(recordings, "find_spec", lambda name: None)
    rows = soilbus.replay([str(drive), str(drive)], str(TRACTOR))
    assert [row["soil.n.value"] for row in rows] == table["soil.n.value"].tolist()
    assert {row["log"] for row in rows} == {"drive.log", "drive.log (2)"}
    with pytest.raises(LogError, match="no such file"):
        soilbus.replay("none.log", TRACTOR)


def test_simulated_drives_are_the_same_for_the_same_seed():
    one, again, other = (soilbus.simulate(soil=["loam", "wet_clay"], duration=4.0, seed=s) for s in (3, 3, 4))
    assert np.array_equal(one.truth["draft"], again.truth["draft"])
    assert not np.array_equal(one.truth["draft"], other.truth["draft"])
    with pytest.raises(ConfigError, match="did you mean slip_sinkage"):
        soilbus.simulate(effects={"slip_sinkag": 0.4})


def test_the_papers_tables_are_what_the_command_prints(capsys):
    assert main(["paper"]) == 0
    printed = capsys.readouterr().out.splitlines()
    for number in (3, 4, 6, 7):
        table = soilbus.paper.table(number)
        at = next(i for i, line in enumerate(printed) if line.startswith(f"Table {number}:"))
        for line, other in zip(repr(table).splitlines(), printed[at:], strict=False):
            assert line.split()[:-1] == other.split()[:-1]  # the last column is a time
        assert len(table.rows) == 6
        assert all(row.our_error < 1e-7 < row.printed_error for row in table.rows)


def test_a_table_that_the_paper_does_not_have_is_named():
    with pytest.raises(ValueError, match=r"no table 5 of estimates in the paper; there are 3, 4, 6, 7"):
        soilbus.paper.table(5)
    with pytest.raises(ValueError, match=r"sinkage of 0\.6 m"):
        soilbus.paper.table(3, sinkage=0.6)


def test_rows_that_no_soil_describes_are_said_not_to_be_fitted(columns):
    nothing = {**columns, "torque": -columns["torque"], "drawbar_pull": 50.0 * columns["drawbar_pull"]}
    with pytest.raises(NotFitted, match="no soil describes the 18 rows"):
        soilbus.estimate(nothing, rig())
