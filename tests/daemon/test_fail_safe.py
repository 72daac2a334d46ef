"""No path to GO: what one drive shows; random ones are in tests.lab.stories.

The wire of `onlooker` plays the last moments of a good drive over and over, at 10 Hz, and spoils them as asked.
What it knows of its own deliveries judges every Traversability frame that the service sends.
"""

from __future__ import annotations

import pytest

from soilbus.decision.traversability import Status
from tests.lab.stories.onlooker import CONFIG, MOMENTS, Drive, good_moment, good_tracked

LEAD = 6.5
"""Seconds of good frames after which go is due."""


@pytest.fixture(scope="module")
def moment():
    return good_moment()


@pytest.fixture(scope="module")
def tracked():
    return good_tracked()


def test_a_good_drive_is_go_and_comes_back_to_go(moment, tracked):
    drive = Drive(moment, tracked)
    drive.run(LEAD)
    assert drive.go > 5
    for fault in ("deaf", "lost", "clock"):
        if fault == "clock":
            drive.step_clock(-5.0)
        else:
            setattr(drive.wire, fault, frozenset(drive.needed) if fault == "deaf" else True)
        drive.run(2.0)
        drive.wire.deaf, drive.wire.lost = frozenset(), False
        drive.run(7.0)
        before = drive.go
        drive.run(1.0)
        assert drive.go >= before + 9, fault
    assert not drive.faults


def test_sensors_that_always_say_the_same_are_named_and_never_go(moment, tracked):
    drive = Drive({i: messages[-1:] * MOMENTS for i, messages in moment.items()}, tracked)
    drive.run(LEAD + 2.0)
    assert drive.go == 0
    assert drive.result.status is Status.DEGRADED
    assert drive.result.reason.startswith("implausible torque.FL torque.FR")


def test_the_time_since_the_last_valid_posterior_grows_until_there_is_one(moment, tracked):
    drive = Drive(moment, tracked)
    drive.run(1.0)
    assert drive.last["SinceValid"] == "not_available"
    drive.run(LEAD)
    assert drive.last["SinceValid"] <= drive.last["Age"] < 1.2 + CONFIG.estimator.bin
    drive.wire.blind = True
    drive.run(4.0)
    assert str(drive.last["State"]) == "caution"
    assert drive.last["Age"] < 1.2
    assert drive.last["SinceValid"] == pytest.approx(4.5, abs=0.7)
    assert drive.result.traversability.since_valid == pytest.approx(4.0, abs=1.1)
    drive.wire.blind = False
    drive.run(1.2)
    assert drive.last["SinceValid"] < 1.2
    drive.step_clock(-5.0)
    drive.run(0.5)
    assert drive.last["SinceValid"] == "not_available"
    assert not drive.faults


def test_a_state_is_left_behind_and_recalled(moment, tracked):
    drive = Drive(moment, tracked)
    drive.run(LEAD)
    drive.stop()
    drive.start()
    known, elapsed = drive.recalled
    assert known.gains.tolist() == tracked.fit.mode.gains.tolist()
    assert 0.0 <= elapsed < 1.0
    drive.run(CONFIG.estimator.window - 0.2)  # all inputs good, but no whole window yet
    assert str(drive.last["State"]) == "unknown"
    assert not drive.faults
