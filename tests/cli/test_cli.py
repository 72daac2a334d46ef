"""Commands as a user types them: exit codes, one line for each fault, nothing half-written."""

import errno
import gzip
import itertools
import json
import os
import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import can
import numpy as np
import pytest
from can.interfaces.virtual import VirtualBus

from soilbus.cli.main import main
from soilbus.config.file import load_config
from soilbus.config.model import ConfigError
from soilbus.simulator.reference import TRACTOR

FIELD = Path(__file__).resolve().parents[1] / "field/field.toml"


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("log") / "drive.log"
    assert main(["simulate", "--soil", "loam", "--duration", "14", "--seed", "5", "--log", str(path)]) == 0
    return path


@pytest.fixture
def tractor(tmp_path) -> Path:
    import soilbus.simulator.reference as reference

    return Path(shutil.copy(reference.TRACTOR, tmp_path / "tractor.toml"))


def lines(capsys) -> tuple[list[str], list[str]]:
    out, err = capsys.readouterr()
    return out.splitlines(), err.splitlines()


def only_complaint(capsys) -> str:
    """The one line that a command has said, which is of a fault."""
    printed, err = lines(capsys)
    assert (printed, len(err)) == ([], 1)
    return err[0]


def test_replay_of_a_simulated_drive_finds_the_soil(log, tractor, tmp_path, capsys):
    out = tmp_path / "out.jsonl"
    assert main(["replay", "--config", str(tractor), str(log), "--json", str(out)]) == 0
    windows = [json.loads(line) for line in out.read_text().splitlines()]
    assert len(windows) == 4
    assert [w["status"] for w in windows] == ["valid"] * 4
    truth = (5300.0 / 0.3 + 1.515e6) * 0.02**0.7
    bearing = windows[-1]["bearing_pressure"]
    assert abs(bearing["value"] - truth) < 4.0 * bearing["std"]
    assert "4 windows" in lines(capsys)[0][0]


def test_json_to_stdout_is_nothing_but_json(log, tractor, capsys):
    capsys.readouterr()
    assert main(["replay", "--config", str(tractor), str(log), "--json", "-"]) == 0
    out, err = lines(capsys)
    assert len(out) == 4
    assert all(json.loads(line)["samples"] > 0 for line in out)
    assert err == []


def broken(kind: str, log: Path, to: Path) -> Path:
    data = log.read_bytes()
    contents = {
        "midway.log": data[: len(data) * 9 // 10 + 7],
        "midway.log.gz": gzip.compress(data)[: len(data) // 8],
        "random.blf": np.random.default_rng(1).bytes(4000),
        "words.log": b"the quick brown fox\n",
        "empty.log": b"",
        "other_bus.log": b"".join(b"(1700000000.%06d) can0 7%02X#00\n" % (i, i % 256) for i in range(500)),
    }
    if kind in contents:
        (to / kind).write_bytes(contents[kind])
    return to / kind


@pytest.mark.parametrize(
    "kind",
    ["midway.log", "midway.log.gz", "random.blf", "words.log", "empty.log", "other_bus.log", "missing.log", "what.xyz"],
)
def test_a_bad_log_is_one_line_and_leaves_no_file(kind, log, tractor, tmp_path, capsys):
    out = tmp_path / "out.jsonl"
    path = broken(kind, log, tmp_path)
    capsys.readouterr()
    assert main(["replay", "--config", str(tractor), str(path), "--json", str(out)]) == 1
    said = only_complaint(capsys)
    assert str(path) in said
    assert "Traceback" not in said
    assert [p.name for p in tmp_path.iterdir() if "jsonl" in p.name] == []


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("vehicle.mass={value=2300, sd=20}", ["mass", "unknown key sd"]),
        ("vehicle.towing=never", ["towing = never", "signals.draft"]),
        ("wheel.FL.driven=false", ["wheel FL", "driven = false and a torque"]),
        ('axle=[{name="rear", torque="McuFL.ShaftTorque"}]', ["axle.rear.torque", "wheel.RL.torque"]),
        ('dbc.input=["field.toml"]', ["field.toml", "not a DBC"]),
        ("soil.n.std=-1", ["soil.n.std"]),
        ("noise.sinkage.gain=0.05", ["noise.sinkage", "a fixed gain error of this sensor is not estimated"]),
        ("vehicle.cg_ahead_of_rear_axle=3", ["less than wheelbase"]),
        ("estimator.hop=20", ["bin <= hop <= window"]),
        ("nonsense", ["KEY=VALUE"]),
        ('output.dbc="field.dbc"', ["output.dbc", "no message"]),
    ],
)
def test_a_mistake_in_the_configuration_is_one_clear_line_and_exit_code_2(override, says, capsys):
    assert main(["check", "--config", str(FIELD), "--set", override]) == 2
    printed, err = lines(capsys)
    assert printed == []
    assert all(line.startswith("soilbus: ") for line in err)
    assert any(all(part in line for part in says) for line in err), err


