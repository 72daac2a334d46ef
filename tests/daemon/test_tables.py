"""Tables of a test rig: what is read, what is refused and why, and whether the estimate is as good as it says."""

import json
import lzma
import re
import tomllib
from itertools import islice

import numpy as np
import pytest

from availability import unavailable
from single_wheel import NOISE, RIG, WIDTH, noisy, sweep, write_csv
from soilbus.cli.main import main
from soilbus.config.file import parse_config
from soilbus.config.model import Config, ConfigError
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.records import TooLittle, record_of_rows
from soilbus.diagnosis.verdict import gap_limit
from soilbus.estimation.assembly import model_of, prior_of, rig_of, with_effects
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import Posterior
from soilbus.offline.columns import TableError
from soilbus.offline.tables import candidates, recordings_of_tables, replay_tables, runs_of, window_of_rows
from soilbus.pipeline.outputs import json_line
from soilbus.report.configuration import configuration_report
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Effect
from soilbus.terra.effects.size import LOAD, RADIUS, for_wheel
from soilbus.terra.wheel import Soil

TRUTH = Soil(k_c=2e3, k_phi=1.5e6, n=0.8, phi=0.5, c=2e3, K=0.015)
LOADS, SLIPS = (800.0, 1500.0), np.linspace(0.03, 0.6, 9)


def rig(**table: object) -> Config:
    raw = tomllib.loads(RIG)
    raw["table"] = {k: v for k, v in (raw["table"] | table).items() if v is not None}
    return parse_config(raw)


@pytest.fixture(scope="module")
def measured() -> dict[str, np.ndarray]:
    return noisy(sweep(TRUTH, LOADS, SLIPS), np.random.default_rng(1))


def fault(raw_change: dict[str, object]) -> str:
    with pytest.raises(ConfigError) as error:
        parse_config(tomllib.loads(RIG) | raw_change)
    assert len(error.value.faults) == 1, error.value.faults
    return error.value.faults[0]


def test_configuration_of_a_rig_is_checked_with_a_line_for_each_fault():
    table = tomllib.loads(RIG)["table"]
    wheel = tomllib.loads(RIG)["wheel"][0]
    assert "table.slip: missing" in fault({"table": {k: v for k, v in table.items() if k != "slip"}})
    assert "table.slipp: unknown key" in fault({"table": table | {"slipp": "x"}})
    assert "factor of 0" in fault({"table": table | {"slip": {"column": "s", "factor": 0.0}}})
    assert "nothing to compare" in fault({"table": {"wheel_load": "load", "slip": "slip"}})
    assert "source must be a text or a number" in fault({"table": table | {"where": {"source": [1, 2]}}})
    vehicle = {"mass": 1000.0, "wheelbase": 2.0, "cg_ahead_of_rear_axle": 1.0, "cg_height": 1.0}
    assert "no [vehicle]" in fault({"vehicle": vehicle})
    with pytest.raises(ConfigError, match="axle: missing"):
        parse_config({"wheel": [wheel]})


def test_units_are_brought_to_si_and_a_missing_cell_is_nan_never_zero(tmp_path):
    path = write_csv(
        tmp_path / "a.csv",
        {
            "load": [0.1, 0.2, 0.3],
            "slip_percent": [10, 20, 30],
            "pull": [1.0, "", 3.0],
            "torque": ["NaN", 5, 6],
            "sink_mm": [1, 2, "n/a"],
        },
    )
    config = rig(
        wheel_load={"column": "load", "factor": 1e3},
        slip={"column": "slip_percent", "factor": 0.01},
        sinkage={"column": "sink_mm", "factor": 1e-3},
    )
    (run,) = runs_of(config, path)
    window = run.window
    np.testing.assert_allclose(window.load[:, 0], [100.0, 200.0, 300.0])
    np.testing.assert_allclose(window.draft, [1.0, np.nan, 3.0])
    np.testing.assert_allclose(window.torque[:, 0], [np.nan, 5.0, 6.0])
    np.testing.assert_allclose(window.sinkage[:, 0], [1e-3, 2e-3, np.nan])
    np.testing.assert_allclose(1.0 - window.ground_speed / (0.3 * window.speed[:, 0]), [0.1, 0.2, 0.3])
    problem = ObservationModel(window, rig_of(config), model_of(config), config.estimator.min_speed)
    assert problem.n_rows == 6  # nine cells of three channels, three of them missing


