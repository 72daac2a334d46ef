"""Windows as rows of CSV and Parquet: the numbers of the JSON lines, under the paths to them."""

import csv
import json
import tomllib
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import soilbus
from soilbus.cli.main import main
from soilbus.export.columns import column
from soilbus.export.table import write_table
from soilbus.pipeline.outputs import flat_record, json_line
from soilbus.simulator.reference import TRACTOR


@pytest.fixture
def lines(windows, config) -> list[dict]:
    return [json.loads(json_line(window, config)) for window in windows]


def test_a_csv_row_holds_the_numbers_of_its_json_line(windows, config, lines, tmp_path):
    write_table(tmp_path / "windows.csv", windows, config)
    with (tmp_path / "windows.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(lines) == 5
    for row, line in zip(rows, lines, strict=True):
        assert float(row["t"]) == line["t"]
        assert row["status"] == line["status"]
        assert row["traversability.state"] == line["traversability"]["state"]
    assert float(rows[0]["soil.phi.std"]) == lines[0]["soil"]["phi"]["std"]
    assert float(rows[0]["slip.RR"]) == lines[0]["slip"]["RR"]


def test_what_is_not_known_is_an_empty_cell_and_null(windows, config, tmp_path):
    for name in ("w.csv", "w.parquet"):
        write_table(tmp_path / name, windows, config)
    *_, last = csv.DictReader((tmp_path / "w.csv").open(newline=""))
    assert {last[name] for name in ("soil.phi.value", "slip.FL", "chi2", "traversability.probability")} == {""}
    row = pq.read_table(tmp_path / "w.parquet").to_pylist()[-1]
    assert row["soil.phi.value"] is row["slip.FL"] is row["chi2"] is row["traversability.probability"] is None


def test_a_part_that_no_window_has_is_no_column(windows, config, tmp_path):
    for name in ("w.csv", "w.parquet"):
        write_table(tmp_path / name, windows[-1:], config)
    columns = pq.read_schema(tmp_path / "w.parquet").names
    assert columns == next(csv.reader((tmp_path / "w.csv").open(newline="")))
    assert "soil" not in columns
    assert {"chi2", "traversability.state"} <= set(columns)


def test_parquet_has_types_units_and_versions(windows, config, lines, tmp_path):
    write_table(tmp_path / "w.parquet", windows, config)
    table = pq.read_table(tmp_path / "w.parquet")
    assert table.schema.metadata[b"soilbus_version"] == soilbus.__version__.encode()
    assert table.schema.metadata[b"soilbus_schema"]
    types = {field.name: field.type for field in table.schema}
    assert (types["window"], types["state"], types["search_ended"]) == (pa.int64(), pa.string(), pa.bool_())
    assert types["traversability.contradicted"] == pa.string()  # also where all are null
    units = {
        "soil.k_phi.value": b"N/m^(n+2)", "soil.phi.std": b"rad", "bearing_pressure.value": b"Pa", "sinkage.FL": b"m",
        "traversability.torque_required": b"N m", "capability.over_slip.pull_std.3": b"N", "slip.RL": b"1",
    }  # fmt: skip
    assert {name: table.schema.field(name).metadata[b"unit"] for name in units} == units
    assert table.column("bearing_pressure.value").to_pylist()[:4] == [
        line["bearing_pressure"]["value"] for line in lines[:4]
    ]


def test_every_key_of_a_record_has_a_kind_that_is_that_of_its_value(lines):
    kinds = {"text": str, "number": float | int, "integer": int, "truth": bool}
    rows = [flat_record(line) for line in lines]
    for key, value in (item for row in rows for item in row.items() if item[1] is not None):
        found = column(key)
        assert found is not None, key
        assert isinstance(value, kinds[found.kind]), key
        assert bool(found.unit) == (found.kind in ("number", "integer")), key


def test_another_ending_is_a_wrong_usage(capsys):
    with pytest.raises(SystemExit) as ending:
        main(["replay", "--config", "f.toml", "a.log", "--table", "out.xlsx"])
    assert ending.value.code == 2
    assert "out.xlsx does not end in .csv or .parquet" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "name", "extra"),
    [("--table", "w.parquet", "tables"), ("--mcap", "w.mcap", "mcap"), ("--map", "w.gpkg", "geo")],
)
def test_a_missing_extra_is_named_before_the_work(option, name, extra, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda module: None)
    assert main(["replay", "--config", str(TRACTOR), "no.log", option, str(tmp_path / name)]) == 1
    assert capsys.readouterr().err.endswith(f" needs the extra soilbus[{extra}]\n")
    extras = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert extra in extras["optional-dependencies"]
