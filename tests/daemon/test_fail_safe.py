"""No path to GO: arbitrary sequences of good, stale, refused and missing frames, clock steps, lost buses, restarts.

A wire plays the last moments of a good drive over and over, at 10 Hz, and spoils them as told.
What it knows of its own deliveries judges every Traversability frame that the service
sends.  The soil comes from a tracker that is always content with its fit unless it is
told to fail: GO then hangs on the inputs alone, as often as the loop lets it.
"""

from __future__ import annotations

import dataclasses
import errno
import math
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import can
import pytest
from hypothesis import HealthCheck, Phase, example, find, given, settings
from hypothesis import strategies as st
from hypothesis.errors import NoSuchExample

from fakes import FakeClock, InlineExecutor
from soilbus.can.bus import BusError, LiveBus
from soilbus.can.checksum import frame_checksum
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Publisher
from soilbus.config import Config
from soilbus.daemon.estimator import WindowEstimator
from soilbus.daemon.intake import Intake
from soilbus.daemon.keeper import Keeper
from soilbus.daemon.notify import Notifier
from soilbus.daemon.pipeline import Pipeline
from soilbus.daemon.service import Service
from soilbus.daemon.states import ServiceState
from soilbus.daemon.store import Owner
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.traversability import State as Way
from soilbus.traversability import Status

CONFIG = reference_configuration(["estimator.window=4.0", "traversability.max_age=2.0"])
OUT = output_database(CONFIG)
IN = load_databases(CONFIG)
VERDICT = OUT.get_message_by_name("Traversability").frame_id
NEEDED = (
    "MotorFL", "MotorFR", "MotorRL", "MotorRR", "WheelSpeeds", "WheelLoads", "DrawbarPin", "Attitude",
    "GroundBasedSpeedAndDistance",
)  # fmt: skip
CYCLE, TICK = 0.1, 0.1
TIMEOUT, MAX_AGE = 1.0, 2.0
SLACK = TICK + 0.06
"""The service looks at its inputs each tick; a window is handed out somewhat after its end."""
CLOCK_STEP = 1.0
MOMENTS = 4
"""Frames of each message that are repeated: a sensor that always says the same is not believed."""
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
        pipeline.admission.feed_message(message)
    results = pipeline.finish(messages[-1].timestamp)
    return next(t for t, r in zip(found, results, strict=True) if r.status is Status.VALID)


@dataclass
class Wire:
    """A bus with a vehicle on it; deaf, spoilt and repeated name messages, blind tells the tracker to fail."""

    clock: FakeClock
    moment: dict[int, list[can.Message]]
    offset: float = 1.7e9 - 1000.0
    deaf: frozenset[str] = frozenset()
    spoilt: frozenset[str] = frozenset()
    repeated: frozenset[str] = frozenset()
    noisy: bool = False
    blind: bool = False
    lost: bool = False
    good: dict[str, float] = field(default_factory=dict)
    stamps: dict[str, float] = field(default_factory=dict)
    verdicts: list[tuple[float, dict]] = field(default_factory=list)

    def __post_init__(self) -> None:
        names = {m.frame_id: m.name for m in IN.messages}
        self.known = [(names.get(i, "?"), m) for i, m in sorted(self.moment.items())]
        self.counter, self.next = 0, 0
        self.base = self.clock.now

    def recv(self, timeout=None):
        if self.lost:
            raise can.CanOperationError("Network is down", errno.ENETDOWN)
        while True:
            cycle, row = divmod(self.next, len(self.known))
            due = self.base + CYCLE * cycle + 0.002 * row
            if due > self.clock.now + (timeout or 0.0):
                self.clock.sleep(max(timeout or 0.0, 1e-4))
                return None
            if due < self.clock.now - 0.5:  # nobody listened
                self.base = self.clock.now - CYCLE * cycle
                continue
            self.next += 1
            self.counter = cycle % 16
            self.clock.now = max(self.clock.now, due)
            name, messages = self.known[row]
            message = messages[cycle % MOMENTS]
            if name not in self.deaf:
                return self.frame(name, message)
            if self.noisy:
                return can.Message(timestamp=self.stamp(), arbitration_id=0x123, is_extended_id=False, data=b"\x5a" * 3)

    def stamp(self) -> float:
        return self.clock.now + self.offset

    def frame(self, name: str, message: can.Message) -> can.Message:
        data, checked = bytearray(message.data), "Checksum" in {s.name for s in IN.get_message_by_name(name).signals}
        good = name not in self.spoilt
        if checked:
            counter = 5 if name in self.repeated else self.counter
            good = good and name not in self.repeated
            data[6] = data[6] & 0x0F | counter << 4
            data[7] = frame_checksum(message.arbitration_id, bytes(data), 7)
        if name in self.spoilt:
            data = bytearray(b ^ 0x5A for b in data) if checked else bytearray(b"\xff" * 8)
        stamp = self.stamp()
        if good and stamp >= self.stamps.get(name, -math.inf):
            self.good[name], self.stamps[name] = self.clock.now, stamp
        return can.Message(
            timestamp=stamp, arbitration_id=message.arbitration_id, is_extended_id=message.is_extended_id, data=data
        )

    def send(self, message, timeout=None) -> None:
        if message.arbitration_id == VERDICT:
            self.verdicts.append((self.clock.now, OUT.decode_message(VERDICT, bytes(message.data))))

    def shutdown(self) -> None:
        pass


