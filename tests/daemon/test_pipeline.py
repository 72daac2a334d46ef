"""The recordings of the field vehicle, whole and mutilated, through the pipeline, and the keys of its JSON lines."""

import json
import math
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from fakes import drive_messages, fed, feed_message, in_reverse
from soilbus.can.dbc_files import load_databases
from soilbus.config.file import load_config, machine, parse_config
from soilbus.decision.traversability import State, Status, Traversability
from soilbus.offline.replay import read_frames
from soilbus.pipeline.intake import Intake
from soilbus.pipeline.outputs import json_line
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited

FIELD_TOML = Path(__file__).resolve().parents[1] / "field/field.toml"
CLAY = ["soil.c.value=5000", "soil.c.std=1250", "soil.K.value=0.01", "soil.K.std=0.0025"]
STUBBLE = ["soil.c.value=3000", "soil.c.std=750"]
START = 1_700_000_000.0

LOADS, DRAWBAR, SINKAGES = 0x520, 0x530, 0x540
MCU_RR = 0x18FF2213
RADAR = 0x18FE4997

Frames = list[tuple[float, int, bool, bytes]]


def read(path: Path) -> Frames:
    return [(t, i, x, bytes(data)) for t, i, x, data, *_ in read_frames(path)]


@pytest.fixture(scope="module")
def recording(field_recording):
    kept: dict[str, Frames] = {}

    def find(name: str) -> Frames:
        if name not in kept:
            kept[name] = read(field_recording(f"{name}.log.gz"))
        return kept[name]

    return find


@pytest.fixture(scope="module")
def half_minute(recording) -> Frames:
    return [f for f in recording("loam") if f[0] < START + 30.0]


def new_pipeline(*overrides: str) -> Pipeline:
    config = load_config(FIELD_TOML, overrides)
    return Pipeline(config, load_databases(config))


def run(frames: Frames, *overrides: str, every: int = 200, pipeline: Pipeline | None = None):
    """Results of the frames, the clock advanced every so many of them."""
    pipeline = pipeline or new_pipeline(*overrides)
    results = []
    for i, frame in enumerate(frames):
        if i % every == 0:
            results += pipeline.advance(frame[0])
        pipeline.feed(*frame)
    return results + pipeline.finish(frames[-1][0])


@pytest.fixture(scope="module")
def whole(recording):
    """Results and pipeline of a whole recording."""
    kept = {}

    def find(name: str):
        if name not in kept:
            pipeline = new_pipeline(*{"clay": CLAY, "stubble": STUBBLE}.get(name, []))
            kept[name] = run(recording(name), pipeline=pipeline), pipeline
        return kept[name]

    return find


def bearing_errors(results, path: Path) -> np.ndarray:
    soil = json.loads(path.read_text())
    truth = (soil["k_c"] / 0.3 + soil["k_phi"]) * 0.02 ** soil["n"]
    return np.array([r.bearing.value / truth - 1.0 for r in results])


def of_status(results, status: Status):
    return [r for r in results if r.status is status]


def test_loam(whole, field_recording):
    results, pipeline = whole("loam")
    valid = of_status(results, Status.VALID)
    assert len(results) == 110  # 120 s, windows of 10 s, one each second
    assert len(valid) >= 50
    errors = bearing_errors(valid, field_recording("loam.soil.json"))
    assert np.median(np.abs(errors)) < 0.05
    truth = json.loads(field_recording("loam.soil.json").read_text())
    tan_phi = [r.posterior.tan_phi().value for r in valid]
    assert np.median(tan_phi) == pytest.approx(math.tan(math.radians(truth["phi_deg"])), rel=0.05)
    assert np.median([abs(e) / (r.bearing.std / r.bearing.value) for e, r in zip(errors, valid, strict=True)]) < 2.0
    assert pipeline.intake.refusals.total == {}
    assert np.median([r.chi2 for r in valid]) == pytest.approx(1.0, abs=0.15)


def test_sinkage_and_slip_of_loam_are_the_measured_ones(whole, recording):
    results, _ = whole("loam")
    by_second: dict[int, list] = {}
    for t, identifier, _, data in recording("loam"):
        if identifier == SINKAGES:
            by_second.setdefault(int(t - START), []).append(np.frombuffer(data, "<i2") * 1e-4)
    for r in results[::20]:
        end = round(r.t - START)
        measured = np.mean(np.concatenate([by_second[s] for s in range(end - 10, end)]), axis=0)
        assert list(r.sinkage.values()) == pytest.approx(measured.tolist(), abs=1.5e-3)
        assert all(0.0 < slip < 0.6 for slip in r.slip.values())