def test_a_byte_order_mark_before_a_configuration_is_no_part_of_it(tmp_path, capsys):
    assert main(["check", "--config", str(TRACTOR)]) == 0
    plain = lines(capsys)
    (tmp_path / "c.toml").write_bytes(b"\xef\xbb\xbf" + TRACTOR.read_bytes())
    assert main(["check", "--config", str(tmp_path / "c.toml")]) == 0
    assert lines(capsys) == plain


@pytest.mark.parametrize("value", ["[" * 2000 + "]" * 2000, "{a=" * 2000 + "1" + "}" * 2000, "9" * 5000])
def test_a_value_that_no_parser_bears_is_one_line_and_exit_code_2(value, tmp_path, capsys):
    (tmp_path / "c.toml").write_text(f"x = {value}\n")
    for words in (["--config", str(tmp_path / "c.toml")], ["--config", str(FIELD), "--set", f"vehicle.mass={value}"]):
        assert main(["check", *words]) == 2
        said = only_complaint(capsys)
        assert len(said) < 250
        assert "too deeply" in said or "too many digits" in said


@pytest.mark.parametrize("kind", ["pipe", "endless", "folder", "large"])
def test_a_dbc_that_is_no_regular_file_is_one_line_and_exit_code_2(kind, tmp_path, capsys):
    name = {"endless": "/dev/zero"}.get(kind, str(tmp_path / kind))
    if kind == "pipe":
        os.mkfifo(name)
    elif kind == "folder":
        os.mkdir(name)
    elif kind == "large":
        with open(name, "wb") as file:
            file.truncate(2**31)
    for key in ("dbc.input", "output.dbc"):
        value = f'["{name}"]' if key == "dbc.input" else f'"{name}"'
        assert main(["check", "--config", str(FIELD), "--set", f"{key}={value}"]) == 2
        said = only_complaint(capsys)
        assert key in said
        assert any(why in said for why in ("not a regular file", "larger than", "directory"))


@pytest.mark.parametrize(
    ("column", "value"), [("ts", None), ("ts", "noon"), ("arbitration_id", None), ("arbitration_id", 1.5)]
)
def test_a_damaged_sqlite_log_is_cut_off_where_it_is_damaged(column, value, log, tractor, tmp_path, capsys):
    path = tmp_path / "drive.db"
    with can.Logger(path) as writer, can.LogReader(log) as reader:
        for message in itertools.islice(reader, 400):
            writer(message)
    with closing(sqlite3.connect(path)) as base, base:
        base.execute(f"UPDATE messages SET {column} = ? WHERE rowid = 300", [value])
    assert main(["replay", "--config", str(tractor), str(path)]) == 1
    assert f"{path}: cut off or damaged after 299 frames" in only_complaint(capsys)


