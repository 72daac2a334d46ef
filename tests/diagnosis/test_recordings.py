"""Logs as whole records: the bins are those of replay, and a set clock or a long silence begins another part."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from fakes import drive_messages
from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.diagnosis.records import TooLittle
from soilbus.estimation.window import VEHICLE_QUANTITIES, WHEEL_QUANTITIES, Window
from soilbus.offline.recordings import parts, recordings_of
from soilbus.offline.replay import LogError, fed
from soilbus.pipeline.intake import Intake
from soilbus.simulator.reference import reference_configuration

CONFIG = reference_configuration()
DATABASE = load_databases(CONFIG)
SECONDS = 16.0


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("log") / "drive.log"
    write_log(drive_messages(CONFIG, SECONDS, seed=4), path)
    return path


def listener() -> Intake:
    return Intake(CONFIG, DATABASE)


def shifted(line: str, by: float) -> str:
    t, rest = line[1:].split(")", 1)
    return f"({float(t) + by:.6f}){rest}"


def joined(log: Path, to: Path, by: float) -> Path:
    """The log, and once more with its clock at `by` seconds after its own start."""
    lines = log.read_text().splitlines(keepends=True)
    to.write_text("".join(itertools.chain(lines, (shifted(line, by) for line in lines))))
    return to


def rows(window: Window, keep: slice) -> np.ndarray:
    return np.column_stack([getattr(window, q)[keep] for q in (*WHEEL_QUANTITIES, *VEHICLE_QUANTITIES)])


def test_a_record_holds_the_bins_of_the_windows_of_replay(log):
    (whole,) = parts(listener(), log)
    assert whole.t[-1] - whole.t[0] == pytest.approx(SECONDS, abs=0.3)
    intake = listener()
    windows = [task.window for now in fed(intake, log) for task in intake.due(now)]
    assert len(windows) == 6
    inner = slice(1, -1)  # the first and the last bin have no neighbour on one side
    for window in windows:
        first = int(np.argmin(np.abs(whole.t - window.t[0])))
        same = slice(first + 1, first + len(window.t) - 1)
        np.testing.assert_allclose(whole.t[same], window.t[inner], atol=1e-9)
        np.testing.assert_allclose(rows(whole, same), rows(window, inner), rtol=1e-9)


def test_a_log_whose_windows_nobody_takes_is_read_a_second_at_a_time(log):
    """And not frame by frame from the end of the first window on."""
    times = list(fed(listener(), log))
    assert len(times) <= SECONDS + 3
    assert times == sorted(times)


@pytest.mark.parametrize("by", [1000.0, -1000.0])
def test_a_silence_and_a_set_clock_begin_another_part(log, tmp_path, by):
    first, second = parts(listener(), joined(log, tmp_path / "two.log", by))
    (alone,) = parts(listener(), log)
    np.testing.assert_array_equal(first.t, alone.t)
    np.testing.assert_allclose(second.t, alone.t + by, atol=1e-6)
    np.testing.assert_allclose(rows(second, slice(1, -1)), rows(alone, slice(1, -1)), rtol=1e-3)


def test_a_clock_set_by_little_costs_no_more_than_a_second(log, tmp_path):
    first, second = parts(listener(), joined(log, tmp_path / "two.log", SECONDS - 1.5))
    (alone,) = parts(listener(), log)
    n = len(first.t)
    assert len(alone.t) - n <= 11
    np.testing.assert_allclose(rows(first, slice(1, n - 2)), rows(alone, slice(1, n - 2)), rtol=1e-9)
    np.testing.assert_allclose(second.t, alone.t + SECONDS - 1.5, atol=1e-6)


def test_a_short_silence_does_not(log, tmp_path):
    (one,) = parts(listener(), joined(log, tmp_path / "two.log", SECONDS + 20.0))
    silent = (one.t > one.t[0] + SECONDS + 1.0) & (one.t < one.t[0] + SECONDS + 19.0)
    assert silent.sum() > 100
    assert not np.isfinite(one.ground_speed[silent]).any()


def test_parts_too_short_are_reported_and_left_out(log, tmp_path):
    lines = log.read_text().splitlines(keepends=True)
    two = tmp_path / "two.log"
    two.write_text("".join([*lines, *(shifted(line, 1000.0) for line in lines[:1000])]))
    found = recordings_of(CONFIG, DATABASE, [two])
    assert [record.name for record in found.records] == ["two.log"]
    assert found.too_short == ("two.log, part 2",)


def test_a_recording_given_twice_is_refused_whatever_its_name(log, tmp_path):
    copy, link, other = (tmp_path / name for name in ("copy.log", "link.log", "other.log"))
    copy.write_bytes(log.read_bytes())
    link.symlink_to(log)
    for twice in (log, copy, link):
        with pytest.raises(LogError) as fault:
            recordings_of(CONFIG, DATABASE, [log, twice])
        assert str(fault.value) == f"{log} and {twice} are the same recording, which counts once: leave one out"
    other.write_text("".join(shifted(line, 1.0) for line in log.open()))  # another one, of the same size
    assert other.stat().st_size == log.stat().st_size
    assert len(recordings_of(CONFIG, DATABASE, [log, other]).records) == 2


def test_what_was_never_heard_is_reported(log, tmp_path):
    dbc = DATABASE.get_message_by_name("WheelLoads")
    deaf = tmp_path / "deaf.log"
    deaf.write_text("".join(line for line in log.open() if f"{dbc.frame_id:X}#" not in line))
    with pytest.raises(TooLittle, match=r"^deaf\.log.*never heard: load\.FL, load\.FR, load\.RL, load\.RR$"):
        recordings_of(CONFIG, DATABASE, [deaf])