def test_the_slips_error_is_that_of_one_less_the_ratio_of_speeds():
    config = rig()
    t, values = np.arange(3.0), {"wheel_load": np.full(3, 900.0), "slip": np.array([0.0, 0.4, 0.97])}
    window = window_of_rows(rig_of(config), t, values, rim_speed=20.0)
    np.testing.assert_allclose(window.variance["ground_speed"], (20.0 * NOISE["slip"]) ** 2)
    np.testing.assert_allclose(window.variance["speed"], 0.0)


def test_runs_are_recordings_and_where_picks_rows(tmp_path):
    columns = {"bed": ["b", "a", "b", "a"], "lugs": [0, 0.0, "0.0", 1], "load": [1, 2, 3, 4], "slip": [0.1] * 4}
    path = write_csv(tmp_path / "t.csv", columns | {"pull": [0] * 4, "torque": [0] * 4, "sink": [0] * 4})
    found = runs_of(rig(run="bed", where={"lugs": 0}), path)
    assert [run.name for run in found] == ["t.csv, b", "t.csv, a"]
    assert [run.window.load[:, 0].tolist() for run in found] == [[1.0, 3.0], [2.0]]
    (only,) = runs_of(rig(where={"bed": "a"}), path)
    assert only.window.load[:, 0].tolist() == [2.0, 4.0]
    with pytest.raises(TableError, match="where"):
        runs_of(rig(where={"bed": "c"}), path)


def test_rows_follow_their_times(tmp_path, measured):
    n = len(measured["slip"])
    path = write_csv(tmp_path / "t.csv", measured | {"ms": 500.0 * np.arange(n)[::-1]})
    (run,) = runs_of(rig(t={"column": "ms", "factor": 1e-3}), path)
    np.testing.assert_allclose(run.window.t, 0.5 * np.arange(n))
    np.testing.assert_allclose(run.window.load[:, 0], measured["load"][::-1])


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("load,slip,pull,torque\n1,0.1,2,3\n", "no column sink; it has load, slip, pull, torque"),
        ("load,slip,pull,torque,sink,sink\n", "two columns are named sink"),
        ("load,slip,pull,torque,sink\n1,0.1,two,3,0\n", "row 1, column pull: 'two' is not a number"),
        ("load,slip,pull,torque,sink\n1,0.1,inf,3,0\n", "row 1, column pull: 'inf' is not a number"),
        ("load,slip,pull,torque,sink\n1,0.1,2\n", "row 1 has 3 cells under a header of 5"),
        ("load,slip,pull,torque,sink\n", "no row in it"),
        ("", "no row in it"),
        ("load,slip,pull,torque,sink\n1,,2,3,0\n", "no usable row in it \\(no_slip\\)"),
        ('load,slip\n"1,0.1\n', "not CSV text"),
    ],
)
def test_a_table_that_cannot_be_used_gets_one_clear_line(tmp_path, text, complaint):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(TableError, match=complaint) as error:
        runs_of(rig(), path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


AS_PLAIN = "bed,load,slip,pull,torque,sink\na,900.5,0.1,20.25,30,0.01\na,1200.125,0.2,-40.5,50,"


def with_commas(separator: str) -> str:
    return AS_PLAIN.replace(",", separator).replace(".", ",")


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        (with_commas(";"), "utf-8"), (with_commas("\t"), "utf-16"), (with_commas(";"), "utf-8-sig"),
        (AS_PLAIN.replace(",", ";"), "utf-8"), (AS_PLAIN.replace(",", "\t"), "utf-8"),
        (with_commas(";").replace("sink", "sink;Neigung, °; %").replace("0,01", "0,01;0;1") + ";0;1", "cp1252"),
        ("\n" + AS_PLAIN.replace("sink", "sink,a;b;c;d;e;f;g;h").replace("0.01", "0.01,x") + ",x", "utf-8"),
    ],
)  # fmt: skip
def test_a_spreadsheets_table_is_read_as_the_plain_one(text, encoding, tmp_path):
    (tmp_path / "plain.csv").write_text(AS_PLAIN)
    (tmp_path / "t.csv").write_bytes(text.encode(encoding))
    (plain,) = runs_of(rig(), tmp_path / "plain.csv")
    (run,) = runs_of(rig(), tmp_path / "t.csv")
    for quantity in ("t", "load", "torque", "sinkage", "draft", "ground_speed"):
        np.testing.assert_array_equal(getattr(run.window, quantity), getattr(plain.window, quantity))
    assert run.window.load[0, 0] == 900.5