@pytest.mark.parametrize(
    "text", ["[vehicle\n", "\xff\xfe", "[vehicle]\nmass = 1\n[vehicle]\nmass = 2\n", 'wheel = "x"\n', "soil = 3\n"]
)
def test_any_text_as_configuration_gives_faults_not_tracebacks(text, tmp_path, capsys):
    (tmp_path / "c.toml").write_bytes(text.encode("latin-1"))
    assert main(["check", "--config", str(tmp_path / "c.toml")]) == 2
    assert len(lines(capsys)[1]) >= 1


def test_several_faults_are_all_listed(capsys):
    sets = ["--set", "soil.q.std=1", "--set", "estimator.hop=-1", "--set", "vehicle.mass=0"]
    assert main(["check", "--config", str(FIELD), *sets]) == 2
    err = "\n".join(lines(capsys)[1])
    assert all(part in err for part in ("soil.q", "estimator.hop", "vehicle.mass"))


def test_check_lists_every_mapped_signal_with_unit_rate_and_what_can_be_told(tractor, capsys):
    assert main(["check", "--config", str(tractor), "--settings"]) == 0
    out = "\n".join(lines(capsys)[0])
    for part in ("torque.FL", "MotorFL.ShaftTorque", "N.m", "20 ms", "k_phi", "two tyre widths", "estimator.hop = 1.0"):
        assert part in out, part


def test_an_override_of_one_prior_key_keeps_the_other():
    config = load_config(FIELD, ["soil.n.std=0", "soil.c.value=5000"])
    assert (config.soil.n.value, config.soil.n.std) == (0.6, 0.0)
    assert (config.soil.c.value, config.soil.c.std) == (5000.0, 500.0)


def test_the_folder_is_no_key_of_the_file(tmp_path):
    (tmp_path / "c.toml").write_text('folder = "/"\n')
    with pytest.raises(ConfigError, match="folder"):
        load_config(tmp_path / "c.toml")


@pytest.mark.parametrize("interface", ["nosuch", "socketcan"])
def test_a_bus_that_does_not_exist_is_one_line(interface, tractor, capsys):
    settings = ["--set", f"bus.interface={interface}", "--set", "bus.channel=nope7"]
    assert main(["run", "--config", str(tractor), *settings]) == 1
    assert "nope7" in only_complaint(capsys)


def test_simulate_refuses_an_unknown_soil_and_an_unwritable_place(tmp_path, capsys):
    assert main(["simulate", "--soil", "cheese", "--log", str(tmp_path / "x.log")]) == 1
    assert main(["simulate", "--duration", "1", "--log", str(tmp_path / "no/such/x.log")]) == 1
    err = lines(capsys)[1]
    assert len(err) == 2
    assert "cheese" in err[0]
    assert list(tmp_path.iterdir()) == []


def test_usage_errors_exit_with_2(capsys):
    for words in ([], ["fly"], ["replay"], ["simulate"]):
        with pytest.raises(SystemExit) as stop:
            main(words)
        assert stop.value.code == 2


def test_without_a_window_of_use_the_outputs_are_kept_and_one_line_says_why(log, tractor, tmp_path, capsys):
    whole = log.read_text().splitlines(keepends=True)
    (tmp_path / "deaf.log").write_text("".join(line for line in whole if "18FF32C8#" not in line))
    (tmp_path / "short.log").write_text("".join(whole[:3000]))
    capsys.readouterr()
    for name, n, why in (
        ("deaf.log", 4, "no window could be used: 4 of 4 are invalid: input_missing load.FL"),
        ("short.log", 0, "no window could be made: no recording lasts the 10 s of a window"),
    ):
        out = tmp_path / "out.jsonl"
        assert main(["replay", "--config", str(tractor), str(tmp_path / name), "--json", str(out)]) == 1
        printed, err = lines(capsys)
        assert len(out.read_text().splitlines()) == n
        assert printed[1] == f"of use: 0 valid, 0 with a doubtful estimate; of no use: {n}"
        assert len(err) == 1
        assert why in err[0]


