"""Three minutes of the soak run; the whole day is `python -m tests.lab.soak`."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.lab.soak import wire
from tests.lab.soak.figures import Hour, unaccounted
from tests.lab.soak.run import CYCLE, GROWTH, Soak, demands, soak


@pytest.fixture(scope="module")
def shown():
    patch = pytest.MonkeyPatch()
    patch.setattr(wire, "MEAN_CALM", 3.6)
    patch.setattr(wire, "MEAN_FAULT", 1.2)
    yield soak(180.0, seed=4, hour=60.0)
    patch.undo()


def test_every_frame_is_accounted_for(shown):
    assert shown.lost == {}
    assert shown.received == shown.admitted + shown.refused.total()
    assert shown.unknown > 0
    assert {"bad_checksum", "bad_counter", "time_backwards", "wrong_length", "remote_frame"} <= set(shown.refused)


def test_all_faults_came(shown):
    assert set(wire.FAULTS) <= set(shown.faults)


def test_frames_keep_their_beat(shown):
    assert shown.deadline_misses == 0
    assert shown.off_beat <= shown.faults["full"]  # once each: the newest frame goes out as soon as there is room
    assert shown.sent > 0.8 * 1800
    assert abs(shown.drift) < CYCLE / 2 * shown.epochs


def test_valid_windows_stay_right(shown):
    valid = sum(hour.valid for hour in shown.hours)
    assert valid > 20
    assert max(hour.worst_z for hour in shown.hours if hour.valid) < 4.0


def test_a_lost_frame_is_noticed():
    heard, refused = Counter(MotorFL=100, WheelLoads=50), Counter({("MotorFL", "stuck"): 1})
    assert unaccounted(heard, heard - Counter(MotorFL=1), refused, heard) == {}
    delivered = heard + Counter(WheelLoads=1)
    assert unaccounted(heard, heard - Counter(MotorFL=1), refused, delivered) == {
        "WheelLoads": 1, "WheelLoads (counted)": 1,
    }  # fmt: skip


def _fine(**changed) -> Soak:
    hours = [Hour(3600, 3500, 0.0045, 0.6, 2.0, 80_000_000 + 1000 * i) for i in range(8)]
    shown = Soak(hours, 10, 9, Counter(stuck=1), 3, {}, Counter(), 0, 100, 0, 0.04, 1)
    return shown._replace(**changed)


@pytest.mark.parametrize(
    ("changed", "asked"),
    [
        ({"lost": {"MotorFL": 1}}, "every frame accounted for"),
        ({"admitted": 8}, "every frame accounted for"),
        ({"deadline_misses": 1}, "no deadline missed"),
        ({"off_beat": 1}, "every frame on its beat"),
        ({"drift": 0.09}, "the beat drifts"),
        ({"hours": [_fine().hours[0], _fine().hours[0]._replace(memory=80_000_001 + int(GROWTH))]}, "memory grows"),
        ({"hours": [_fine().hours[0], _fine().hours[0]._replace(error=0.006)]}, "estimates as good"),
        ({"hours": [_fine().hours[0], _fine().hours[0]._replace(worst_z=5.1)]}, "no valid window"),
    ],
)
def test_each_demand_can_be_missed(changed, asked):
    assert all(demand.met for demand in demands(_fine()))
    missed = [demand.asked for demand in demands(_fine(**changed)) if not demand.met]
    assert len(missed) == 1
    assert missed[0].startswith(asked)


def test_a_short_run_shows_nothing_of_memory():
    assert [demand.met for demand in demands(_fine(hours=_fine().hours[:1]))].count(None) == 2
