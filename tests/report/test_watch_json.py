"""`soilbus watch --json`: what the frames say, in the keys and units of `replay --json`; how it ends."""

import io
import itertools
import json
import signal
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import can
import cantools
import pytest

from fakes import message_of, sent_by
from soilbus.can.dbc_files import output_database
from soilbus.can.log_writer import write_log
from soilbus.can.publish import Publisher
from soilbus.cli.main import main
from soilbus.simulator.reference import reference_configuration

REPO = Path(__file__).resolve().parents[2]
SAMPLE = REPO / "dbc" / "sample.log"
WATCH = [sys.executable, "-m", "soilbus", "watch", "--json"]
DATABASE = output_database(reference_configuration())
OF_FRAMES = {"demand", "bus", "bad_frames", "second_sender", "fault", "text"}
"""Keys that replay --json does not have."""


def lines_of(*arguments: object) -> list[dict[str, Any]]:
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        code = main(["watch", "--json", *map(str, arguments)])
    assert (code, err.getvalue()) == (0, "")
    return [json.loads(line) for line in out.getvalue().splitlines()]


def keys_of(record: Any, path: str = "") -> set[str]:
    """Dotted paths of all keys."""
    if not isinstance(record, dict):
        return set()
    return {path + key for key in record} | {
        name for key, inner in record.items() for name in keys_of(inner, f"{path}{key}.")
    }


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """A drive by `replay --json`, and by `watch --json` of the frames that the service sends beside it."""
    folder = tmp_path_factory.mktemp("drive")
    log, frames, windows = folder / "drive.log", folder / "frames.log", folder / "windows.jsonl"
    assert main(["simulate", "--soil", "loam", "--duration", "24", "--seed", "3", "--log", str(log)]) == 0
    assert main(["replay", "--config", "tractor", str(log), "--json", str(windows), "--frames", str(frames)]) == 0
    replayed = [json.loads(line) for line in windows.read_text().splitlines()]
    return replayed, lines_of(frames, "--config", "tractor", "--speed", "1000")


def test_a_window_says_what_replay_says_in_the_same_keys_and_units(both) -> None:
    replayed, heard = both
    assert len(replayed) >= 10
    names = {path for path in keys_of(heard[-1]) if path.partition(".")[0] not in OF_FRAMES}
    assert {path for path in names if not path.startswith("soil_class.")} <= keys_of(replayed[-1])
    for window in replayed:
        of_window = [line for line in heard if line["window"] == window["window"]]
        assert of_window[0]["t"] == pytest.approx(window["t"], abs=0.2)
        # a higher verdict is shown after five frames in a row; what follows is the wheels' between two windows
        line = [line for line in of_window if line["t"] <= window["t"] + 0.55][-1]
        assert line["status"] == window["status"]
        for name, parameter in window["soil"].items():
            assert line["soil"][name]["value"] == pytest.approx(parameter["value"], rel=0.01), name
            assert line["soil"][name]["std"] == pytest.approx(parameter["std"], rel=0.02, abs=500.0), name
        assert line["bearing_pressure"]["value"] == pytest.approx(window["bearing_pressure"]["value"], abs=26.0)
        assert line["sinkage"] == pytest.approx(window["sinkage"], abs=3e-4)
        assert line["traversability"]["state"] == window["traversability"]["state"]
        for key, step in (("max_draft", 6.0), ("max_grade", 6e-5)):
            expected = window["traversability"][key]["value"]
            assert line["traversability"][key]["value"] == pytest.approx(expected, abs=step), key
        for axle, points in window["capability"]["set_points"].items():
            found = line["capability"]["set_points"][axle]
            assert found["pull"]["value"] == pytest.approx(points["pull"]["value"], abs=6e-4)


def test_there_is_a_line_for_each_window_and_for_changes_alone() -> None:
    """Beside what cantools decodes of the same log, at a speed at which the machine may well pause."""
    lines = lines_of(SAMPLE, "--speed", "1000")
    database = cantools.database.load_file(str(REPO / "dbc" / "soilbus.dbc"))
    windows = []
    for message in can.LogReader(SAMPLE):
        if message.arbitration_id == database.get_message_by_name("WindowQuality").frame_id:
            windows.append(database.decode_message("WindowQuality", message.data)["Window"])
    heard = [line["window"] for line in lines if line["window"] is not None]
    assert list(dict.fromkeys(heard)) == windows
    told = [
        (line["window"], line["status"], line["state"], line["reason"], line["traversability"]["state"],
         line["warning"]["state"]) for line in lines
    ]  # fmt: skip
    assert all(one != other for one, other in itertools.pairwise(told))
    assert lines == lines_of(SAMPLE, "--speed", "200")