def test_deere_logs_never_claim_to_know(field_recording, tmp_path, capsys):
    out = tmp_path / "out.jsonl"
    for name in ("start", "in-gear"):
        log = field_recording(f"deere-5055e-{name}.log.gz")
        assert main(["replay", "--config", str(FIELD.with_name("deere.toml")), str(log), "--json", str(out)]) == 1
        (error,) = lines(capsys)[1]
        assert "no window could be used" in error
        assert "no usable value of ground_speed" in error
        windows = [json.loads(line) for line in out.read_text().splitlines()]
        assert len(windows) > 20
        assert {w["state"] for w in windows} <= {"listening", "degraded"}
        assert {w["traversability"]["state"] for w in windows} == {"unknown"}
        assert windows[0]["rejected"]["not_available"] > 0
        assert all(value is None for w in windows for value in w["slip"].values())


def test_a_bus_that_goes_away_ends_simulate_with_one_line(tractor, capsys, monkeypatch):
    sent = []

    def send(self, message, timeout=None):
        if len(sent) == 20:
            raise can.CanOperationError("Failed to transmit: Network is down", errno.ENETDOWN)
        sent.append(message)

    monkeypatch.setattr(VirtualBus, "send", send)
    settings = ["--set", "bus.interface=virtual", "--set", "bus.channel=gone"]
    assert main(["simulate", "--config", str(tractor), *settings, "--duration", "3", "--bus"]) == 1
    said = only_complaint(capsys)
    assert "virtual:gone" in said
    assert "Network is down" in said


@pytest.mark.parametrize("option", ["--json", "--report", "--frames", "--table"])
def test_replay_asks_for_the_folder_before_the_work(option, tractor, tmp_path, capsys):
    out = tmp_path / "no/such" / {"--frames": "x.log", "--table": "x.csv"}.get(option, "x")
    assert main(["replay", "--config", str(tractor), str(tmp_path / "not-read.log"), option, str(out)]) == 1
    assert lines(capsys) == ([], [f"soilbus: {out}: no folder {out.parent}"])


@pytest.mark.parametrize("suffix", [".odt", ".db", ".mf4", ".txt", ".blf.gz"])
def test_a_log_that_no_writer_can_write_whole_is_refused_before_the_work(suffix, tmp_path, capsys):
    out = tmp_path / f"x{suffix}"
    assert main(["replay", "--config", str(TRACTOR), str(tmp_path / "not-read.log"), "--frames", str(out)]) == 1
    assert main(["simulate", "--log", str(out)]) == 1
    said = f"soilbus: {out}: no format of a log is known by this ending; .log .log.gz .asc .blf are"
    assert lines(capsys) == ([], [said] * 2)
    assert not list(tmp_path.iterdir())


def test_no_output_replaces_what_the_command_reads_or_writes_already(log, tractor, tmp_path, capsys):
    recorded, link = tmp_path / "in.log", tmp_path / "link.log"
    shutil.copy(log, recorded)
    link.symlink_to(recorded)
    before = recorded.read_bytes()
    run = ["replay", "--config", str(tractor), str(recorded)]
    for option, out in (("--json", recorded), ("--frames", link), ("--report", tractor)):
        assert main([*run, option, str(out)]) == 1
        assert lines(capsys)[1] == [f"soilbus: {out} is read by this command: name another file to write"]
    twice = str(tmp_path / "w.csv")
    assert main([*run, "--json", twice, "--table", twice]) == 1
    assert lines(capsys)[1] == [f"soilbus: {twice} is named for two outputs"]
    assert main(["diagnose", "--config", str(tractor), str(recorded), "--json", str(recorded)]) == 1
    assert recorded.read_bytes() == before


def test_a_machine_without_torque_or_without_ground_speed_says_so(log, tractor, tmp_path, capsys):
    text = tractor.read_text()
    for line, missing in ((r"(?m)^torque = .*\n", "wheels"), (r"(?m)^ground_speed = .*\n", "ground_speed")):
        config = tmp_path / f"no-{missing}.toml"
        config.write_text(re.sub(line, "", text, count=0 if missing == "wheels" else 1))
        assert main(["replay", "--config", str(config), str(log)]) == 1
        assert f"invalid: input_missing {missing}" in lines(capsys)[1][-1]


