"""A few minutes of the soak run; the whole day is `python -m tests.soak`."""

from __future__ import annotations

import pytest

from . import wire
from .run import soak


@pytest.fixture(scope="module")
def told():
    patch = pytest.MonkeyPatch()
    patch.setattr(wire, "MEAN_CALM", 6.0)
    patch.setattr(wire, "MEAN_FAULT", 2.0)
    yield soak(300.0, seed=4, hour=100.0)
    patch.undo()


def test_every_frame_is_accounted_for(told):
    assert told.lost == {}
    assert told.received == told.admitted + told.refused.total()
    assert told.unknown > 0
    assert {"bad_checksum", "bad_counter", "time_backwards", "wrong_length", "remote_frame"} <= set(told.refused)


def test_all_faults_came(told):
    assert set(wire.FAULTS) <= set(told.faults)


def test_frames_keep_their_beat(told):
    assert told.deadline_misses == 0
    assert told.off_beat <= told.faults["full"]  # once each: the newest frame goes out as soon as there is room
    assert told.sent > 0.8 * 3000


def test_valid_windows_stay_right(told):
    valid = sum(hour.valid for hour in told.hours)
    assert valid > 20
    assert max(hour.worst_z for hour in told.hours if hour.valid) < 4.0


def test_a_lost_frame_is_noticed(monkeypatch):
    monkeypatch.setattr(wire.Wire, "_hand_over", _forgetful(wire.Wire._hand_over))
    assert soak(12.0, seed=4).lost


def _forgetful(usual):
    def handed(self, message):
        kept = usual(self, message)
        self.delivered[message.arbitration_id] += self.delivered[message.arbitration_id] == 100
        return kept

    return handed
