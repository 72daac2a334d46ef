"""The example controller of service/docs against the simulated tractor, by the service's frames and the bus's time."""

import importlib.util
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest

from fakes import message_of, sent_by
from soilbus.can.candump import Frame, frame_of
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Publisher
from soilbus.offline.sent_frames import sent_beside
from soilbus.simulator.commands import Commands
from soilbus.simulator.drive import Command, Drive, drive, joined
from soilbus.simulator.live import driven_frames
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing

EXAMPLE = Path(__file__).resolve().parents[2] / "service" / "docs" / "controller.py"
CONFIG, SEED = reference_configuration(["estimator.window=5.0"]), 3
ONTO_CLAY = Scenario(
    25.0, (Patch(0.0, "loam"), Patch(18.0, "wet_clay")), Swing(1.4, 1.4), draft=Swing(300.0, 300.0), lift_slip=None
)

OURS, TRACTOR = output_database(CONFIG), load_databases(CONFIG)
CUT = can.Message(arbitration_id=0x18FF719A, data=b"\x01\x02")
"""Set-points of a broken sender: no reader may fall over them."""


class ClosedLoop:
    """A bus with the tractor and the service on it, whose time is that of the simulation."""

    def __init__(self) -> None:
        self._commands, self._now, self.steps = Commands(CONFIG), 0.0, list[Drive]()
        self.lost_commands = 0

    def __iter__(self) -> Iterator[can.Message]:
        for message in sent_beside(CONFIG, self._frames()):
            yield message
            if message.arbitration_id == CUT.arbitration_id:
                yield CUT

    def send(self, message: can.Message) -> None:
        self.lost_commands += not self._commands.take(message, self._now)

    def _commanded(self, t: float) -> Command:
        self._now = t
        return self._commands.at(t)

    def _frames(self) -> Iterator[Frame]:
        for done, frames in driven_frames(CONFIG, ONTO_CLAY, SEED, self._commanded):
            self.steps.append(done)
            yield from map(frame_of, frames)


def follow(bus) -> None:
    """The example drives the tractor on that bus."""
    spec = importlib.util.spec_from_file_location("controller", EXAMPLE)
    controller = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(controller)
    controller.follow(bus)


@pytest.fixture(scope="module")
def followed() -> Drive:
    bus = ClosedLoop()
    follow(bus)
    assert bus.lost_commands == 0
    return joined(bus.steps)


ADVICE = {"SlipForEfficiencyRear": 0.2, "Status": "valid"}


class Spoofed:
    """A bus on which soilbus says go and gives set-points, and a stranger's set-points from 6 s on; no physics."""

    def __init__(self, stranger: bool) -> None:
        self._stranger, self.drafts = stranger, list[float]()

    def __iter__(self) -> Iterator[can.Message]:
        ours, theirs = Publisher(OURS), Publisher(OURS)
        for i in range(120):
            heard = self._stranger and i >= 60
            values = {
                "Traversability": {"State": "unknown" if heard else "go"},
                "WheelSlip": {"SlipWheel3": 0.2, "SlipWheel4": 0.2},
            }
            values |= {"TractionAdvice": ADVICE} if i % 10 == 0 else {}
            yield from sent_by(ours, values, 0.1 * i)
            false = theirs.frame("TractionAdvice", ADVICE | {"SlipForEfficiencyRear": 0.9})
            if heard:
                yield message_of(false, 0.1 * i + 0.01)

    def send(self, message: can.Message) -> None:
        self.drafts.append(TRACTOR.decode_message(message.arbitration_id, message.data)["Draft"])


def mean_draft(done: Drive, soil: str | None = None) -> float:
    """From the time on at which there has been advice for some seconds, on all soils or one."""
    columns = done.columns
    counts = (columns["t"] > 8.0) & (columns["soil"] == soil if soil else True)
    return float(columns["draft"][counts].mean())


def test_it_imports_nothing_of_soilbus():
    assert not re.search(r"^\s*(import|from) soilbus", EXAMPLE.read_text(), re.M)


def test_it_crosses_onto_wet_clay_without_bogging_down(followed):
    assert followed.bogged_at is None
    assert set(followed.columns["soil"]) == {"loam", "wet_clay"}
    assert followed.columns["ground_speed"].min() > 1.2
    late = followed.columns["t"] > 21.0
    assert np.abs(followed.columns["slip.RL"][late] - 0.34).max() < 0.08  # the clay's best slip, not the loam's


def test_it_pulls_more_than_at_the_constant_slip_that_it_holds_without_advice(followed):
    constant = drive(CONFIG, replace(ONTO_CLAY, draft=None, slip=Swing(0.15, 0.15)), SEED)
    for soil in (None, "loam", "wet_clay"):
        assert mean_draft(followed, soil) > mean_draft(constant, soil) + 300.0


def test_a_strangers_set_points_are_not_followed():
    alone, spoofed = Spoofed(stranger=False), Spoofed(stranger=True)
    follow(alone)
    follow(spoofed)
    assert min(alone.drafts[15:60]) == pytest.approx(alone.drafts[15], rel=1e-3)  # advice and slip agree
    assert max(spoofed.drafts[60:]) <= spoofed.drafts[59] + 1.0


def test_a_constant_draft_bogs_down_there_or_pulls_less(followed):
    mean = mean_draft(followed)
    as_much = drive(CONFIG, replace(ONTO_CLAY, draft=Swing(mean, mean)), SEED)
    assert as_much.bogged_at is not None
    assert as_much.columns["soil"][-1] == "wet_clay"
    that_gets_through = drive(CONFIG, replace(ONTO_CLAY, draft=Swing(800.0, 800.0)), SEED)
    assert that_gets_through.bogged_at is None
    assert mean > 1.5 * 800.0