def test_a_manoeuvre_takes_no_other_slope_or_draft(tmp_path, capsys):
    for option in (["--slope", "5"], ["--draft", "100"], ["--speed", "2"]):
        assert main(["simulate", "--manoeuvre", str(tmp_path / "m"), *option, "--log", str(tmp_path / "x.log")]) == 1
        assert "--manoeuvre has its own pull, slopes and speeds" in lines(capsys)[1][0]


def test_a_picture_asks_for_its_folder_before_the_demo(tmp_path, capsys):
    assert main(["demo", "--picture", str(tmp_path / "no/x.svg")]) == 1
    assert lines(capsys) == ([], [f"soilbus: {tmp_path / 'no/x.svg'}: no folder {tmp_path / 'no'}"])


@pytest.mark.parametrize(
    "words",
    [
        "simulate --log x.log --duration nan",
        "simulate --log x.log --duration -5",
        "simulate --log x.log --heading nan",
        "watch --seconds -3",
        "demo --duration nan",
    ],
)
def test_a_number_that_cannot_be_is_wrong_usage(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words.split())
    assert stop.value.code == 2
    assert "is not a number from" in lines(capsys)[1][-1]


@pytest.mark.parametrize(
    "words",
    [
        ["replay", "x.log", "--table", "a.csv", "--table", "b.parquet"],
        ["init", "--dbc", "a.dbc", "--dbc", "b.dbc", "--log", "a.log", "--log", "b.log"],
        ["simulate", "--log", "a.log", "--seed", "1", "--seed", "1"],
    ],
)
def test_an_option_that_may_stand_once_is_not_dropped_where_it_stands_twice(words, capsys):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    assert f"{words[-2]}: given twice" in capsys.readouterr().err


def test_a_test_rig_has_no_bus_and_no_drive(capsys):
    rig = FIELD.parents[2] / "service/docs/notebooks/rig.toml"
    table = str(rig.with_name("rig.csv"))
    assert main(["run", "--config", str(rig)]) == 2
    assert main(["replay", "--config", str(rig), table, "--manoeuvre-out", "x.json"]) == 2
    assert main(["diagnose", "--config", str(rig), table, "--manoeuvre-out", "x.json"]) == 2
    err = lines(capsys)[1]
    assert err[0] == "soilbus: [table]: a table of a test rig has no bus; replay and diagnose read it"
    assert err[1:] == ["soilbus: --manoeuvre-out: a test rig is no vehicle to drive"] * 2


def test_a_broken_line_is_named_in_words(log, tractor, tmp_path, capsys):
    text = log.read_text()
    cut = tmp_path / "cut.log"
    cut.write_text(text[: text.rindex("#", 0, len(text) // 2)])
    assert main(["replay", "--config", str(tractor), str(cut)]) == 1
    (line,) = lines(capsys)[1]
    assert "(a line that is no frame)" in line


@pytest.mark.parametrize("seed", ["-1", "1.5", "x", ""])
def test_a_wrong_seed_is_named_in_one_line_and_nothing_is_written(seed, tmp_path, capsys):
    out = tmp_path / "drive.log"
    with pytest.raises(SystemExit) as stop:
        main(["simulate", "--log", str(out), f"--seed={seed}"])
    assert stop.value.code == 2
    said = f"soilbus simulate: error: argument --seed: {seed} is not a whole number from 0 up"
    assert lines(capsys)[1][-1] == said
    assert not out.exists()


def test_a_part_that_the_configuration_has_not_cannot_be_set(tractor, capsys):
    assert main(["check", "--config", str(tractor), "--set", "axle.rear.gear_ratio=3"]) == 2
    assert lines(capsys) == ([], ["soilbus: --set axle.rear.gear_ratio=3: the configuration has no [[axle]]"])