def recorded(tmp_path: Path, *, seconds: float, foreign_from: float, stop: float) -> Path:
    """Frames of a service that says go until another sender is heard, and that stops before the recording ends."""
    publisher, found = Publisher(DATABASE), []
    for i in range(round(10 * seconds)):
        t, alone = 0.1 * i, 0.1 * i < foreign_from
        values: dict[str, dict[str, Any]] = {"PresentDemand": {"Draft": 3000.0, "Slope": 0.0}}
        if t < stop:
            values["Traversability"] = {"State": "go" if alone else "unknown", "Probability": 0.99, "Window": 1}
            if i % 10 == 0:
                values["SoilbusStatus"] = {
                    "State": "valid" if alone else "degraded",
                    "Reason": "none" if alone else "foreign_sender",
                }
                values["BusHealth"] = {"ForeignFrames": 0 if alone else i}
        found += sent_by(publisher, values, 1.7e9 + t)
    log = tmp_path / "ours.log"
    write_log(found, log)
    return log


def test_a_foreign_sender_and_a_silence_are_no_go(tmp_path: Path) -> None:
    lines = lines_of(recorded(tmp_path, seconds=8.0, foreign_from=3.0, stop=6.0), "--speed", "100")
    go = [line for line in lines if line["traversability"]["state"] == "go"]
    assert go
    assert all(line["t"] < 1.7e9 + 3.0 and line["reason"] != "foreign_sender" for line in go)
    foreign = [line for line in lines if line["reason"] == "foreign_sender"]
    assert foreign[0]["t"] == pytest.approx(1.7e9 + 3.0, abs=0.15)
    assert foreign[-1]["bus"]["foreign_frames"] >= 30
    lines = lines_of(recorded(tmp_path, seconds=8.0, foreign_from=99.0, stop=6.0), "--speed", "100")
    silent = next(line for line in lines if line["t"] > 1.7e9 + 6.05)
    assert silent["t"] == pytest.approx(1.7e9 + 6.4, abs=0.2)
    assert silent["traversability"]["state"] == "unknown"
    assert silent["traversability"]["probability"] is None
    assert silent["demand"]["draft"] == pytest.approx(3000.0, abs=5.0)


def test_a_second_sender_that_the_service_does_not_name_is_a_line_of_its_own(tmp_path: Path) -> None:
    """The service says go throughout; at 3 s another node sends its counter with another draft, once."""
    genuine = list(can.LogReader(recorded(tmp_path, seconds=8.0, foreign_from=99.0, stop=99.0)))
    twin, found = Publisher(DATABASE), list[can.Message]()
    for message in genuine:
        found.append(message)
        if message.arbitration_id == DATABASE.get_message_by_name("PresentDemand").frame_id:
            other = message_of(twin.frame("PresentDemand", {"Draft": 500.0, "Slope": 0.0}), message.timestamp)
            if message.timestamp == pytest.approx(1.7e9 + 3.0, abs=0.01):
                found.append(other)
    log = tmp_path / "two.log"
    write_log(found, log)
    lines = lines_of(log, "--speed", "100")
    told = {line["t"] - 1.7e9: (line["second_sender"], line["traversability"]["state"]) for line in lines}
    assert (False, "go") in told.values()
    during = [t for t, (is_seen, _) in told.items() if is_seen]
    assert {told[t] for t in during} == {(True, "unknown")}
    after = min(t for t in told if t > during[-1])
    assert (during[0], after) == pytest.approx((3.0, 6.0), abs=0.15)
    assert told[after] == (False, "go")
    seen = next(line for line in lines if line["second_sender"])
    assert seen["reason"] == "none"
    assert seen["demand"]["draft"] is None
    assert "another node sends our frames" in seen["text"]


def test_a_reader_that_has_seen_enough_ends_it_without_a_word() -> None:
    with subprocess.Popen(
        [*WATCH, str(SAMPLE), "--speed", "100"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert json.loads(process.stdout.readline())["traversability"]["state"] == "unknown"
        process.stdout.close()
        assert process.wait(timeout=20.0) == 0
        assert process.stderr.read() == ""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_between_two_lines(number: signal.Signals) -> None:
    """Each line is there at once, whole, though the recording goes on for a minute."""
    with subprocess.Popen([*WATCH, str(SAMPLE)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        first = process.stdout.readline()
        process.send_signal(number)
        rest = process.stdout.read()
        assert process.wait(timeout=20.0) == -number
        assert process.stderr.read() == ""
    for line in [first, *rest.splitlines()]:
        json.loads(line)


def test_a_recording_has_no_channel(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", "--json", str(SAMPLE), "--channel", "can0"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["watch", "--json", "--channel", "nosuch0"]) == 1
    assert "nosuch0" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["run", "check", "watch"])
def test_a_broker_in_the_configuration_is_one_line_that_names_what_replaces_it(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "old.toml"
    path.write_text('[mqtt]\nhost = "192.0.2.10"\ntls = true\n')
    assert main([command, "--config", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "mqtt: " in said
    assert "soilbus watch --json" in said
