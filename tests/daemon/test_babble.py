"""A node that fills the bus with one of our inputs: the ticks stay, nothing piles up, the estimate says why not."""

from __future__ import annotations

import itertools
from pathlib import Path

import can

from soilbus.can.bus import LiveBus
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Publisher
from soilbus.can.wire import Received
from soilbus.daemon.notify import Notifier
from soilbus.daemon.service import Service
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.reference import reference_configuration
from soilbus.validation.fakes import FakeClock, InlineExecutor

FULL_BUS = 7500.0
PAGE = 4096


class Babbler:
    """The same frame all the time, as fast as 1 Mbit/s carries it; keeps when what was sent."""

    def __init__(self, clock: FakeClock, identifier: int) -> None:
        self.clock, self.identifier, self.sent, self.given = clock, identifier, [], 0
        self.next = clock.now

    def recv(self, timeout: float) -> Received | None:
        if self.next > self.clock.now + timeout:
            self.clock.sleep(timeout)
            return None
        self.clock.now = max(self.clock.now, self.next)
        self.next += 1.0 / FULL_BUS
        self.given += 1
        return Received(
            1.7e9 + self.clock.now, self.identifier, True, False, False, bytes((0x10, 0x27, 0, 0, 0, 0, 0, 1))
        )

    def send(self, message: can.Message) -> None:
        self.sent.append((self.clock.now, message.arbitration_id))

    def shutdown(self) -> None:
        pass


def resident() -> int:
    return PAGE * int(Path("/proc/self/statm").read_text().split()[1])


def test_a_babbling_input_leaves_beat_and_memory_as_they_are():
    config, clock = reference_configuration(), FakeClock()
    database, out = load_databases(config), output_database(config)
    wire = Babbler(clock, database.get_message_by_name("GroundBasedSpeedAndDistance").frame_id)
    service = Service(
        config, Pipeline(config, database), LiveBus(lambda: wire, clock, clock.sleep), Publisher(out), Notifier(),
        InlineExecutor(), clock,
    )  # fmt: skip
    begin = clock.now
    memory = []
    for second in range(1, 25):
        while clock.now < begin + second:
            service.step()
        memory.append(resident())
    counts = service.intake.admission.counts
    assert service.bus.counts.received == wire.given > 24 * FULL_BUS * 0.99
    assert sum(counts.received.values()) == sum(counts.admitted.values()) + sum(counts.refused.values())
    assert wire.given - sum(counts.received.values()) <= 0.11 * FULL_BUS  # those of the last tick
    verdicts = [t for t, i in wire.sent if i == out.get_message_by_name("Traversability").frame_id]
    assert max(b - a for a, b in itertools.pairwise(verdicts)) < 0.11
    assert service.deadline_misses == 0
    assert memory[-1] - memory[12] < 2**20  # one window is full
    assert service._state[1].startswith("input_missing")
