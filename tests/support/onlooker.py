"""A service on a spoilt wire, and an onlooker who judges each verdict by what he knows of the wire's deliveries."""

from __future__ import annotations

import dataclasses
import errno
import math
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import can

from fakes import FakeClock, InlineExecutor
from soilbus.can.bus import BusError, LiveBus
from soilbus.can.checksum import frame_checksum
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Publisher
from soilbus.config import Config
from soilbus.daemon.estimator import WindowEstimator
from soilbus.daemon.keeper import Keeper
from soilbus.daemon.notify import Notifier
from soilbus.daemon.pipeline import Pipeline
from soilbus.daemon.service import Service
from soilbus.daemon.store import Owner
from soilbus.simulator.reference import reference_configuration
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


@dataclass
class Wire:
    """A bus with a vehicle on it; deaf, spoilt and repeated name messages, blind tells the tracker to fail."""

    clock: FakeClock
    moment: dict[int, list[can.Message]]
    offset: float = 1.7e9 - 1000.0
    step: float = 0.0
    """By so much [s] the clock that stamps frames has been set; only the next frame can tell of it."""
    known_anew: Callable[[], None] = lambda: None
    """Called when a frame has told that it was set back."""
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
        step, self.step = self.step, 0.0
        self.offset += step
        if step < -CLOCK_STEP:
            self.good, self.stamps = {}, {}
            self.known_anew()
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
        self.wire = Wire(self.clock, moment, known_anew=self.forget)
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
            config, pipeline, bus, Publisher(OUT), Notifier(), self.worker, self.clock, self.take, lambda: keeper,
            self.clock.wait_for,
        )  # fmt: skip

    def stop(self) -> None:
        self.service.stop()
        self.service.run()

    def content(self, estimator: WindowEstimator) -> None:
        def estimate(window, end):
            estimator.tracker._newest = self.tracked.fit.whole
            old = self.tracked.fit.optimum
            optimum = dataclasses.replace(old, t=old.t - old.t[-1] + window.t[-1])  # of the window's own instants
            fit = dataclasses.replace(self.tracked.fit, optimum=optimum)
            return dataclasses.replace(
                self.tracked, fit=fit, since=end - CONFIG.estimator.window, mismatch=self.wire.blind
            )

        estimator._tracker.estimate = estimate

    def open(self):
        if self.wire.lost:
            raise BusError("bus can0: no such device", may_come=True)
        return self.wire

    def take(self, result) -> None:
        self.result, self.came = result, self.clock.now

    def forget(self) -> None:
        self.result = None

    def step_clock(self, by: float) -> None:
        self.wire.step += by

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
