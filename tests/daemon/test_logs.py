"""Several logs: each is a recording of its own, nothing of any is lost, and what is damaged takes nothing with it."""

import functools
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fakes import drive_messages
from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.cli.main import main
from soilbus.decision.traversability import Status, Traversability
from soilbus.offline.recordings import recordings_of
from soilbus.offline.replay import LogError, estimator_beside, fed, log_names, replay
from soilbus.pipeline.intake import Intake, WindowTask
from soilbus.pipeline.outputs import json_line
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.report.replay_pictures import stretches
from soilbus.report.windows import summary
from soilbus.simulator.reference import TRACTOR, reference_configuration

WINDOW, SECONDS = 4.0, 9.0
SHORT = [f"estimator.window={WINDOW}"]
CONFIG = reference_configuration(SHORT)
DATABASE = load_databases(CONFIG)
START = 1_700_000_000.0


@pytest.fixture(scope="module")
def lines(tmp_path_factory) -> list[str]:
    path = tmp_path_factory.mktemp("log") / "drive.log"
    write_log(drive_messages(CONFIG, SECONDS, seed=4), path)
    return path.read_text().splitlines(keepends=True)


@pytest.fixture(scope="module")
def drive(lines) -> Callable[[], list[str]]:
    return lambda: lines


def moved(lines: list[str], by: float) -> list[str]:
    return [f"({float(line[1:18]) + by:.6f}){line.split(')', 1)[1]}" for line in lines]


class Transcript:
    """In the place of the estimator: says of a window's data what they are, and of what was before nothing."""

    def solve(self, task: WindowTask) -> WindowResult:
        data = task.window
        channels = (data.torque, data.load, data.speed, data.ground_speed[:, None], data.draft[:, None])
        return WindowResult(
            t=task.end, index=task.index, status=Status.DEGRADED if task.poor else Status.VALID,
            reason=" ".join(["input_stale", *task.poor]) if task.poor else "none", posterior=None, bearing=None,
            slip=task.slip, sinkage={}, traversability=Traversability(), chi2=float(np.nansum(np.hstack(channels))),
            samples=data.samples, rejected=task.rejected,
        )  # fmt: skip


def transcribing() -> Pipeline:
    pipeline = Pipeline(CONFIG, DATABASE)
    pipeline.estimator = Transcript()
    return pipeline


def windows_of(logs: list[Path], pipeline: Pipeline | None = None, **more) -> list[dict]:
    pipeline = pipeline or transcribing()
    return [json.loads(json_line(r, CONFIG)) for r in replay(pipeline, logs, **more)]


def without(windows: list[dict], *keys: str) -> list[dict]:
    return [{k: v for k, v in w.items() if k not in keys} for w in windows]


@functools.cache
def samples_by_identifier() -> dict[str, int]:
    """How many channels the frames of each identifier carry, from DBC and configuration alone."""
    counts: dict[str, int] = {}
    for channel in Intake(CONFIG, DATABASE).channels:
        message = DATABASE.get_message_by_name(channel.message)
        key = f"{message.frame_id:08X}" if message.is_extended_frame else f"{message.frame_id:03X}"
        counts[key] = counts.get(key, 0) + 1
    return counts


def samples_in(lines: list[str]) -> int:
    return sum(samples_by_identifier().get(line.split()[2].split("#")[0], 0) for line in lines)


# --- what is fed to the property test: damages of single frames, and how logs lie in time

SPOILT = {
    "remote": lambda i, data: f"{i}#R",
    "short": lambda i, data: f"{i}#{data[:-2]}",
    "none": lambda i, data: f"{i}#" + "F" * len(data),
    "twice": lambda i, data: f"{i}#{data}",
    "wild": lambda i, data: f"{i}#{data[:2]}7F{data[4:]}",
}


def spoilt(lines: list[str], damages: list[tuple[float, str]]) -> list[str]:
    """The lines with one frame here and there damaged; never the very last, whose damage is a cut."""
    out = list(lines)
    for share, kind in sorted(dict(damages).items(), reverse=True):
        place = min(int(share * len(out)), len(out) - 2)
        stamp, channel, frame, *rest = out[place].split()
        new = " ".join([stamp, channel, SPOILT[kind](*frame.split("#")), *rest]) + "\n"
        if kind == "twice":
            out.insert(place, new)
        else:
            out[place] = new
    return out


