"""A node that fills the bus with one of our inputs: the ticks stay, nothing piles up, the estimate says why not."""

from __future__ import annotations

import itertools
from pathlib import Path

import can

from fakes import Bench, FakeClock
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.wire import Received
from soilbus.simulator.reference import reference_configuration

FULL_BUS = 7500.0
PAGE = 4096
STATUS = output_database(reference_configuration()).get_message_by_name("SoilbusStatus")


class Babbler:
    """The same frame all the time, as fast as 1 Mbit/s carries it; keeps when what was sent, and the last status."""

    def __init__(self, clock: FakeClock, identifier: int) -> None:
        self.clock, self.identifier, self.sent, self.given = clock, identifier, [], 0
        self.next = clock.now
        self.status: bytes | None = None

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
        if message.arbitration_id == STATUS.frame_id:
            self.status = bytes(message.data)

    def shutdown(self) -> None:
        pass


def resident() -> int:
    return PAGE * int(Path("/proc/self/statm").read_text().split()[1])


def test_a_babbling_input_leaves_beat_and_memory_as_they_are():
    bench = Bench()
    database, service = load_databases(bench.config), bench.service
    bench.wire = wire = Babbler(bench.clock, database.get_message_by_name("GroundBasedSpeedAndDistance").frame_id)
    memory = []
    for _ in range(24):
        bench.run(1.0)
        memory.append(resident())
    counts = service.intake.admission.counts
    assert service.bus.counts.received == wire.given > 24 * FULL_BUS * 0.99
    assert sum(counts.received.values()) == sum(counts.admitted.values()) + sum(counts.refused.values())
    assert wire.given - sum(counts.received.values()) <= 0.11 * FULL_BUS  # those of the last beat
    verdicts = [t for t, i in wire.sent if i == bench.database.get_message_by_name("Traversability").frame_id]
    assert max(b - a for a, b in itertools.pairwise(verdicts)) < 0.11
    assert service.deadline_misses == 0
    assert memory[-1] - memory[12] < 2**20  # one window is full
    assert wire.status is not None
    assert STATUS.decode(wire.status)["Reason"] == "input_missing"