def test_clay_counts_every_refused_sample_and_stays_right(whole, field_recording, recording):
    results, pipeline = whole("clay")
    frames = recording("clay")
    not_available = sum(data[2] & 3 == 3 for _, i, _, data in frames if i == DRAWBAR)
    not_available += sum(data[:2] == b"\xff\xff" for _, i, _, data in frames if i == RADAR)
    assert not_available == 67
    assert pipeline.intake.refusals.total == {"not_available": 67}
    valid = of_status(results, Status.VALID)
    assert len(valid) >= 50
    assert np.median(np.abs(bearing_errors(valid, field_recording("clay.soil.json")))) < 0.05
    # Each window counts what was refused in it.
    for r in results:
        within = sum(
            r.t - 10.0 <= t < r.t and ((i == DRAWBAR and data[2] & 3 == 3) or (i == RADAR and data[:2] == b"\xff\xff"))
            for t, i, _, data in frames
        ) if r.index % 11 == 0 else None  # fmt: skip
        assert within is None or sum(r.rejected.values()) == within
    samples = {r.index: r.samples for r in results}
    assert max(samples.values()) < 10 * (50 * 18 + 25)  # as many as the frames have, none twice


def test_the_silent_motor_degrades_its_windows(whole, recording):
    results, _ = whole("clay")
    heard = [t for t, i, _, _ in recording("clay") if i == MCU_RR]
    gap = int(np.argmax(np.diff(heard)))
    silent, back = heard[gap], heard[gap + 1]
    assert back - silent > 2.9
    during = [r for r in results if r.t >= silent + 1.0 and r.t - 10.0 < back - 0.5]
    assert len(during) == 12
    for r in during:
        assert r.status is Status.DEGRADED
        assert "torque.RR" in r.reason
        assert r.traversability.state is not State.GO
    assert [r for r in results if r.status is not Status.VALID] == during


def test_stubble_scatters_more_than_its_sensors_and_what_comes_is_predicted(whole):
    """Nobody has said what it hides: that the draft scatters beyond its sensor shows it, and go has to come true."""
    results, pipeline = whole("stubble")
    largest = pipeline.config.traversability.max_slip
    for now, later in zip(results, results[3:], strict=False):
        assert now.noise_factors["draft"] > 5.0
        assert max(now.prediction_error.values(), default=0.0) < 0.05
        if now.traversability.state is State.GO:
            assert max(later.slip.values()) < largest


@pytest.mark.parametrize("name", ["loam", "clay", "stubble"])
def test_json_lines_are_strict_and_number_the_windows(name, whole):
    """Their keys are those of the page (test_json_table.py) and of the golden outputs."""
    results, pipeline = whole(name)
    lines = [json_line(r, pipeline.config) for r in results]
    assert not any("\n" in line for line in lines)
    found = [json.loads(line, parse_constant=pytest.fail) for line in lines]
    assert [one["window"] for one in found] == list(range(len(results)))
    assert np.diff([one["t"] for one in found]) == pytest.approx(np.ones(len(found) - 1))
    for one in found:
        nothing = one["status"] == "invalid"
        assert nothing is (one["soil"] is None) is (one["capability"] is None) is (one["soil_class"] is None)


# --- mutilated halves of a minute of loam; everything goes wrong at 15 s ---

WRONG_FROM = START + 15.0


def edited(frames: Frames, identifier: int, edit) -> Frames:
    """The frames with those of one identifier changed (None: taken out) from 15 s on."""
    out = []
    for t, i, extended, data in frames:
        new = edit(data) if i == identifier and t >= WRONG_FROM else data
        if new is not None:
            out.append((t, i, extended, bytes(new)))
    return out


def test_the_half_minute_is_a_go_as_it_is(half_minute):
    results = run(half_minute)
    assert [r.status for r in results] == [Status.VALID] * 21
    assert all(r.traversability.state is State.GO for r in results[6:])  # the fifth holds a warning


def test_spinning_on_the_spot_is_no_go(half_minute):
    # The wheels turn, the tractor stands: no slip can be told, and it must not read "go".
    results = run(edited(half_minute, RADAR, lambda data: b"\x00\x00" + data[2:]))
    stuck = [r for r in results if r.t >= WRONG_FROM + 1.0]
    assert len(stuck) >= 14
    assert {r.traversability.state for r in stuck} == {State.NO_GO}
    assert {r.status for r in stuck} <= {Status.NOT_EXCITED, Status.INVALID}


# --- Wild samples and reversing, from frames to windows ---

