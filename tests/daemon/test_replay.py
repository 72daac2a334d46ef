"""Reading logs: the fast way tells the same as python-can's, also of logs that are damaged."""

import gc
import math
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from soilbus.estimation.window import Rig, SensorNoise
from soilbus.offline.replay import LogError, read_frames, read_log
from soilbus.pipeline.intake import silences
from soilbus.sensors.bins import Bins


def outcome(read: Callable[[Path], Iterator[Any]], path: Path) -> tuple[list[Any], str]:
    found: list[Any] = []
    try:
        found.extend(read(path))
    except LogError as error:
        return found, str(error)
    return found, ""


ASC = """date Fri Nov 27 10:00:00.000 am 2026
base hex  timestamps {stamps}
internal events logged
   0.000000 1  123             Rx   d 1 00
   {second} 1  123             Rx   d 1 01
   {third} 1  123             Rx   d 1 02
"""


def test_stamps_of_an_asc_log_that_are_relative_to_the_event_before_are_refused(tmp_path):
    log = tmp_path / "x.asc"
    log.write_text(ASC.format(stamps="relative", second="0.020000", third="0.019000"))
    for read in (read_frames, read_log):
        with pytest.raises(LogError, match=f"{re.escape(str(log))}: .*absolute"):
            list(read(log))
    log.write_text(ASC.format(stamps="absolute", second="0.020000", third="0.040000"))
    assert [frame[0] for frame in read_frames(log)] == pytest.approx([0.0, 0.02, 0.04])


def test_a_byte_order_mark_before_a_log_is_no_part_of_it(tmp_path):
    log = tmp_path / "x.log"
    for text in ("(1.500000) can0 123#00\n(1.520000) can0 123#01\n", "(1.500000) can0 123##000\n"):
        log.write_text(text)
        frames = list(read_frames(log))
        log.write_text("\ufeff" + text, encoding="utf-8")
        assert list(read_frames(log)) == frames


@pytest.mark.parametrize("bin_length", [0.1, 0.25, 0.5])
def test_silent_half_seconds_of_each_channel_add_up(bin_length: float) -> None:
    quantities = ("torque", "load", "speed", "sinkage", "ground_speed", "draft", "pitch", "acceleration", "yaw_rate")
    noise = dict.fromkeys(quantities, SensorNoise(absolute=1.0))
    rig = Rig(("A", "B"), np.ones(2), np.ones(2), np.array([True, False]), None, noise)
    store = Bins(rig, bin_length, 0.0)
    steady, late = np.arange(0.01, 10.0, 0.02), np.arange(4.01, 10.0, 0.02)
    sparse = np.array([0.1, 0.2, 7.3])
    samples = {"torque.A": steady, "load.B": late, "draft": sparse}
    store.add({name: (t, np.ones(len(t))) for name, t in samples.items()})
    silent = dict(zip(rig.channels, silences(store.window(0.0, 10.0), 0.5), strict=True))
    assert silent == dict.fromkeys(rig.channels, 10.0) | {"torque.A": 0.0, "load.B": 4.0, "draft": 9.0}
    assert min(silences(store.window(0.0, bin_length), 0.5)) == math.inf


@pytest.mark.parametrize("gone", [3, 6, 12])
def test_a_frame_without_its_last_bytes_is_refused_in_other_formats_too(tmp_path, gone):
    path = tmp_path / "a.asc"
    with can.Logger(path) as log:
        for i in range(5):
            log(can.Message(timestamp=1.0 + i, arbitration_id=0x210, is_extended_id=False, data=bytes([i] * 8)))
    head, _, last = path.read_text().rpartition(" 04 04 04 04 04 04 04 04")
    assert last
    path.write_text(head + " 04 04 04 04 04 04 04 04"[:-gone])
    for read in (read_frames, read_log):
        found, error = outcome(read, path)
        assert len(found) == 4
        assert "cut off or damaged after 4 frames (a frame of 8 bytes has" in error


def test_a_reader_that_cannot_be_made_prints_nothing_when_it_is_destroyed(tmp_path, monkeypatch):
    class HalfMade:
        def __init__(self, _: object) -> None:
            self.itself = self  # so that only the collector destroys it
            raise ValueError("no MDF file")

        def __del__(self) -> None:
            raise AttributeError("no file to close")

    said: list[object] = []
    monkeypatch.setattr("sys.unraisablehook", said.append)
    monkeypatch.setattr("can.MF4Reader", HalfMade)
    monkeypatch.setattr("can.io.mf4.asammdf", object())
    (tmp_path / "drive.mf4").write_bytes(b"MDF     4.10")
    with pytest.raises(LogError, match="no MDF file"):
        list(read_log(tmp_path / "drive.mf4"))
    gc.collect()
    assert said == []
    assert sys.unraisablehook == said.append
