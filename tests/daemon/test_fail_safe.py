"""No path to GO: arbitrary sequences of good, stale, refused and missing frames, clock steps, lost buses, restarts.

The wire of `onlooker` plays the last moments of a good drive over and over, at 10 Hz, and spoils them as told.
What it knows of its own deliveries judges every Traversability frame that the service
sends.  The soil comes from a tracker that is always content with its fit unless it is
told to fail: GO then hangs on the inputs alone, as often as the loop lets it.
"""

from __future__ import annotations

import can
import pytest
from hypothesis import HealthCheck, Phase, example, find, given, settings
from hypothesis import strategies as st
from hypothesis.errors import NoSuchExample

from feeding import feed_message
from onlooker import CONFIG, MOMENTS, NEEDED, Drive
from soilbus.can.dbc_files import load_databases
from soilbus.daemon.intake import Intake
from soilbus.daemon.pipeline import Pipeline
from soilbus.daemon.service import Service
from soilbus.daemon.states import ServiceState
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.traversability import State as Way
from soilbus.traversability import Status, Traversability

LEAD = 6.5
"""Seconds of good frames after which go is due."""


@pytest.fixture(scope="module")
def moment() -> dict[int, list[can.Message]]:
    """The last frames of each message in a good drive."""
    recording = simulate(reference_configuration(), excited("loam", 10.0), seed=3)
    found: dict[int, list[can.Message]] = {}
    for message in frames(recording, reference_configuration()):
        found.setdefault(message.arbitration_id, []).append(message)
    return {i: messages[-MOMENTS:] for i, messages in found.items()}


@pytest.fixture(scope="module")
def tracked():
    """What the tracker says of a window of a good drive."""
    config = reference_configuration()
    pipeline = Pipeline(config, load_databases(config))
    estimator, found = pipeline.estimator, []
    usual = estimator._tracker.estimate
    estimator._tracker.estimate = lambda *given: found.append(usual(*given)) or found[-1]
    messages = list(frames(simulate(config, excited("loam", 12.0), seed=3), config))
    for message in messages:
        feed_message(pipeline.admission, message)
    results = pipeline.finish(messages[-1].timestamp)
    return next(t for t, r in zip(found, results, strict=True) if r.status is Status.VALID)


SECONDS = st.floats(0.2, 3.0)
SOME = st.frozensets(st.sampled_from(NEEDED), min_size=1, max_size=len(NEEDED))
EVENTS = st.one_of(
    st.tuples(st.just("good"), st.none(), st.floats(0.2, 6.0)),
    st.tuples(st.sampled_from(["deaf", "noisy", "spoilt", "repeated"]), SOME, SECONDS),
    st.tuples(st.sampled_from(["blind", "hangs"]), st.none(), st.floats(0.2, 5.0)),
    st.tuples(st.just("down"), st.none(), SECONDS),
    st.tuples(st.just("clock"), st.sampled_from([-3600.0, -5.0, -1.5, -0.6, 0.4, 2.0, 70.0, 3600.0]), SECONDS),
    st.tuples(st.sampled_from(["restart", "killed"]), st.none(), SECONDS),
)
STORIES = st.lists(EVENTS, min_size=1, max_size=5)


def told(story, moment, tracked) -> Drive:
    """The drive after a good start and the events."""
    drive = Drive(moment, tracked)
    wire = drive.wire
    drive.run(LEAD)
    for kind, what, seconds in story:
        match kind:
            case "deaf":
                wire.deaf = what
            case "noisy":
                wire.deaf, wire.noisy = what, True
            case "spoilt":
                wire.spoilt = what
            case "repeated":
                wire.repeated = what
            case "blind":
                wire.blind = True
            case "hangs":
                drive.worker.hangs = True
            case "down":
                wire.lost = True
            case "clock":
                drive.step_clock(what)
            case "restart":
                drive.stop()
                drive.start()
            case "killed":
                drive.start()
        drive.run(seconds)
        wire.deaf = wire.spoilt = wire.repeated = frozenset()
        wire.noisy = wire.blind = wire.lost = False
        drive.worker.wake()
    drive.run(0.5)
    return drive


