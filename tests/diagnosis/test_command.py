"""`soilbus diagnose` as a user types it: an effect hidden in a log is found, named, added, and the daemon knows it."""

import json
import math
import re
import shutil
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from soilbus.can.dbc_files import load_databases
from soilbus.cli.main import main
from soilbus.config.file import load_config, shipped_dbc
from soilbus.simulator.reference import TRACTOR

SOIL_KEYS = {"k_c", "k_phi", "n", "phi", "c", "K", "bearing_pressure"}
TRUE_PRESSURE = (5300.0 / 0.3 + 1.515e6) * 0.02**0.7
"""Of the simulator's loam, under the reference plate [Pa]."""
HIDDEN = {"stiffness": 0.5, "density": 0.05}


class Diagnosed(NamedTuple):
    log: Path
    config: Path
    found: dict[str, Any]
    text: str
    model: Path


def simulated(log: Path, seed: int, *more: str, seconds: int = 60) -> Path:
    effects = [f"--effect=multipass.{name}={value}" for name, value in HIDDEN.items()]
    command = ["simulate", "--duration", str(seconds), "--seed", str(seed), "--log", str(log), *effects, *more]
    assert main(command) == 0
    return log


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory) -> Diagnosed:
    """A recording in which rear wheels run in compacted ruts, under a configuration of its own with its own DBC."""
    folder = tmp_path_factory.mktemp("vehicle")
    (folder / "elsewhere").mkdir()
    shutil.copy(shipped_dbc("tractor.dbc"), folder / "mine.dbc")
    config = folder / "mine.toml"
    config.write_text(TRACTOR.read_text().replace('"tractor.dbc"', '"mine.dbc"') + "\n[soil.n]\nstd = 0.3 # my guess\n")
    log = simulated(folder / "ruts.log", 5)
    out, model = folder / "out.json", folder / "elsewhere/completed.toml"
    words = ["diagnose", "--config", config, log, "--json", out, "--model-out", model, "--set", "soil.c.value=2900.0"]
    with redirect_stdout(StringIO()) as said, redirect_stderr(StringIO()) as faults:
        code = main([str(word) for word in words])
    assert (code, faults.getvalue()) == (0, "")
    return Diagnosed(log, config, json.loads(out.read_text()), said.getvalue(), model)


def deviations(pressure: dict[str, float]) -> float:
    return abs(pressure["value"] - TRUE_PRESSURE) / pressure["std"]


def test_the_hidden_effect_is_named_and_the_gap_closes(diagnosed):
    found = diagnosed.found
    assert found["verdict"] == "named"
    assert [effect["name"] for effect in found["effects"]] == ["multipass"]
    effect = found["effects"][0]
    assert effect["probability"] > 0.95
    for name, reported in effect["parameters"].items():
        assert abs(reported["value"] - HIDDEN.get(name, 0.0)) < 3.0 * reported["std"] < 0.2
    assert found["gap"]["before"] > found["gap"]["limit"] > found["gap"]["after"]
    assert found["gap"]["noise_floor"] == 1.0
    assert (
        deviations(found["soil_before"]["bearing_pressure"]) > 3.0 > deviations(found["soil_after"]["bearing_pressure"])
    )


def test_json_has_the_keys_of_the_design(diagnosed):
    found = diagnosed.found
    assert {"verdict", "where", "effects", "gap", "soil_before", "soil_after", "soils"} <= found.keys()
    for place in found["where"]:
        assert place.keys() == {"channel", "wheel", "region", "size", "significance", "log"}
        assert place["log"] == ("" if place["region"] == "gain" else "ruts.log")
        assert 0.0 <= place["significance"] <= 0.01
    for soil in (found["soil_before"], found["soil_after"]):
        assert soil.keys() == SOIL_KEYS
        assert all(math.isfinite(v) for reported in soil.values() for v in reported.values())
    assert [soil["log"] for soil in found["soils"]] == ["ruts.log"]
    assert found["soils"][0]["after"] == found["soil_after"]
    assert found["rejected"] == {}


def test_text_has_verdict_effect_physics_and_soil(diagnosed):
    text = diagnosed.text
    assert text.startswith("named: ")
    assert "1. multipass, probability 1.00" in text
    assert "Rear wheels run in ruts" in text
    before, after = (diagnosed.found["gap"][key] for key in ("before", "after"))
    assert f"gap {before:.3f} -> {after:.3f}" in text
    reported = diagnosed.found["soil_after"]["bearing_pressure"]["value"] / 1e3
    assert re.search(rf"bearing pressure, kPa .* {reported:.4g} \+-", text)


def test_model_out_is_the_configuration_with_the_effect(diagnosed):
    completed, given = load_config(diagnosed.model), load_config(diagnosed.config, ["soil.c.value=2900.0"])
    assert [effect.name for effect in completed.model.effects] == ["multipass"]
    assert completed.soil_prior == given.soil_prior
    left = {"model", "dbc"}
    assert completed.model_dump(exclude=left) == given.model_dump(exclude=left)
    assert "std = 0.3 # my guess" in diagnosed.model.read_text()
    names = {message.name for message in load_databases(completed).messages}
    assert names == {message.name for message in load_databases(given).messages}
    reported = diagnosed.found["effects"][0]["parameters"]
    for name, value in (completed.model.effects[0].model_extra or {}).items():
        assert value == pytest.approx(reported[name], rel=1e-5)


