"""A service on a faulty bus, and an onlooker who knows each fault and judges each decision of the service by it.

The bus repeats the last moments of a good drive at 10 Hz, with the faults of a story.  The tracker returns the true
soil at the end of each window, so whether the decision is GO depends on the delivered frames alone.
"""

from __future__ import annotations

import dataclasses
import errno
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import can
import numpy as np

from fakes import FakeClock, InlineExecutor, drive_messages, feed_message
from soilbus.can.bus import BusError, LiveBus
from soilbus.can.checksum import frame_checksum
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Publisher
from soilbus.config.model import Config
from soilbus.daemon.notify import Notifier
from soilbus.daemon.service import Service
from soilbus.daemon.state_persistence import StatePersistence
from soilbus.daemon.state_store import Owner
from soilbus.decision.traversability import Status
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.multistart import Fit
from soilbus.estimation.tracker import Tracker, TrackerOutput
from soilbus.estimation.window import Window
from soilbus.grouping import grouped
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.intake import WindowTask
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.sensors import sensors
from soilbus.terra.soils import SOILS

CONFIG = reference_configuration(["estimator.window=4.0", "traversability.max_age=2.0"])
OUT = output_database(CONFIG)
OWN = [(message.frame_id, message.is_extended_frame) for message in OUT.messages]
VERDICT, DEMAND, SLIP = (
    OUT.get_message_by_name(name).frame_id for name in ("Traversability", "DemandForecast", "WheelSlip")
)
SLIPPING = 0.15
"""Mean slip of the driven wheels beyond the forecast one with which no go may last."""
REACTION = 1.0
"""Time [s] for which it may: slips are means over some moments."""
NEEDED = ("torque", "speed", "load", "ground_speed", "draft", "pitch", "acceleration")
"""Quantities without which there is no go, where they are mapped."""
CYCLE, TICK = 0.1, 0.1
TIMEOUT = 1.0
SLACK = TICK + 0.06
"""The service looks at its inputs each tick; a window is handed out somewhat after its end."""
CLOCK_STEP = 1.0
MOMENTS = 4
"""Frames of each message that are repeated: a sensor that always says the same is not believed."""
HOLD = 2
"""Windows in a row that must speak for go after one that did not."""
WEAK = 0.05
"""Share of their torque that motors have left which cannot pull what is asked."""
BUS_OFF = 0x040
"""Class of the error frame that reports it."""

Moment = dict[int, list[can.Message]]


def needed_messages(config: Config, quantities: Sequence[str] = NEEDED) -> tuple[str, ...]:
    """The messages that bring these quantities, in the order of the configuration."""
    mapped = [sensor.mapped.signal for sensor in sensors(config) if sensor.quantity in quantities]
    return tuple(dict.fromkeys(signal.partition(".")[0] for signal in mapped))


def good_moment(config: Config = CONFIG) -> Moment:
    """The last frames of each message in a good drive."""
    found = grouped(drive_messages(config, 10.0), lambda message: message.arbitration_id)
    return {i: messages[-MOMENTS:] for i, messages in found.items()}


class MadePipeline(Pipeline):
    """A pipeline whose estimators are made by the caller."""

    def __init__(self, config: Config, make: Callable[[], WindowEstimator]) -> None:
        super().__init__(config, load_databases(config))
        self.make = make

    def new_estimator(self) -> WindowEstimator:
        return self.make()


class NotingTracker(Tracker):
    """A tracker that adds its results to `found`."""

    def __init__(self, found: list[TrackerOutput], *args: Any, **named: Any) -> None:
        self.found = found
        super().__init__(*args, **named)

    def estimate(self, window: Window, end: float) -> TrackerOutput:
        self.found.append(super().estimate(window, end))
        return self.found[-1]


def fit_of(tracked: TrackerOutput) -> Fit:
    """The fit of a window that has one."""
    assert tracked.fit is not None
    return tracked.fit


def good_tracked(config: Config = CONFIG) -> TrackerOutput:
    """What the tracker says of a window of a good drive."""
    limits = {"max_bearing_std": config.estimator.max_bearing_std}
    config = config.model_copy(update={"estimator": reference_configuration().estimator.model_copy(update=limits)})
    found: list[TrackerOutput] = []
    pipeline = MadePipeline(config, lambda: WindowEstimator(config, partial(NotingTracker, found)))
    messages = drive_messages(config, 40.0)  # the rear-driven one knows its largest draft after half a minute
    for message in messages:
        feed_message(pipeline.admission, message)
    results = pipeline.finish(messages[-1].timestamp)
    return next(t for t, r in zip(found, results, strict=True) if r.status is Status.VALID)


