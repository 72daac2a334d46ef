"""Tables of decoded signals: the same windows as the log that they were decoded from, by an independent decoder."""

import re
from pathlib import Path

import can
import cantools
import numpy as np
import pandas as pd
import pytest

import soilbus
from soilbus.can.columns import unit_in
from soilbus.cli.main import main
from soilbus.config.file import load_config, machine, shipped_dbc
from soilbus.simulator.reference import TRACTOR

MACHINE = machine("tractor")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A drive as a log, the same decoded by cantools as a table, and configurations of both."""
    folder = tmp_path_factory.mktemp("table")
    soilbus.simulate(folder / "drive.log", TRACTOR, soil="loam", duration=13.0)
    text = MACHINE.read_text()
    database = cantools.database.Database()
    for name in load_config(MACHINE).dbc.input:
        database.add_dbc_file(shipped_dbc(name))
    names = {}
    for message, signal in re.findall(r'"(\w+)\.(\w+)"', text):
        try:
            unit = database.get_message_by_name(message).get_signal_by_name(signal).unit
        except KeyError:
            continue
        names[message, signal] = f"{message} {signal} [{unit}]"
    rows = []
    for frame in can.LogReader(folder / "drive.log"):
        message = database.get_message_by_frame_id(frame.arbitration_id)
        values = message.decode(frame.data, decode_choices=False)
        own = {names[message.name, s]: v for s, v in values.items() if (message.name, s) in names}
        if own:
            rows.append({"time [s]": frame.timestamp, **own})
    pd.DataFrame(rows).to_csv(folder / "drive.csv", index=False)
    for (message, signal), column in names.items():
        text = text.replace(f'"{message}.{signal}"', f'"{column}"')
    text = text.replace("[dbc]", '[columns]\ntime = "time [s]"')
    text = re.sub(r"valid = \"[^\"]*\",? ?|(?m:^input = .*$)", "", text)
    (folder / "table.toml").write_text(text)
    return folder


@pytest.fixture(scope="module")
def expected(folder) -> pd.DataFrame:
    return soilbus.replay(folder / "drive.log", TRACTOR).drop(columns="log")


def windows(table: object, folder: Path) -> pd.DataFrame:
    return soilbus.replay(table, folder / "table.toml").drop(columns="log")


@pytest.mark.parametrize("form", ["csv", "parquet", "frame", "semicolons"])
def test_a_table_gives_the_windows_of_its_log(form, folder, expected):
    frame = pd.read_csv(folder / "drive.csv")
    table: object = folder / f"{form}.csv"
    if form == "parquet":
        frame.to_parquet(table := folder / "drive.parquet")
    elif form == "frame":
        table = frame
    elif form == "semicolons":
        frame.to_csv(table, sep=";", decimal=",", index=False)
    else:
        table = folder / "drive.csv"
    pd.testing.assert_frame_equal(windows(table, folder), expected, check_exact=True)


def test_what_is_no_number_is_refused_and_counted_and_the_rest_is_used(folder, tmp_path, capsys):
    frame = pd.read_csv(folder / "drive.csv").astype(object)
    column = next(name for name in frame.columns if "Draft" in name)
    where = frame[column].first_valid_index()
    frame.loc[where, column] = "#DIV/0!"
    frame.to_csv(tmp_path / "dirty.csv", index=False)
    assert main(["replay", "--config", str(folder / "table.toml"), str(tmp_path / "dirty.csv")]) == 0
    assert "refused samples not_finite 1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda frame: frame.rename(columns={"time [s]": "when"}), "no column time [s]"),
        (lambda frame: frame.iloc[:, :3], "no column"),
        (lambda frame: frame.assign(**{"time [s]": "soon"}), "holds no time"),
        (lambda frame: frame.iloc[:0], "no value in it"),
        (lambda frame: frame.iloc[::-1], "goes backwards"),
        (lambda frame: frame.sample(frac=1.0, random_state=1), "goes backwards"),
    ],
)
def test_a_table_that_cannot_be_used_is_one_line(change, complaint, folder, tmp_path, capsys):
    change(pd.read_csv(folder / "drive.csv")).to_csv(tmp_path / "t.csv", index=False)
    assert main(["replay", "--config", str(folder / "table.toml"), str(tmp_path / "t.csv")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert complaint in line


@pytest.mark.parametrize(("unit", "seconds"), [("ms", 1e-3), ("min", 60.0)])
def test_the_unit_of_the_times_ends_the_name_of_their_column(unit, seconds, folder, expected, tmp_path):
    frame = pd.read_csv(folder / "drive.csv")
    frame = frame.rename(columns={"time [s]": f"time [{unit}]"})
    frame[f"time [{unit}]"] = (frame[f"time [{unit}]"] - frame[f"time [{unit}]"].iloc[0]) / seconds
    text = (folder / "table.toml").read_text().replace("time [s]", f"time [{unit}]")
    (tmp_path / "table.toml").write_text(text)
    got = windows(frame, tmp_path)
    assert got["status"].tolist() == expected["status"].tolist()
    np.testing.assert_allclose(got["t"], expected["t"] - expected["t"].iloc[0] + got["t"].iloc[0], atol=1e-3)


def test_times_may_be_dates(folder, expected, tmp_path):
    frame = pd.read_csv(folder / "drive.csv")
    dates = frame.assign(**{"time [s]": pd.to_datetime(frame["time [s]"], unit="s").astype(str)})
    got = windows(dates, folder)
    assert got["status"].tolist() == expected["status"].tolist()
    np.testing.assert_allclose(got["t"], expected["t"], atol=1e-3)


def test_a_table_has_no_bus_and_a_log_needs_its_dbc(folder, capsys):
    assert main(["run", "--config", str(folder / "table.toml")]) == 2
    assert main(["replay", "--config", str(folder / "table.toml"), str(folder / "drive.log")]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert "has no bus" in first
    assert "not a table" in second


def test_init_proposes_the_mapping_and_asks_for_units_that_no_name_says(folder, tmp_path, capsys):
    assert main(["init", "--table", str(folder / "drive.csv")]) == 0
    text = capsys.readouterr().out
    assert 'time = "time [s]"' in text
    assert re.search(r'(?m)^speed = "\w+ FL \[', text)
    frame = pd.read_csv(folder / "drive.csv")
    frame.rename(columns=lambda name: name.partition(" [")[0]).to_csv(tmp_path / "bare.csv", index=False)
    assert main(["init", "--table", str(tmp_path / "bare.csv")]) == 0
    assert re.search(r'(?m)^load = \{signal = "WheelLoads FL", unit = "\?"', capsys.readouterr().out)


def test_init_maps_each_role_that_the_library_writes_by_its_own_name(folder, tmp_path, capsys):
    table = soilbus.signals(folder / "drive.log", TRACTOR)
    table.to_csv(tmp_path / "own.csv")
    assert main(["init", "--table", str(tmp_path / "own.csv")]) == 0
    mapped = set(re.findall(r'(?m)^[^#\n]*"(\S+ \[[^"]*\])"', capsys.readouterr().out))
    assert {*table.columns, table.index.name} - mapped == set()


def test_check_compares_a_table_with_the_configuration(folder, capsys):
    assert main(["check", "--config", str(folder / "table.toml"), "--log", str(folder / "drive.csv")]) == 0
    out = capsys.readouterr().out
    assert out.index("mapped columns:") < out.index("beside the configuration") < out.index("factor to SI")


@pytest.mark.parametrize(
    ("name", "unit"),
    [("a [1/min]", "1/min"), ("draft_kN", "kN"), ("torque_R", ""), ("Zug (N)", "N"), ("v km/h", "km/h"), ("t", "")],
)
def test_the_unit_ends_a_name(name, unit):
    assert unit_in(name) == unit