def test_check_says_what_is_estimated(diagnosed, capsys):
    assert main(["check", "--config", str(diagnosed.model)]) == 0
    assert "multipass: estimated: stiffness, density, shear, reloading\n" in capsys.readouterr().out


def test_replay_knows_its_sensors_by_the_completed_model_and_blames_them_by_the_plain_one(diagnosed, tmp_path):
    """The simulator's sensors are as noisy as configured; both intervals of the pressure hold."""

    def windows(config: Path) -> list[dict[str, Any]]:
        out = tmp_path / "windows.jsonl"
        outputs = ["--json", str(out), "--set", "estimator.hop=2"]
        assert main(["replay", "--config", str(config), str(diagnosed.log), *outputs]) == 0
        return [json.loads(line) for line in out.read_text().splitlines()]

    def factors(windows: list[dict[str, Any]]) -> list[float]:
        return [float(np.median([w["noise_factors"][kind] for w in windows])) for kind in windows[0]["noise_factors"]]

    plain, completed = windows(diagnosed.config), windows(diagnosed.model)
    assert len(plain) == len(completed) == 25
    assert max(factors(plain)) > 4.0
    assert all(0.7 < factor < 1.2 for factor in factors(completed))  # less: the fit takes some
    assert [window["status"] for window in completed] == ["valid"] * 25
    chi2 = [window["chi2"] for window in completed]
    assert 0.9 < sum(chi2) / 25 < 1.05
    for window in plain + completed:
        assert window["status"] != "valid" or deviations(window["bearing_pressure"]) < 1.96


def test_simulate_drives_with_the_completed_model(diagnosed, tmp_path):
    completed, plain = tmp_path / "a.log", tmp_path / "b.log"
    for config, log in ((diagnosed.model, completed), (diagnosed.config, plain)):
        assert main(["simulate", "--config", str(config), "--duration", "2", "--log", str(log)]) == 0
    assert completed.read_text() != plain.read_text()


def test_nothing_is_missing_under_the_completed_model_on_other_ground(diagnosed, tmp_path, capsys):
    logs = [simulated(tmp_path / f"{soil}.log", 9, "--soil", soil, seconds=40) for soil in ("wet_clay", "loam")]
    capsys.readouterr()
    assert main(["diagnose", "--config", str(diagnosed.model), *map(str, logs), "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "none"
    assert found["effects"] == []
    assert found["gap"]["before"] == found["gap"]["after"] < found["gap"]["limit"]
    clay, loam = found["soils"]
    assert (clay["log"], loam["log"]) == ("wet_clay.log", "loam.log")
    assert clay["after"] == found["soil_after"]
    assert deviations(loam["after"]["bearing_pressure"]) < 3.0 < deviations(clay["after"]["bearing_pressure"])
    assert abs(found["model"]["multipass"]["stiffness"]["value"] - 0.5) < 0.05


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda log: log[: len(log) // 2 - 20], "cut off or damaged after"),
        (lambda log: "".join(log.splitlines(keepends=True)[:1500]), "usable instants are too few"),
        (lambda log: re.sub(r" can0 \w+#", " can0 123#", log), "a log of another bus?"),
        (lambda log: "", "no frame in it"),
    ],
    ids=["cut", "short", "other bus", "empty"],
)
def test_logs_that_cannot_be_used_give_one_line_and_no_files(diagnosed, tmp_path, capsys, change, message):
    log, out = tmp_path / "bad.log", tmp_path / "out"
    out.mkdir()
    log.write_text(change(diagnosed.log.read_text()))
    capsys.readouterr()
    outputs = ["--json", str(out / "a"), "--report", str(out / "b"), "--model-out", str(out / "c")]
    assert main(["diagnose", "--config", str(diagnosed.config), str(log), *outputs]) == 1
    reported = capsys.readouterr()
    assert reported.out == ""
    assert len(reported.err.splitlines()) == 1
    assert message in reported.err
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--set", "model.effect=[]"], 2, "model.effect: unknown key"),
        (["--set", 'model.effects=[{name="cheese"}]'], 2, "no effect is named cheese"),
        (["--set", 'model.effects=[{name="multipass",stiffness={value=0.5,std=-1}}]'], 2, "std -1 is less than 0"),
        (["--json", "/nonexistent/out.json"], 1, "/nonexistent/out.json: no folder /nonexistent"),
        (["--model-out", "/nonexistent/out.toml"], 1, "no folder"),
    ],
)
def test_mistakes_are_reported_before_any_work(diagnosed, capsys, arguments, code, message):
    assert main(["diagnose", "--config", str(diagnosed.config), str(diagnosed.log), *arguments]) == code
    reported = capsys.readouterr()
    assert reported.out == ""
    assert len(reported.err.splitlines()) == 1
    assert message in reported.err


def test_where_no_drive_is_needed_the_other_outputs_are_written_all_the_same(tmp_path, capsys):
    log = simulated(tmp_path / "short.log", 3, seconds=24)
    out, drive = tmp_path / "out.json", tmp_path / "drive.json"
    capsys.readouterr()
    assert main(["diagnose", "--config", "tractor", str(log), "--json", str(out), "--manoeuvre-out", str(drive)]) == 1
    assert json.loads(out.read_text())["verdict"] == "named"
    text, error = capsys.readouterr()
    assert text.startswith("named: ")
    assert error.splitlines()[-1].startswith("soilbus: --manoeuvre-out: no names are left")
    assert not drive.exists()
