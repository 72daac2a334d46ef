"""From a bare DBC and a log to valid windows: simulate, init, fill in what is open, check, replay."""

import json
import os
import re
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import tomlkit

from soilbus.cli.main import main
from soilbus.config.file import machine, shipped_dbc

HERE = Path(__file__).resolve().parent
LOAM = (5300.0 / 0.3 + 1.515e6) * 0.02**0.7
"""Bearing pressure [Pa] of the simulated soil."""
MACHINES = ("tractor", "tractor-2wd", "tractor-axles")
"""Four motors with load cells; one motor, a differential and a load cell of its axle; no load cell at all."""


@pytest.fixture(scope="module", params=MACHINES)
def drive(request, tmp_path_factory) -> tuple[str, Path]:
    """A machine and the folder of an integrator: the vehicle's DBC files and a log."""
    folder = tmp_path_factory.mktemp("first_hour")
    seconds = "24" if request.param == "tractor-2wd" else "16"
    log = ["--soil", "loam", "--duration", seconds, "--seed", "5", "--log", str(folder / "drive.log")]
    assert main(["simulate", "--config", request.param, *log]) == 0
    raw = tomllib.loads(machine(request.param).read_text())
    for name in raw["dbc"]["input"]:
        shutil.copy(shipped_dbc(name), folder / f"my-{name}")
    return request.param, folder