class Worker(InlineExecutor):
    """Does the work at once unless it hangs; what was left undone is then done first."""

    def __init__(self) -> None:
        self.hangs, self.left = False, []

    def submit(self, fn, /, *args, **kwargs):
        if not self.hangs:
            return super().submit(fn, *args, **kwargs)
        self.left.append((Future(), fn, args))
        return self.left[-1][0]

    def wake(self) -> None:
        self.hangs = False
        for future, fn, args in self.left:
            if future.set_running_or_notify_cancel():
                future.set_result(fn(*args))
        self.left.clear()


class Drive:
    """A service on a wire, and what an onlooker knows of its windows."""

    def __init__(self, moment, tracked) -> None:
        self.clock, self.tracked = FakeClock(), tracked
        self.wire = Wire(self.clock, moment)
        self.folder = TemporaryDirectory()
        self.faults: list[str] = []
        self.go = 0
        self.start()

    def start(self) -> None:
        """A service that begins with the state that the one before has left behind."""
        config: Config = CONFIG
        pipeline = Pipeline(config, IN)
        self.content(pipeline.estimator)
        owner = Owner.of(config, pipeline.intake.channels, IN)
        keeper = Keeper(Path(self.folder.name), owner, InlineExecutor(), lambda: self.clock.now + self.wire.offset)
        bus = LiveBus(self.open, self.clock, self.clock.sleep)
        self.result = None
        self.came = -math.inf
        self.worker = Worker()
        self.wire.good, self.wire.stamps = {}, {}
        self.service = Service(
            config, pipeline, bus, Publisher(OUT), Notifier(), self.worker, self.clock, self.take, keeper
        )  # fmt: skip

    def stop(self) -> None:
        self.service.stop()
        self.service.run()

    def content(self, estimator: WindowEstimator) -> None:
        def estimate(window, end):
            estimator.tracker._beliefs = [(end, self.tracked.fit.whole)]
            return dataclasses.replace(self.tracked, since=end - CONFIG.estimator.window, mismatch=self.wire.blind)

        estimator._tracker.estimate = estimate

    def open(self):
        if self.wire.lost:
            raise BusError("bus can0: no such device", may_come=True)
        return self.wire

    def take(self, result) -> None:
        self.result, self.came = result, self.clock.now

    def step_clock(self, by: float) -> None:
        self.wire.offset += by
        if by < -CLOCK_STEP:
            self.result = None
            self.wire.good, self.wire.stamps = {}, {}

    def run(self, seconds: float) -> None:
        end = self.clock.now + seconds
        while self.clock.now < end:
            self.service.step()
            for at, verdict in self.wire.verdicts:
                self.last = verdict
                if str(verdict["State"]) == "go":
                    self.go += 1
                    self.faults += [f"go at {at - 1000.0:.2f} s although {why}" for why in self.objections(at, verdict)]
            self.wire.verdicts.clear()

    def objections(self, at: float, verdict: dict):
        for name in NEEDED:
            if not at - self.wire.good.get(name, -math.inf) <= TIMEOUT + SLACK:
                yield f"{name} is stale"
        if self.wire.lost:
            yield "the bus is down"
        if self.result is None:
            yield "there is no window since the start or the step of the clock"
            return
        if self.result.status is not Status.VALID:
            yield f"the posterior is {self.result.status}"
        for age in (at - self.came, at + self.wire.offset - self.result.t):
            if age > MAX_AGE + SLACK:
                yield f"the posterior is {age:.2f} s old"
        if not (verdict["Age"] <= MAX_AGE and verdict["SinceValid"] <= MAX_AGE):
            yield f"its own ages are {verdict['Age']} and {verdict['SinceValid']}"


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
    assert drive.last["SinceValid"] == drive.last["Age"] < 1.2
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
    monkeypatch.setattr(Service, "_age", lambda self, now: 0.0)


def without_memory_of_epochs(monkeypatch):
    monkeypatch.setattr(Intake, "epoch", property(lambda self: 1, lambda self, value: None), raising=False)


def with_any_status(monkeypatch):
    monkeypatch.setattr("soilbus.hysteresis.state_of", lambda p, status, settings: "go")


def with_the_verdict_of_the_run_before(monkeypatch):
    """What was known when the service was stopped is taken for known now, as soon as the inputs are there."""
    usual = Service.present_way

    def present_way(self, now):
        knows = self.result is None and self._keeper.recalled is not None
        return Way.GO if knows and self._state[0] is ServiceState.ESTIMATING else usual(self, now)

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