def of_soft_ground(tracked: TrackerOutput) -> TrackerOutput:
    """The same, as sure of it, of a ground that holds nothing."""
    soft = np.array(SOILS["wet_clay"]) * [0.05, 0.05, 1.0, 0.3, 0.2, 1.0]
    fit = fit_of(tracked)
    return dataclasses.replace(
        tracked, fit=dataclasses.replace(fit, mode=dataclasses.replace(fit.mode, soil=soft), form=None)
    )


def tracked_at(tracked: TrackerOutput, window: Window, **changed: Any) -> TrackerOutput:
    """The same of a window's own instants."""
    fit = fit_of(tracked)
    optimum = fit.optimum
    optimum = dataclasses.replace(optimum, t=optimum.t - optimum.t[-1] + window.t[-1])
    return dataclasses.replace(tracked, fit=dataclasses.replace(fit, optimum=optimum), **changed)


class Known(NamedTuple):
    """The truth when a frame of this stamp was delivered; firm: neither ground nor motors forbid what is asked."""

    stamp: float
    at: float
    soft: bool
    firm: bool
    blind: bool
    raises: bool


NOTHING = Known(-math.inf, -math.inf, soft=False, firm=False, blind=False, raises=False)


@dataclass
class Wire:
    """A bus with a vehicle on it; deaf, spoilt and repeated name messages."""

    clock: FakeClock
    moment: Moment
    config: Config = CONFIG
    cycle: float = CYCLE
    offset: float = 1.7e9 - 1000.0
    step: float = 0.0
    """By so much [s] the clock that stamps frames has been set; only the next frame can show it."""
    set_back: Callable[[], None] = lambda: None
    """Called when a frame has shown that it was set back."""
    deaf: frozenset[str] = frozenset()
    spoilt: frozenset[str] = frozenset()
    repeated: frozenset[str] = frozenset()
    noisy: bool = False
    lost: bool = False
    off: bool = False
    """The controller is in bus-off: it has said so, and hears nothing."""
    halted: bool = False
    """The clock that stamps frames stands."""
    forged: bool = False
    """Another node says go under our identifier, ten times a second."""
    blind: bool = False
    soft: bool = False
    raises: bool = False
    """No model fits the ground; it holds nothing; it makes the estimator fail."""
    power: float = 1.0
    """Share of their torque that the motors have."""
    mute_from: float = math.inf
    """When the motors begin not to say how much torque they have."""
    good: dict[str, float] = field(default_factory=dict)
    stamps: dict[str, float] = field(default_factory=dict)
    powers: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Shares of its torque that each motor has sent last; one may be an outlier."""
    heard: list[Known] = field(default_factory=list)
    """What was so at each delivery since the clock was set back last."""
    forged_at: float = -math.inf
    said: dict[int, dict[str, Any]] = field(default_factory=dict)
    """What the service has sent last of forecast and slips."""
    verdicts: list[tuple[float, dict[str, Any]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        database = load_databases(self.config)
        names = {m.frame_id: m.name for m in database.messages}
        self.known = [(names.get(i, "?"), m) for i, m in sorted(self.moment.items())]
        self.motors = needed_messages(self.config, ["torque_limit"])
        self.checked = {m.name for m in database.messages if "Checksum" in {s.name for s in m.signals}}
        self.counter = self.next = self.life = 0
        self.base, self.halted_at, self.newest = self.clock.now, math.nan, -math.inf
        self.off_reported = False
        self.counters: dict[str, int] = {}

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.lost:
            raise can.CanOperationError("Network is down", errno.ENETDOWN)
        while True:
            if self.off and not self.off_reported:
                self.off_reported = True
                return can.Message(timestamp=self.stamp(), arbitration_id=BUS_OFF, is_error_frame=True, data=bytes(8))
            cycle, row = divmod(self.next, len(self.known))
            due = self.base + self.cycle * cycle + 0.002 * row
            if due > self.clock.now + (timeout or 0.0):
                self.clock.sleep(max(timeout or 0.0, 1e-4))
                return None
            if due < self.clock.now - 0.5:  # nobody listened
                self.base = self.clock.now - self.cycle * cycle
                continue
            self.next += 1
            self.counter = cycle % 16
            self.clock.now = max(self.clock.now, due)
            if self.off:
                continue
            self.off_reported = False
            name, messages = self.known[row]
            if self.forged and row == 0 and self.forged_at < self.clock.now - 0.5 * self.cycle:
                self.next -= 1
                self.forged_at = self.clock.now
                return can.Message(timestamp=self.stamp(), arbitration_id=VERDICT, data=bytes(8))
            if name not in self.deaf:
                return self.frame(name, messages[cycle % len(messages)])
            if self.noisy:
                return can.Message(timestamp=self.stamp(), arbitration_id=0x123, is_extended_id=False, data=b"\x5a" * 3)

    def stamp(self, listened: bool = False) -> float:
        """Of the next frame; only one to which the service listens shows that the clock was set back."""
        step, self.step = self.step, 0.0
        self.offset += step
        if self.halted and math.isnan(self.halted_at):
            self.halted_at = self.clock.now
        if not self.halted:
            self.halted_at = math.nan
        stamp = (self.halted_at if self.halted else self.clock.now) + self.offset
        if not listened:
            return stamp
        if stamp < self.newest - CLOCK_STEP:
            self.life, self.newest = self.life + 1, -math.inf
            self.good, self.stamps, self.heard = {}, {}, []
            self.set_back()
        self.newest = max(self.newest, stamp)
        weak = len(self.powers) == len(self.motors) and max(max(sent) for sent in self.powers.values()) <= WEAK
        firm = not (self.soft or weak)
        self.heard.append(Known(stamp, self.clock.now, self.soft, firm, self.blind, self.raises))
        return stamp

    def unheard(self, name: str) -> float:
        """Time [s] since a good frame of this name, less what the clock that stamps frames has lost since."""
        if name not in self.good:
            return math.inf
        last = self.heard[-1]
        lost = (self.stamps[name] - self.good[name]) - (last.stamp - last.at)
        return self.clock.now - self.good[name] - max(lost, 0.0)

    def until(self, stamp: float) -> Known:
        """What was so when the last frame older than a stamp of the clock, as it is set now, was delivered."""
        return next((known for known in reversed(self.heard) if known.stamp < stamp), NOTHING)

    def frame(self, name: str, message: can.Message) -> can.Message:
        data, checked = bytearray(message.data), name in self.checked
        good = name not in self.spoilt
        if name in self.motors:
            limit = int.from_bytes(data[4:6], "little")
            data[4:6] = (
                b"\xff\xff" if self.clock.now >= self.mute_from else int(limit * self.power).to_bytes(2, "little")
            )
        if checked:
            counter = 5 if name in self.repeated else self.counter
            good = good and counter != self.counters.get(name)
            self.counters[name] = counter
            data[6] = data[6] & 0x0F | counter << 4
            data[7] = frame_checksum(message.arbitration_id, bytes(data), 7)
        if name in self.spoilt:
            data = bytearray(b ^ 0x5A for b in data) if checked else bytearray(b"\xff" * 8)
        stamp = self.stamp(listened=True)
        if good and stamp >= self.stamps.get(name, -math.inf):
            self.good[name], self.stamps[name] = self.clock.now, stamp
            if name in self.motors and self.clock.now < self.mute_from:
                self.powers[name] = self.powers.get(name, (1.0, 1.0))[1], self.power
        return can.Message(
            timestamp=stamp, arbitration_id=message.arbitration_id, is_extended_id=message.is_extended_id, data=data
        )

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        if message.arbitration_id not in (VERDICT, DEMAND, SLIP):
            return
        values = OUT.decode_message(message.arbitration_id, bytes(message.data))
        assert isinstance(values, dict)
        self.said[message.arbitration_id] = values
        if message.arbitration_id == VERDICT:
            self.verdicts.append((self.clock.now, values | {"Warning": self.said[DEMAND]["Warning"]}))

    def shutdown(self) -> None:
        pass


class Worker(InlineExecutor):
    """One thread: each piece of work takes `takes` [s], for ever while it hangs; all of it in its order.

    `handed_in` is called with what is handed in.
    """

    def __init__(self, clock: FakeClock, handed_in: Callable[..., None]) -> None:
        self.clock, self.handed_in = clock, handed_in
        self.hangs, self.takes = False, 0.0
        self.left: list[tuple[Future[Any], Callable[..., Any], tuple[Any, ...]]] = []
        self.busy_until = -math.inf

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.handed_in(*args)
        if not self.left:
            self.busy_until = self.clock.now + self.takes
        self.left.append((Future(), fn, args))
        found = self.left[-1][0]
        self.work()
        return found

    def work(self) -> None:
        """What is done by now."""
        while self.left and not self.hangs and self.busy_until <= self.clock.now:
            future, fn, args = self.left.pop(0)
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(fn(*args))
            except Exception as error:
                future.set_exception(error)
            self.busy_until = max(self.busy_until, self.clock.now - TICK) + self.takes

    def wake(self) -> None:
        """Go on, and do at once what was left undone."""
        self.hangs, self.takes, self.busy_until = False, 0.0, -math.inf
        self.work()


class Handed(NamedTuple):
    """A window that the worker got: after how many steps back of the clock, its end, and the truth at its end."""

    life: int
    ended: float
    known: Known
    fresh: bool


NO_WINDOW = Handed(-1, -math.inf, NOTHING, True)


class TrueTracker(Tracker):
    """A tracker that says of each window what a drive knows to be true, and shows the drive what it recalls."""

    def __init__(self, drive: Drive, *args: Any, **named: Any) -> None:
        self.drive = drive
        super().__init__(*args, **named)

    def start_from_last_run(self, gaussian: Gaussian, elapsed: float) -> None:
        self.drive.recalled = gaussian, elapsed

    def estimate(self, window: Window, end: float) -> TrackerOutput:
        tracked = self.drive.truth(window, end)
        self.newest_posterior = fit_of(tracked).mode
        return tracked


class Drive:
    """A service on a wire, and what an onlooker knows of its windows.

    `tracked` is what the tracker says of every window on firm ground; None: a real one, which finds out.
    """

    def __init__(
        self, moment: Moment, tracked: TrackerOutput | None, config: Config = CONFIG, cycle: float = CYCLE
    ) -> None:
        self.clock, self.config = FakeClock(), config
        self.max_age = config.traversability.max_age
        self.needed = needed_messages(config)
        self.tracked = tracked
        self.of_soft = None if tracked is None else of_soft_ground(tracked)
        self.wire = Wire(self.clock, moment, config, cycle, set_back=self.forget)
        self.folder = TemporaryDirectory()
        self.faults: list[str] = []
        self.result: WindowResult | None = None
        self.go = 0
        self.last: dict[str, Any] = {}
        self.interrupted = self.halted_until = -math.inf
        self.slips_since = math.inf
        self.recalled: tuple[Gaussian, float] | None = None
        """What the service took over from the one before, and its age [s]."""
        self.start()

    def start(self) -> None:
        """A service that begins with the state that the one before has left behind."""
        pipeline = MadePipeline(self.config, self.estimator)
        owner = Owner.of(self.config, pipeline.intake.channels, load_databases(self.config))
        persistence = StatePersistence(
            Path(self.folder.name), owner, InlineExecutor(), lambda: self.clock.now + self.wire.offset
        )
        bus = LiveBus(self.open, self.clock, self.clock.sleep, OWN)
        self.handed: dict[float, Handed] = {}
        self.lives: dict[int, int] = {}
        self.forget()
        self.worker = Worker(self.clock, self.note)
        self.wire.good, self.wire.stamps, self.wire.powers, self.wire.counters = {}, {}, {}, {}
        self.service = Service(
            self.config, pipeline, bus, Publisher(OUT), Notifier(), self.worker, self.clock, self.take,
            lambda: persistence, self.clock.wait_for,
        )  # fmt: skip

    def stop(self) -> None:
        self.service.stop()
        self.service.run()

    def estimator(self) -> WindowEstimator:
        """One whose tracker says of each window what is true of the ground at its end, or a real one."""
        return WindowEstimator(self.config, Tracker if self.tracked is None else partial(TrueTracker, self))

    def truth(self, window: Window, end: float) -> TrackerOutput:
        """What the tracker says of a window."""
        known = self.handed[end].known
        if known.raises:
            raise ZeroDivisionError
        tracked = self.of_soft if known.soft else self.tracked
        assert tracked is not None
        return tracked_at(tracked, window, since=end - (0.0 if known.blind else self.config.estimator.window))

    def open(self) -> Wire:
        if self.wire.lost:
            raise BusError("bus can0: no such device", may_come=True)
        return self.wire

    def note(self, task: object = None) -> None:
        """The worker got something."""
        if isinstance(task, WindowTask):
            known = self.wire.until(task.end)
            ended = min(known.at + task.end - known.stamp, self.clock.now)
            self.handed[task.end] = Handed(self.wire.life, ended, known, task.fresh)
            self.lives[task.index % 251] = self.wire.life

    def take(self, result: WindowResult) -> None:
        """The service publishes a window."""
        window = self.handed[result.t]
        if window.fresh or result.traversability.probability is None:
            self.in_a_row = math.inf  # nothing is held back by what is not known
        if result.traversability.probability is not None:
            self.in_a_row = self.in_a_row + 1 if window.known.firm and not window.known.blind else 0
        if window.life == self.wire.life:
            self.result, self.window = result, window

    def forget(self) -> None:
        """The service restarts, or must."""
        self.result, self.window, self.in_a_row = None, NO_WINDOW, math.inf

    def step_clock(self, by: float) -> None:
        self.wire.step += by

    def run(self, seconds: float) -> None:
        end = self.clock.now + seconds
        while self.clock.now < end:
            self.worker.work()
            self.service.step()
            self.look()
            for at, verdict in self.wire.verdicts:
                self.last = verdict
                self.go += str(verdict["State"]) == "go"
                said = f"{verdict['State']} at {at - 1000.0:.2f} s although"
                self.faults += [f"{said} {why}" for why in self.objections(at, verdict)]
            self.wire.verdicts.clear()

    def excess_slip(self) -> float:
        """Mean slip of the driven wheels beyond the forecast one; nan where either is not known."""
        slips, demand = self.wire.said.get(SLIP, {}), self.wire.said.get(DEMAND, {})
        driven = [slips.get(f"SlipWheel{i + 1}") for i, wheel in enumerate(self.config.wheel) if wheel.driven]
        known = [slip for slip in driven if isinstance(slip, float)]
        forecast = demand.get("Slip")
        return sum(known) / len(known) - forecast if known and isinstance(forecast, float) else math.nan

    def look(self) -> None:
        """Note what makes all earlier windows void."""
        now = self.clock.now
        if not self.excess_slip() > SLIPPING:  # nor nan
            self.slips_since = math.inf
        self.slips_since = min(self.slips_since, now)
        if self.wire.halted:
            self.halted_until = now + SLACK
        patience = self.max_age if now < self.halted_until else TIMEOUT  # stamps that stand cannot say what is late
        stale = any(not self.wire.unheard(name) <= patience + SLACK for name in self.needed)
        if stale or self.wire.lost or self.wire.off:
            self.interrupted = now
        self.interrupted = max(self.interrupted, self.wire.forged_at)

    def objections(self, at: float, verdict: dict[str, Any]) -> Iterator[str]:
        """Why a verdict must not be."""
        window = verdict["Window"]
        if isinstance(window, int | float) and self.lives.get(int(window)) != self.wire.life:
            yield f"window {window} is of before the step of the clock"
        if str(verdict["State"]) != "go":
            return
        if self.interrupted >= at - 1e-9:
            yield "inputs are stale, or the bus is down or not ours alone"
        if self.result is None:
            yield "there is no window since the start or the step of the clock"
            return
        if str(verdict["Warning"]) == "immobilisation":
            yield "immobilisation is warned of"
        if at - self.slips_since > REACTION:
            yield f"the driven wheels have slipped more than forecast for {at - self.slips_since:.1f} s"
        age, known = at - self.window.ended, self.window.known
        if self.window.ended <= self.interrupted:
            yield "the last window is of before an interruption"
        if not known.firm:
            yield "the ground or the motors cannot bear it"
        if known.blind or known.raises or self.result.status is not Status.VALID:
            yield f"the posterior is {self.result.status}"
        if self.in_a_row < HOLD:
            yield f"only {self.in_a_row} window in a row speaks for it"
        if age > self.max_age + SLACK:
            yield f"the posterior is {age:.2f} s old"
        if not all(isinstance(verdict[a], float) and verdict[a] <= self.max_age for a in ("Age", "SinceValid")):
            yield f"its own ages are {verdict['Age']} and {verdict['SinceValid']}"