def test_a_good_drive_is_go_and_comes_back_to_go(moment, tracked):
    drive = Drive(moment, tracked)
    drive.run(LEAD)
    assert drive.go > 5
    for story in ([("deaf", frozenset(NEEDED), 2.0)], [("down", None, 1.0)], [("clock", -5.0, 0.2)]):
        drive = told([*story, ("good", None, 7.0)], moment, tracked)
        before = drive.go
        drive.run(1.0)
        assert drive.go >= before + 9, story
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


@settings(derandomize=True, deadline=None, max_examples=20, suppress_health_check=[HealthCheck.too_slow])
@example(story=[("restart", None, 1.0)])
@example(story=[("restart", None, 0.5), ("down", None, 0.4), ("restart", None, 3.0)])
@example(story=[("clock", -5.0, 3.0)])
@example(story=[("clock", -1.5, 3.0)])
@example(story=[("deaf", frozenset(["WheelLoads"]), 1.6), ("down", None, 0.4)])
@given(story=STORIES)
def test_go_is_never_sent_without_fresh_admitted_inputs_and_a_valid_young_posterior(story, moment, tracked):
    assert told(story, moment, tracked).faults == []


def without_stale_check(monkeypatch):
    monkeypatch.setattr(Intake, "stale", lambda self, now: [])


def without_age_check(monkeypatch):
    monkeypatch.setattr(Service, "_present_time", lambda self, now: self.result.t if self.result else now)


def without_memory_of_epochs(monkeypatch):
    monkeypatch.setattr(Intake, "epoch", property(lambda self: 1, lambda self, value: None), raising=False)


def with_any_status(monkeypatch):
    monkeypatch.setattr("soilbus.hysteresis.state_of", lambda p, status, settings: "go")


def with_the_verdict_of_the_run_before(monkeypatch):
    """What was known when the service was stopped is taken for known now, as soon as the inputs are there."""
    usual = Service.present_way

    def present_way(self, now):
        knows = self.result is None and self._keeper.recalled is not None
        return Traversability(Way.GO) if knows and self._state[0] is ServiceState.ESTIMATING else usual(self, now)

    monkeypatch.setattr(Service, "present_way", present_way)


def test_a_state_is_left_behind_and_recalled(moment, tracked):
    drive = Drive(moment, tracked)
    drive.run(LEAD)
    drive.stop()
    drive.start()
    known, elapsed = drive.service._solver.estimator.tracker._recalled
    assert known.gains.tolist() == tracked.fit.whole.gains.tolist()
    assert 0.0 <= elapsed < 1.0
    drive.run(CONFIG.estimator.window - 0.2)  # all inputs good, but no whole window yet
    assert str(drive.last["State"]) == "unknown"
    assert not drive.faults


@pytest.mark.parametrize(
    ("mutation", "stories"),
    [
        (without_stale_check, st.lists(st.tuples(st.just("deaf"), SOME, SECONDS), min_size=1, max_size=2)),
        (without_age_check, st.lists(st.tuples(st.just("hangs"), st.none(), st.floats(1.0, 5.0)), min_size=1)),
        (without_memory_of_epochs, st.lists(st.tuples(st.just("clock"), st.just(-5.0), SECONDS), min_size=1)),
        (with_the_verdict_of_the_run_before, st.lists(st.tuples(st.just("restart"), st.none(), SECONDS), min_size=1)),
        (with_any_status, st.lists(st.tuples(st.just("blind"), st.none(), SECONDS), min_size=1)),
    ],
)
def test_a_service_without_a_check_is_found_out(mutation, stories, moment, tracked, monkeypatch):
    mutation(monkeypatch)
    quick = settings(derandomize=True, deadline=None, max_examples=12, database=None, phases=[Phase.generate])
    try:
        story = find(stories, lambda told_so: bool(told(told_so, moment, tracked).faults), settings=quick)
    except NoSuchExample:
        pytest.fail("nothing found")
    assert story