logs_drawn = st.lists(
    st.tuples(
        st.sampled_from([0.0, 0.0, -300.0, 2.5, 1e6, -0.4]),  # when it starts, beside the others
        st.sampled_from([SECONDS, 6.0, 1.5]),
        st.lists(st.tuples(st.sampled_from([0.0, 0.3, 0.99, 0.999, 1.0]), st.sampled_from(sorted(SPOILT))), max_size=4),
    ),
    min_size=1,
    max_size=4,
)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(drawn=logs_drawn)
def test_any_sequence_of_logs_gives_the_windows_of_each_and_accounts_for_every_sample(drawn, drive, tmp_path):
    logs, sent = [], 0
    for i, (start, seconds, damages) in enumerate(drawn):
        part = spoilt([x for x in moved(drive(), start) if float(x[1:18]) - START - start < seconds], damages)
        sent += samples_in(part)
        logs.append(tmp_path / f"{i}.log")
        logs[-1].write_text("".join(part))
    pipeline = transcribing()
    windows = windows_of(logs, pipeline)
    assert [w["window"] for w in windows] == list(range(len(windows)))
    alone = [w for log in logs for w in windows_of([log])]
    assert without(windows, "window") == without(alone, "window")
    assert {w["log"] for w in windows} <= {log.name for log in logs}
    assert not any("input_stale" in w["reason"] for w in windows)
    refusals = pipeline.intake.refusals
    assert refusals.used + refusals.total.total() == sent
    kinds = {kind for _, _, damages in drawn for kind in dict(damages).values()}
    assert ("remote_frame" in refusals.total) == ("remote" in kinds)
    assert ("wrong_length" in refusals.total) == ("short" in kinds)
    said = summary([], pipeline)
    assert f"samples {sent}: used {refusals.used}, refused {sent - refusals.used}\n" in said


@pytest.mark.parametrize("by", [-1000.0, -SECONDS, -2.0, 100.0, 1e6])
def test_logs_joined_to_one_give_the_windows_of_each(lines, tmp_path, by):
    parts = [lines, moved(lines, by), moved(lines, 2 * by)]
    for i, part in enumerate(parts):
        (tmp_path / f"{i}.log").write_text("".join(part))
    (tmp_path / "all.log").write_text("".join("".join(part) for part in parts))
    pipeline = transcribing()
    joined = windows_of([tmp_path / "all.log"], pipeline)
    apart = windows_of([tmp_path / f"{i}.log" for i in range(3)])
    assert len(apart) == 15
    assert without(joined, "log", "window") == without(apart, "log", "window")
    assert {w["log"] for w in joined} == {"all.log"}
    assert pipeline.intake.refusals.total == {}
    assert pipeline.intake.refusals.used == 3 * samples_in(lines)


def test_an_estimate_carries_nothing_from_log_to_log(lines, tmp_path):
    """Not the soil, nor gains, nor the state of the decision: a log's windows are those that it has alone."""
    for name, by in (("a", 0.0), ("b", SECONDS), ("c", -50.0)):
        (tmp_path / f"{name}.log").write_text("".join(moved(lines, by)))
    logs = [tmp_path / f"{name}.log" for name in "abc"]
    with estimator_beside(CONFIG) as workers:
        together = windows_of(logs, Pipeline(CONFIG, DATABASE), workers=workers)
    alone = windows_of(logs[-1:], Pipeline(CONFIG, DATABASE))
    assert len(alone) == 5
    assert without(together[-5:], "window") == without(alone, "window")


def test_every_output_says_which_log_it_is_of(lines, tmp_path, capsys):
    places = [tmp_path / "a" / "t.log", tmp_path / "b" / "t.log", tmp_path / "c.log"]
    for place, by in zip(places, (0.0, 0.0, -50.0), strict=True):
        place.parent.mkdir(exist_ok=True)
        place.write_text("".join(moved(lines, by)))
    outputs = [tmp_path / "o.jsonl", tmp_path / "o.geojson", tmp_path / "o.html"]
    options = [x for pair in zip(("--json", "--map", "--report"), map(str, outputs), strict=True) for x in pair]
    arguments = ["replay", "--config", str(TRACTOR), "--set", *SHORT, *map(str, [*places, places[0]]), *options]
    assert main(arguments) == 0
    names = ["a/t.log"] * 5 + ["b/t.log"] * 5 + ["c.log"] * 5 + ["a/t.log (2)"] * 5
    assert [json.loads(line)["log"] for line in outputs[0].read_text().splitlines()] == names
    features = json.loads(outputs[1].read_text())["features"]
    assert [f["properties"]["log"] for f in features] == names
    assert len({f["id"] for f in features}) == 20
    said, page = capsys.readouterr().out, outputs[2].read_text()
    assert "20 windows from" in said
    for name in set(names):
        assert f"  {name}: 5 windows, " in said
        assert f"  {name}: 5 windows, " in page


def test_names_are_as_short_as_tells_logs_apart():
    logs = [Path(p) for p in ("/x/a/t.log", "/x/b/t.log", "/y/b/t.log", "u.log", "/x/a/t.log")]
    assert log_names(logs) == ["a/t.log", "x/b/t.log", "y/b/t.log", "u.log", "a/t.log (2)"]