@pytest.mark.parametrize(
    "rows",
    ["1,200;1;2,400;30;1", "1200,5;0.1;20;30;1", "1.200,5;0,1;20;30;1"],
    ids=["thousands", "both", "thousands and decimals"],
)
def test_a_comma_that_may_part_thousands_is_no_decimal_comma(rows, tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(f"load;slip;pull;torque;sink\n{rows}\n")
    with pytest.raises(TableError, match="is not a number"):
        runs_of(rig(), path)


def test_files_that_are_no_tables_are_named(tmp_path):
    (tmp_path / "a.parquet").write_bytes(b"PAR0 nothing of the kind")
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "a.xlsx").touch()
    (tmp_path / "empty.csv").touch()
    for name, complaint in (
        ("none.csv", "No such file"), ("none.xlsx", "No such file"), ("a.xlsx", "not a table"), ("a.csv", "not CSV"),
        ("a.parquet", "Parquet"), ("empty.csv", "no row in it"),
    ):  # fmt: skip
        with pytest.raises(TableError, match=complaint):
            runs_of(rig(), tmp_path / name)


def test_a_packed_table_is_read_as_the_plain_one_within_limits(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(AS_PLAIN)
    (plain,) = runs_of(rig(), path)
    path.write_bytes(lzma.compress(AS_PLAIN.encode()))
    (packed,) = runs_of(rig(), path)
    np.testing.assert_array_equal(packed.window.load, plain.window.load)
    with lzma.open(path, "wb") as file:
        file.write(AS_PLAIN.encode())
        file.writelines([b"a,1,0.1,1,1,1\n" * 100_000] * 40)
    with pytest.raises(TableError, match="unpacks to more than 250 times its size"):
        runs_of(rig(), path)


def test_a_parquet_file_of_too_many_cells_is_refused_before_it_is_read(tmp_path):
    arrow = pytest.importorskip("pyarrow")
    column, path = arrow.array(np.zeros(4_000_000, np.int8)), tmp_path / "t.parquet"
    names = ["bed", "load", "slip", "pull", "torque", "sink"]
    pytest.importorskip("pyarrow.parquet").write_table(arrow.table(dict.fromkeys(names, column)), path)
    assert path.stat().st_size < 100_000
    with pytest.raises(TableError, match="20000000 cells are too many"):
        runs_of(rig(), path)


def test_parquet_tells_the_same_as_csv(tmp_path, measured):
    try:
        import pyarrow
        from pyarrow.parquet import write_table
    except ModuleNotFoundError:
        unavailable("no pyarrow (extra: tables)")
    values = {k: [None if i == 3 and k == "pull" else float(x) for i, x in enumerate(v)] for k, v in measured.items()}
    write_table(pyarrow.table(values | {"bed": ["x"] * len(values["load"])}), tmp_path / "t.parquet")
    texts = {k: ["" if x is None else repr(x) for x in v] for k, v in values.items()}
    (one,) = runs_of(rig(where={"bed": "x"}), tmp_path / "t.parquet")
    (other,) = runs_of(rig(), write_csv(tmp_path / "t.csv", texts))
    for quantity in ("t", "load", "torque", "sinkage", "draft", "ground_speed"):
        np.testing.assert_array_equal(getattr(one.window, quantity), getattr(other.window, quantity))
    assert np.isnan(one.window.draft[3])


def test_without_pyarrow_a_parquet_file_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(TableError, match=r"soilbus\[tables\]"):
        runs_of(rig(), tmp_path / "a.parquet")


def drawn_windows(rng: np.random.Generator, loads, slips, missing=()):
    """Soils drawn from the prior, of those that carry the wheel, with the window of a noisy sweep on each."""
    config = rig()
    prior = prior_of(config)
    while True:
        truth = Soil(*(prior.median * np.exp(0.6 * prior.log_std * rng.standard_normal(6))))
        try:
            rows = noisy(sweep(truth, loads, slips), rng)
        except ValueError:  # this soil does not carry the wheel
            continue
        roles = {"wheel_load": "load", "slip": "slip", "drawbar_pull": "pull", "torque": "torque", "sinkage": "sink"}
        values = {role: rows[column] for role, column in roles.items() if role not in missing}
        yield truth, window_of_rows(rig_of(config), np.arange(float(len(rows["slip"]))), values)


@pytest.mark.parametrize("missing", [(), ("torque", "sinkage"), ("drawbar_pull", "torque")], ids=str)
def test_estimates_from_twenty_rows_cover_the_truth(missing):
    """Two standard deviations hold the truth in 95 of 100 cases."""
    the_rig, model, prior = rig_of(rig()), model_of(rig()), prior_of(rig())
    drawn = drawn_windows(np.random.default_rng(3), (1000.0, 2000.0), np.linspace(0.02, 0.6, 10), missing)
    deviations = []
    for truth, window in islice(drawn, 25):
        fit = fit_window(ObservationModel(window, the_rig, model, min_speed=0.0), prior)
        told = fit.posterior.bearing_pressure(0.02, WIDTH), fit.posterior.tan_phi()
        true = truth.bearing_pressure(0.02, WIDTH), np.tan(truth.phi)
        deviations.append([np.log(x / e.value) * e.value / e.std for x, e in zip(true, told, strict=True)])
    inside = np.abs(deviations) < 2.0
    assert (inside.mean(0) >= 0.84).all()  # 21 of 25: less has a chance of 0.2 % at 95 %
    assert (np.std(deviations, axis=0) > 0.5).all()  # and the intervals are no wider than need be


def test_six_rows_with_nothing_missing_show_no_gap():
    """What four rows leave open of the soil is no gap: the reduced chi-square of the two others is 1 on average."""
    the_rig, model, prior = rig_of(rig()), model_of(rig()), prior_of(rig())
    drawn = drawn_windows(np.random.default_rng(7), (1500.0,), (0.0, 0.1, 0.2, 0.3, 0.4, 0.6))
    gaps = [
        fit_model([record_of_rows("", window, the_rig, model)], prior, ()).held_out_chi2
        for _, window in islice(drawn, 25)
    ]
    assert np.mean(gaps) == pytest.approx(1.0, abs=0.35)  # 25 times 6 residuals: sd 0.12, and the model is not linear
    assert np.mean(np.array(gaps) > gap_limit(6)) <= 0.08


def test_a_table_of_few_rows_learns_from_two_thirds_spread_over_all_slips(tmp_path, measured):
    first = {k: v[:7] for k, v in measured.items()}
    recordings = recordings_of_tables(rig(), [write_csv(tmp_path / "t.csv", first)])
    (record,) = recordings.records
    assert (record.training.n, record.held_out.n, recordings.too_short) == (5, 2, ())
    assert (
        record.training.slip.min()
        < record.held_out.slip.min()
        <= record.held_out.slip.max()
        < record.training.slip.max()
    )
    with pytest.raises(TooLittle, match="4 usable rows are too few"):
        recordings_of_tables(rig(), [write_csv(tmp_path / "s.csv", {k: v[:4] for k, v in measured.items()})])


def test_effects_that_a_table_cannot_tell_are_no_candidates(tmp_path, measured):
    path = write_csv(tmp_path / "t.csv", measured | {"s": np.arange(len(measured["slip"]))})
    records = recordings_of_tables(rig(), [path]).records
    names = {effect.name for effect in candidates(rig(), records)}
    assert set(CATALOGUE) - names == {
        "rate_stiffening", "inertia", "torque_lag", "channel_lag", "soil_drift", "grade", "multipass",
    }  # fmt: skip
    names = {effect.name for effect in candidates(rig(t="s"), records)}
    assert set(CATALOGUE) - names == {"rate_stiffening", "inertia", "multipass"}


def test_priors_of_effects_grow_with_the_wheel_and_only_where_they_have_its_unit():
    def std(effect: Effect) -> list[float]:
        return [p.std for p in effect.parameters]

    for name, factors in (
        ("draft_offset", (2.0, 2.0, 1.0)), ("slip_sinkage", (1.0, 1.0, 3.0)), ("tyre_deflection", (1.5, 1.0)),
    ):  # fmt: skip
        effect = CATALOGUE[name]
        larger = for_wheel(effect, 2.0 * LOAD, 3.0 * RADIUS)
        assert std(larger) == pytest.approx([f * s for f, s in zip(factors, std(effect), strict=True)])
        assert larger.parameters[0].high == pytest.approx(factors[0] * effect.parameters[0].high)
    depth = for_wheel(CATALOGUE["hardpan"], LOAD, 0.1 * RADIUS).parameters[1]
    assert depth.starts[0] == pytest.approx(0.1 * CATALOGUE["hardpan"].parameters[1].starts[0])


def test_check_lists_the_columns_and_what_they_tell():
    text = configuration_report(rig(torque=None, slip={"column": "slip_percent", "factor": 0.01}))
    assert re.search(r"slip +slip_percent +0\.01", text)
    assert re.search(r"K +yes: drawbar pull over varied slip", text)
    only_depth = configuration_report(rig(torque=None, drawbar_pull=None))
    assert re.search(r"phi +no: needs torque or drawbar pull", only_depth)
    assert re.search(r"n +yes: sinkage", only_depth)


def test_the_command_line_takes_tables_and_answers_faults_in_one_line(tmp_path, measured, capsys):
    table = write_csv(tmp_path / "t.csv", measured)
    config = tmp_path / "rig.toml"
    config.write_text(RIG)
    arguments = ["diagnose", "--config", str(config), str(table)]
    assert main([*arguments, "--json", "-"]) == 0
    findings = json.loads(capsys.readouterr().out)
    assert findings["verdict"] == "none"
    assert findings["effects"] == []
    assert findings["gap"]["before"] < gap_limit(18)
    for change, code, complaint in (
        ("table.torque=twist", 1, "no column twist"),
        ("table.torque.factor=0", 2, "factor of 0"),
        ("table.where={x=[1]}", 2, "x must be a text or a number"),
    ):
        assert main([*arguments, "--set", change]) == code
        error = capsys.readouterr().err
        assert complaint in error
        assert error.count("\n") == 1


@pytest.mark.parametrize("quieter", [5.0, 20.0, 40.0])
def test_nothing_is_known_less_than_beforehand_however_badly_the_model_fits(quieter, tmp_path):
    """With noise set too low the widened k_c was 7e3 +- 7e21, then no number at all: a traceback of replay --json."""
    raw = tomllib.loads(RIG)
    raw["noise"] = {
        channel: {kind: sd if kind == "gain" else sd / quieter for kind, sd in noise.items()}
        for channel, noise in raw["noise"].items()
    }
    config, degraded = parse_config(raw), 0
    prior = prior_of(config)
    beforehand = Posterior(Soil(*prior.median.tolist()), np.diag(prior.log_std**2)).parameters()
    soils = (
        TRUTH,
        Soil(5e3, 6e5, 0.5, 0.4, 4e3, 0.03),
        Soil(1e3, 3e6, 1.1, 0.6, 500.0, 0.01),
        Soil(2e3, 1.2e6, 0.8, 0.45, 1500.0, 0.02),
    )
    for seed, truth in enumerate(soils):
        path = write_csv(tmp_path / "t.csv", noisy(sweep(truth, LOADS, SLIPS), np.random.default_rng(seed)))
        (result,) = replay_tables(config, [path])
        window = json.loads(json_line(result, config), parse_constant=pytest.fail)
        if window["soil"] is None:
            continue
        degraded += window["status"] == "degraded"
        assert window["chi2"] > 3.0
        for name, known in window["soil"].items():
            least = beforehand[name].std / beforehand[name].value
            assert 0.0 <= known["std"] / known["value"] <= least * (1.0 + 1e-9), (name, known)
    assert degraded


def test_a_rigid_wheel_has_no_effect_of_a_tyre(tmp_path, measured):
    path = write_csv(tmp_path / "t.csv", measured)
    raw = tomllib.loads(RIG)
    rigid = parse_config(raw | {"wheel": [raw["wheel"][0] | {"tyre": "rigid"}]})
    names = [{e.name for e in candidates(c, recordings_of_tables(c, [path]).records)} for c in (rig(), rigid)]
    assert names[0] - names[1] == {"tyre_deflection", "rolling_radius"}
    assert names[1] < names[0]
    with pytest.raises(ConfigError, match=r"tyre_deflection is of a tyre, and every wheel is said to be rigid"):
        with_effects(rigid, ["tyre_deflection=1e-6"])
    assert "tyre" in fault({"wheel": [raw["wheel"][0] | {"tyre": "wooden"}]})