def open_keys(here: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Paths of the values "?"; wheels and axles by name."""
    if here == "?":
        yield path
    elif isinstance(here, Mapping):
        for key, value in here.items():
            yield from open_keys(value, (*path, key))
    elif isinstance(here, list):
        for item in (item for item in here if isinstance(item, Mapping)):
            yield from open_keys(item, (*path, str(item["name"])))


def at(here: Any, path: tuple[str, ...]) -> Any:
    """The table or value at a path."""
    for key in path:
        here = next(i for i in here if i["name"] == key) if isinstance(here, list) else here[key]
    return here


def filled(text: str, truth: Mapping[str, Any]) -> str:
    """The text with each open value replaced as the vehicle's data sheet says."""
    document = tomlkit.parse(text)
    defaults = {"driven": True, "kind": "kinematic"}
    for path in list(open_keys(document.unwrap())):
        if path[-1] == "name":
            continue
        try:
            value = at(truth, path)
        except (KeyError, TypeError):
            value = defaults[path[-1]]
        at(document, path[:-1])[path[-1]] = value
    return tomlkit.dumps(document)


def test_a_bare_dbc_and_a_log_lead_to_valid_windows(drive, monkeypatch, capsys):
    name, folder = drive
    truth = tomllib.loads(machine(name).read_text())
    monkeypatch.chdir(folder)
    dbcs = [word for path in sorted(folder.glob("*.dbc")) for word in ("--dbc", path.name)]
    assert main(["init", *dbcs, "--log", "drive.log", "-o", "soilbus.toml"]) == 0
    text = Path("soilbus.toml").read_text()
    left = [".".join(path) for path in open_keys(tomllib.loads(text))]
    assert len(left) >= 12  # mass, wheelbase, centre of gravity, and of each wheel radius and width
    capsys.readouterr()

    assert main(["check"]) == 2
    faults = capsys.readouterr().err.splitlines()
    assert [re.sub(r".*soilbus.toml: (\S+): still open.*", r"\1", line) for line in faults] == left

    Path("soilbus.toml").write_text(filled(text, truth))
    assert main(["check", "--log", "drive.log"]) == 0
    shown = capsys.readouterr().out
    assert "plausible" in shown
    assert main(["replay", "drive.log", "--json", "windows.jsonl"]) == 0
    windows = [json.loads(line) for line in Path("windows.jsonl").read_text().splitlines()]
    valid = [w for w in windows if w["status"] == "valid"]
    assert len(valid) >= 3
    pressure = valid[-1]["bearing_pressure"]
    assert abs(pressure["value"] - LOAM) < 4.0 * pressure["std"]


def test_the_roles_of_a_log_are_those_of_the_machine(drive, tmp_path):
    name, folder = drive
    dbcs = [word for path in sorted(folder.glob("*.dbc")) for word in ("--dbc", str(path))]
    assert main(["init", *dbcs, "--log", str(folder / "drive.log"), "-o", str(tmp_path / "a.toml")]) == 0
    truth, found = (tomllib.loads(p.read_text()) for p in (machine(name), tmp_path / "a.toml"))
    assert [axle["name"] for axle in found.get("axle", [])] == [axle["name"] for axle in truth.get("axle", [])]
    for wheel in truth["wheel"]:
        own = at(found, ("wheel", wheel["name"]))
        for role in ("torque", "speed", "load", "sinkage"):
            assert own.get(role) == wheel.get(role)
    for axle in truth.get("axle", []):
        own = at(found, ("axle", axle["name"]))
        assert [own.get(role) for role in ("torque", "load")] == [axle.get(role) for role in ("torque", "load")]
        assert own["gear_ratio"] == pytest.approx(axle["gear_ratio"], rel=0.004)  # two speeds of 0.15 % gain error each
    text = (tmp_path / "a.toml").read_text()
    if (sum_of_loads := re.search(r"loads sum to (\d+) kg", text)) is not None:
        assert float(sum_of_loads[1]) == pytest.approx(truth["vehicle"]["mass"], rel=0.02)


@pytest.mark.parametrize("name", ["orchard", "hubs"])
def test_a_filled_proposal_of_another_maker_is_a_configuration(name, tmp_path, capsys):
    path = tmp_path / "soilbus.toml"
    assert main(["init", "--dbc", str(HERE / f"{name}.dbc"), "-o", str(path)]) == 0
    vehicle = {"mass": 3000.0, "wheelbase": 2.0, "cg_ahead_of_rear_axle": 0.9, "cg_height": 0.8, "hitch_height": 0.4}
    wheel = {"radius": 0.6, "width": 0.3, "gear_ratio": 20.0, "driven": True}
    sheet = {
        "vehicle": vehicle,
        "wheel": [{"name": wheel_name, **wheel} for wheel_name in ("FL", "FR", "RL", "RR")],
        "axle": [{"name": "?", "gear_ratio": 20.0, "differential": "open"}],
    }
    text = filled(path.read_text(), sheet).replace('name = "?"', 'name = "both"')
    path.write_text(text)
    capsys.readouterr()
    assert main(["check", "--config", str(path)]) == 0
    out, err = capsys.readouterr()
    assert "ok" in out
    assert [line for line in err.splitlines() if "warning" not in line] == []


def test_a_file_that_is_there_is_not_overwritten_unasked(tmp_path, capsys):
    path = tmp_path / "soilbus.toml"
    path.write_text("mine")
    words = ["init", "--dbc", str(shipped_dbc("tractor.dbc")), "-o", str(path)]
    assert main(words) == 1
    assert "--force" in capsys.readouterr().err
    assert path.read_text() == "mine"
    assert main([*words, "--force"]) == 0
    assert "[vehicle]" in path.read_text()


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["--dbc", "nowhere.dbc"], 2, "--dbc: "),
        (["--dbc", "drive.log"], 2, "not a DBC"),
        (["--dbc", "my.dbc", "--log", "nowhere.log"], 1, "no such file"),
        (["--dbc", "my.dbc", "--log", "drive.log"], 1, "no frame of a signal"),
        (["--dbc", "my.dbc", "-o", "no/folder/a.toml"], 1, "no folder"),
    ],
)
def test_what_cannot_be_read_or_written_is_one_line(words, code, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copy(shipped_dbc("tractor.dbc"), "my.dbc")
    Path("drive.log").write_text("(1700000000.000000) can0 123#00\n")
    assert main(["init", *words]) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line


@pytest.mark.parametrize("command", [["check"], ["replay", "a.log"], ["diagnose", "a.log"], ["run"]])
def test_without_a_configuration_one_line_says_how_to_get_one(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(command) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "soilbus init --dbc" in line


def test_a_reference_machine_is_a_word_unless_a_file_has_that_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["check", "--config", "tractor-axles"]) == 0
    assert "MotorFront.ShaftTorque" in capsys.readouterr().out
    assert main(["check", "--config", "traktor"]) == 2
    assert "tractor-2wd" in capsys.readouterr().err
    Path("tractor-axles").write_text("mass = 1\n")
    assert main(["check", "--config", "tractor-axles"]) == 2
    assert "mass: unknown key" in capsys.readouterr().err
    assert os.listdir() == ["tractor-axles"]