def test_no_line_is_drawn_across_logs_or_a_set_clock(lines, tmp_path):
    for name, by in (("a", 0.0), ("b", -SECONDS), ("c", 2.0)):
        (tmp_path / name).with_suffix(".log").write_text("".join(moved(lines, by)))
    (tmp_path / "d.log").write_text("".join([*lines, *moved(lines, -300.0)]))
    results = list(replay(transcribing(), [tmp_path / f"{name}.log" for name in "abcd"]))
    cut = stretches(results)
    assert [r for stretch in cut for r in stretch] == results
    assert [(stretch[0].log, len(stretch)) for stretch in cut] == [
        ("a.log", 5), ("b.log", 5), ("c.log", 5), ("d.log", 5), ("d.log", 5),
    ]  # fmt: skip
    for stretch in cut:
        assert np.diff([r.t for r in stretch]) == pytest.approx(np.ones(4))
    assert stretches([replace(r, t=0.0) for r in results[:2]]) == [[replace(r, t=0.0)] for r in results[:2]]


# --- damaged logs


def test_a_damaged_log_in_the_middle_costs_no_other_a_window(lines, tmp_path, capsys):
    places = [tmp_path / f"{name}.log" for name in "abcd"]
    texts = ["".join(lines), "".join(lines)[:-300], "(1.0) can0 7FF#00\n", "".join(lines)]
    for place, text in zip(places, texts, strict=True):
        place.write_text(text)
    places.insert(3, tmp_path / "missing.log")
    out = tmp_path / "o.jsonl"
    arguments = ["replay", "--config", str(TRACTOR), "--set", *SHORT, *map(str, places), "--json", str(out)]
    assert main(arguments) == 1
    (err,) = capsys.readouterr().err.splitlines()
    assert re.search(r"b\.log: cut off .*--partial keeps the [45] windows before and the other logs", err)
    assert not out.exists()
    assert main([*arguments, "--partial"]) == 0
    windows = [json.loads(line) for line in out.read_text().splitlines()]
    logs = [w["log"] for w in windows]
    assert logs.count("a.log") == logs.count("d.log") == 5
    kept = logs.count("b.log")
    assert len(windows) == 10 + kept
    first, second, third = capsys.readouterr().err.splitlines()
    assert f"{places[1]}: cut off" in first
    assert first.endswith(f"; {kept} windows before that are kept")
    assert f"{places[2]}: none of its 1 frames is in the DBC" in second
    assert f"{places[3]}: no such file" in third


def fault_of(intake: Intake, log: Path) -> str:
    """What is wrong with a log that an intake is fed with, else nothing."""
    try:
        for now in fed(intake, log):
            intake.ingest(now)
    except LogError as error:
        return str(error)
    finally:
        intake.ingest()
    return ""


@pytest.mark.parametrize("suffix", ["", "(1700000000.900000) can0 7FF##1AABB\n"], ids=["fast", "python-can"])
def test_a_log_cut_at_any_byte_is_whole_or_refused(lines, tmp_path, suffix):
    """A frame without its last bytes was taken for one of another length, and half a byte for a byte."""
    some = [line for line in lines if float(line[1:18]) < START + 0.9]
    last = next(i for i in range(len(some) - 1, 0, -1) if samples_by_identifier().get(some[i].split()[2].split("#")[0]))
    text, line = "".join(some[:last]) + suffix, some[last]
    path = tmp_path / "cut.log"
    cut = []
    for n in range(len(line) + 1):
        path.write_text(text + line[:n])
        intake = Intake(CONFIG, DATABASE)
        if "cut off" in fault_of(intake, path):
            cut.append(n)
        assert intake.refusals.total.keys() <= {"wrong_length"}
    data = line.index("#") + 1 + 16  # classic frames of eight bytes
    assert cut == list(range(1, data))


@pytest.mark.parametrize("by", [1e9, -1e7])
def test_the_time_read_of_a_log_is_that_of_the_drive_where_its_clock_was_set(lines, tmp_path, by):
    (tmp_path / "a.log").write_text("".join([*lines[:200], *moved(lines[200:], by)]))
    read = recordings_of(CONFIG, DATABASE, [tmp_path / "a.log"], longest=600.0)
    assert read.samples == recordings_of(CONFIG, DATABASE, [tmp_path / "a.log"]).samples


def test_what_lies_before_the_damage_of_a_log_can_be_diagnosed(lines, tmp_path):
    (tmp_path / "a.log").write_text("".join(lines)[:-40] + "(17000")
    with pytest.raises(LogError):
        recordings_of(CONFIG, DATABASE, [tmp_path / "a.log"])
    assert recordings_of(CONFIG, DATABASE, [tmp_path / "a.log"], partial=True).samples > 0.75 * samples_in(lines)
