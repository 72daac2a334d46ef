"""Wild samples and reversing, from frames to windows."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from fakes import feed_message, in_reverse
from soilbus.can.candump import Frame
from soilbus.can.dbc_files import load_databases
from soilbus.config.file import load_config, machine, parse_config
from soilbus.offline.replay import read_frames
from soilbus.pipeline.intake import Intake
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited

FIELD_TOML = Path(__file__).resolve().parents[1] / "field/field.toml"
START = 1_700_000_000.0
SPEEDS = 0x510
QUANTITIES = ("torque", "load", "speed", "sinkage", "ground_speed", "draft", "pitch", "acceleration", "yaw_rate")


@pytest.fixture(scope="module")
def loam(field_recording) -> list[Frame]:
    out = []
    for frame in read_frames(field_recording("loam.log.gz")):
        if frame[0] >= START + 14.5:
            break
        out.append(frame)
    return out


def spoilt(recorded: list[Frame], share: float = 0.01):
    """The frames with 1 % of the front left wheel's speeds a tenth too high, and the times of those."""
    rng = np.random.default_rng(1)
    out, times = [], []
    for t, identifier, extended, data, *rest in recorded:
        # not where a window's last samples are: one there is counted by the next window
        if identifier == SPEEDS and rng.random() < share and 0.02 < (t - START) % 1.0 < 0.88:
            data = round(1.1 * int.from_bytes(data[:2], "little")).to_bytes(2, "little") + data[2:]
            times.append(t)
        out.append((t, identifier, extended, data, *rest))
    return out, np.array(times)


def windows(recorded: list[Frame]):
    """The tasks of the frames, the clock looked at every 200 of them, and the intake."""
    config = load_config(FIELD_TOML)
    intake = Intake(config, load_databases(config))
    tasks = []
    for i, (t, identifier, extended, data, *_) in enumerate(recorded):
        if i % 200 == 0:
            tasks += intake.due(t)
        intake.admission.feed(t, identifier, extended, data)
    return tasks + intake.finish(recorded[-1][0]), intake


def test_wild_samples_are_left_out_and_counted(loam):
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
    intake = Intake(config, load_databases(config))
    for message in frames(simulate(config, excited("loam", 11.5), seed=3), config):
        feed_message(intake.admission, message)
    slip = intake.finish(message.timestamp)[0].slip
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
