"""Scripted bus, clock and workers for tests, a service on them, and the frames of a simulated drive."""

import errno
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor, Future
from dataclasses import replace
from typing import Any

import can

from soilbus.can.admission import Admission
from soilbus.can.bus import BusError, LiveBus
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Frame, Publisher
from soilbus.config.model import Config
from soilbus.daemon.notify import Notifier
from soilbus.daemon.service import Service
from soilbus.daemon.state_persistence import StatePersistence
from soilbus.offline.played_bus import InlineExecutor, PlayedClock
from soilbus.pipeline.intake import Intake
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited

__all__ = [
    "Bench", "FakeClock", "HeldExecutor", "InlineExecutor", "Notes", "ScriptedBus", "drive_messages", "fed",
    "feed_message", "in_reverse", "message_of", "sent_by",
]  # fmt: skip

FakeClock = PlayedClock


def drive_messages(config: Config, seconds: float, seed: int = 3) -> list[can.Message]:
    """Frames of a good drive on loam: draft swings, slip is what the soil asks for."""
    return list(frames(simulate(config, excited("loam", seconds), seed), config))


def message_of(frame: Frame, t: float = 0.0) -> can.Message:
    """A frame as python-can hands it out, with a stamp [s]."""
    return can.Message(timestamp=t, arbitration_id=frame.arbitration_id, is_extended_id=frame.extended, data=frame.data)


def sent_by(publisher: Publisher, values: Mapping[str, Mapping[str, Any]], t: float) -> list[can.Message]:
    """The frames of these messages with these values, all at one time [s]."""
    return [message_of(publisher.frame(name, of_frame), t) for name, of_frame in values.items()]


def in_reverse(recording: Recording) -> Recording:
    """The same readings with the signs of a drive backward."""
    turned = ("speed", "motor_speed", "torque", "draft", "pitch", "acceleration")
    return replace(recording, channels={
        name: replace(c, value=-c.value) if name.partition(".")[0] in turned else c
        for name, c in recording.channels.items()
    })  # fmt: skip


def feed_message(admission: Admission, message: can.Message) -> None:
    """One data or remote frame of python-can into an admission."""
    admission.feed(
        message.timestamp, message.arbitration_id, message.is_extended_id, message.data, message.is_remote_frame
    )


def fed(config: Config, messages: Iterable[can.Message]) -> tuple[Intake, float]:
    """An intake that has taken these messages, and the time of the last one [s]."""
    intake, last = Intake(config, load_databases(config)), 0.0
    for message in messages:
        feed_message(intake.admission, message)
        last = message.timestamp
    intake.ingest()
    return intake, last


class Notes(Notifier):
    """The notifier's place: what the status was last."""

    said = ""

    def status(self, text: str) -> None:
        self.said = text


class HeldExecutor(InlineExecutor):
    """Does the work at once, or while it `holds` keeps it for `do_next`."""

    def __init__(self, holds: bool = True) -> None:
        self.holds = holds
        self.held: list[tuple[Future[Any], Callable[..., Any], tuple[Any, ...]]] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if not self.holds:
            return super().submit(fn, *args, **kwargs)
        self.held.append((Future(), fn, args))
        return self.held[-1][0]

    def do_next(self) -> None:
        """The oldest piece of work that is held."""
        future, fn, args = self.held.pop(0)
        assert future.set_running_or_notify_cancel()
        future.set_result(fn(*args))


class ScriptedBus:
    """Hands out messages when the clock has reached their stamps (counted from `start`); keeps what is sent.

    `fail_receive` and `fail_send` hold exceptions to raise instead, once each; until `full_until`
    there is no room for a frame.
    """

    def __init__(self, clock: FakeClock, messages: Iterable[can.Message] = (), start: float = 1.7e9) -> None:
        self.clock, self.messages, self.offset = clock, list(messages), start - clock.now
        self.sent: list[tuple[float, can.Message]] = []
        self.fail_receive: list[Exception] = []
        self.fail_send: list[Exception] = []
        self.full_until = 0.0
        self.closed = False
        self.next = 0

    def due(self) -> float:
        """Return when the next message comes [s]; inf after the last."""
        return self.messages[self.next].timestamp - self.offset if self.next < len(self.messages) else float("inf")

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.fail_receive:
            raise self.fail_receive.pop(0)
        due = self.due()
        if due > self.clock.now + (timeout or 0.0):
            self.clock.sleep(max(timeout or 0.0, 1e-4))
            return None
        self.clock.now = max(self.clock.now, due)
        self.next += 1
        return self.messages[self.next - 1]

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        if self.fail_send:
            raise self.fail_send.pop(0)
        if self.clock.now < self.full_until:
            raise can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS)
        self.sent.append((self.clock.now, message))

    def shutdown(self) -> None:
        self.closed = True


class Bench:
    """A service on a scripted bus, by a clock that may go on from an earlier service.

    `away` takes the bus's interface away.  `keeper` keeps its state; `pipeline` may have been prepared.  `take` gets
    the windows' results, which else are kept.
    """

    def __init__(
        self,
        messages: Iterable[can.Message] = (),
        config: Config | None = None,
        workers: Executor | None = None,
        notifier: Any = None,
        keeper: StatePersistence | None = None,
        pipeline: Pipeline | None = None,
        clock: FakeClock | None = None,
        claim: Any = None,
        take: Callable[[WindowResult], None] | None = None,
    ) -> None:
        self.config = config or reference_configuration()
        self.clock = clock or FakeClock()
        self.wire: Any = ScriptedBus(self.clock, messages)
        self.away = False
        self.database = output_database(self.config)
        own = [(message.frame_id, message.is_extended_frame) for message in self.database.messages]
        self.bus = LiveBus(self._open, self.clock, self.clock.sleep, own)
        self.results: list[WindowResult] = []
        self.service = Service(
            self.config, pipeline or Pipeline(self.config, load_databases(self.config)), self.bus,
            Publisher(self.database), notifier or Notifier(), workers or InlineExecutor(), self.clock,
            take or self.results.append, lambda: keeper, self.clock.wait_for, claim,
        )  # fmt: skip

    def _open(self) -> Any:
        if self.away:
            raise BusError("bus can0: no such device", may_come=True)
        self.wire.closed = False
        return self.wire

    def run(self, seconds: float) -> float:
        """Works on; the time at which that began."""
        began = self.clock.now
        while self.clock.now < began + seconds:
            self.service.step()
        return began

    def sent(self, name: str, since: float = 0.0) -> list[dict[str, Any]]:
        """The frames of a message that went out, decoded, each with the time `at` which it did."""
        wanted: Any = self.database.get_message_by_name(name)
        return [
            {"at": t, **wanted.decode(bytes(m.data))}
            for t, m in self.wire.sent
            if m.arbitration_id == wanted.frame_id and t >= since
        ]