SPEEDS = 0x510
QUANTITIES = ("torque", "load", "speed", "sinkage", "ground_speed", "draft", "pitch", "acceleration", "yaw_rate")


def spoilt(recorded: Frames, share: float = 0.01):
    """The frames with 1 % of the front left wheel's speeds a tenth too high, and the times of those."""
    rng = np.random.default_rng(1)
    out, times = [], []
    for t, identifier, extended, data in recorded:
        # not where a window's last samples are: one there is counted by the next window
        if identifier == SPEEDS and rng.random() < share and 0.02 < (t - START) % 1.0 < 0.88:
            data = round(1.1 * int.from_bytes(data[:2], "little")).to_bytes(2, "little") + data[2:]
            times.append(t)
        out.append((t, identifier, extended, data))
    return out, np.array(times)


def windows(recorded: Frames):
    """The tasks of the frames, the clock looked at every 200 of them, and the intake."""
    config = load_config(FIELD_TOML)
    intake = Intake(config, load_databases(config))
    tasks = []
    for i, frame in enumerate(recorded):
        if i % 200 == 0:
            tasks += intake.due(frame[0])
        intake.admission.feed(*frame)
    return tasks + intake.finish(recorded[-1][0]), intake


def test_wild_samples_are_left_out_and_counted(half_minute):
    loam = [frame for frame in half_minute if frame[0] < START + 14.5]
    frames_, times = spoilt(loam)
    assert len(times) > 3
    clean, _ = windows(loam)
    tasks, intake = windows(frames_)
    assert len(tasks) == len(clean) == 5
    assert intake.refusals.total["outlier"] == np.count_nonzero(times < tasks[-1].end)
    for task, other in zip(tasks, clean, strict=True):
        n = np.count_nonzero((times >= task.start) & (times < task.end))
        assert n > 0
        assert task.rejected == {"outlier": n}
        assert other.rejected == {}
        assert task.window.samples == other.window.samples - n
        assert task.window.speed[:, 0] == pytest.approx(other.window.speed[:, 0], rel=5e-3)  # 5 sd of a bin's mean
        for name in QUANTITIES:
            a, b = getattr(task.window, name), getattr(other.window, name)
            assert name == "speed" or np.array_equal(a, b, equal_nan=True)


def test_a_wheel_without_a_speed_sensor_has_no_slip():
    raw = tomllib.loads(machine("tractor-2wd").read_text())
    for wheel in raw["wheel"]:
        del wheel["speed"]
    config = parse_config(raw)
    intake, last = fed(config, drive_messages(config, 11.5))
    slip = intake.finish(last)[0].slip
    assert slip["FL"] is None
    assert slip["FR"] is None
    assert slip["RL"] == pytest.approx(slip["RR"])  # that of their motor
    assert 0.05 < slip["RL"] < 0.5


def test_slip_in_reverse_is_that_of_the_same_drive_forward():
    config = reference_configuration()
    database, recording = load_databases(config), simulate(config, excited("loam", 11.5), seed=3)
    slips = []
    for driven in (recording, in_reverse(recording)):
        intake, tasks = Intake(config, database), []
        for m in frames(driven, config, database):
            tasks += intake.due(m.timestamp)
            feed_message(intake.admission, m)
        intake.ingest()
        slips.append([*tasks[0].slip.values(), *intake.latest(m.timestamp).slip.values()])
    ahead, back = slips
    assert all(0.0 < s < 0.5 for s in ahead)
    assert back == pytest.approx(ahead, abs=1e-3)  # codes are rounded


# --- The page's table of JSON keys is the table of the keys that a line has ---

DOCS = Path(__file__).resolve().parents[2] / "service" / "docs"
NOTHING = WindowResult(1.0, 0, Status.INVALID, "no_convergence", None, None, {}, {}, Traversability(), None, 0, {})


def test_the_readme_names_every_key_of_a_line():
    table = re.search(
        r"^\| key \| meaning \|\n.*\n((?:\|.*\n)+)", (DOCS / "json.md").read_text(encoding="utf-8"), re.M
    )[1]
    named = [key for row in table.splitlines() for key in re.findall(r"`(\w+)`", row.split("|")[1])]
    assert sorted(named) == sorted(json.loads(json_line(NOTHING, reference_configuration())))


def test_the_readme_gives_the_drift_of_the_soil_that_is_in_force():
    (said,) = re.findall(
        r"`estimator\.soil_drift`, ([\d.]+) in the time of one window", (DOCS / "method.md").read_text(encoding="utf-8")
    )
    assert float(said) == reference_configuration().estimator.soil_drift
