"""The terminal dashboard believes only fresh frames with a right checksum."""

from __future__ import annotations

import io

import can
import pytest
from rich.console import Console

from fakes import FakeClock
from soilbus.can.dbc_files import output_database
from soilbus.can.publish import Publisher
from soilbus.report.dashboard import Dashboard
from soilbus.simulator.reference import reference_configuration


@pytest.fixture
def setup():
    database = output_database(reference_configuration())
    clock = FakeClock()
    return Publisher(database), Dashboard(database, clock), clock


def message(frame) -> can.Message:
    return can.Message(arbitration_id=frame.arbitration_id, is_extended_id=frame.extended, data=frame.data)


def shown(dashboard) -> str:
    console = Console(width=90, record=True, file=io.StringIO())
    console.print(dashboard.render())
    return console.export_text()


def test_what_was_sent_is_shown(setup):
    publisher, dashboard, _ = setup
    dashboard.receive(message(publisher.frame("Traversability", {"State": "no_go", "Probability": 0.25})))
    dashboard.receive(message(publisher.frame("SoilStrength", {"BearingPressure": 99.1, "BearingPressureStd": 0.4})))
    dashboard.receive(message(publisher.frame("WheelSlip", {"SlipWheel2": -0.125})))
    text = shown(dashboard)
    assert "NO-GO" in text
    assert "p = 0.25" in text
    assert "99.1 ± 0.4" in text
    assert "-0.12" in text


def test_a_stale_go_is_no_go_any_more(setup):
    publisher, dashboard, clock = setup
    dashboard.receive(message(publisher.frame("Traversability", {"State": "go", "Probability": 0.99})))
    assert dashboard.value("Traversability", "State") == "go"
    clock.now += 1.0
    assert dashboard.value("Traversability", "State") is None
    assert " UNKNOWN " in shown(dashboard)


def test_a_frame_with_one_bit_wrong_is_not_believed(setup):
    publisher, dashboard, _ = setup
    good = message(publisher.frame("Traversability", {"State": "no_go"}))
    for bit in range(64):
        bad = bytearray(good.data)
        bad[bit // 8] ^= 1 << bit % 8
        dashboard.receive(can.Message(arbitration_id=good.arbitration_id, is_extended_id=True, data=bad))
    assert dashboard.bad_frames == 64
    assert dashboard.value("Traversability", "State") is None


def test_a_stuck_counter_keeps_nothing_fresh(setup):
    publisher, dashboard, clock = setup
    stuck, after = (message(publisher.frame("Traversability", {"State": "go"})) for _ in range(2))
    for _ in range(10):
        dashboard.receive(stuck)
        clock.now += 0.1
    assert dashboard.bad_frames == 9
    assert dashboard.value("Traversability", "State") is None
    dashboard.receive(after)
    assert dashboard.value("Traversability", "State") == "go"


def test_not_available_is_shown_as_nothing(setup):
    publisher, dashboard, _ = setup
    dashboard.receive(message(publisher.frame("WheelSlip", {})))
    assert dashboard.value("WheelSlip", "SlipWheel1") is None


def test_the_warning_and_the_best_slips_are_shown(setup):
    publisher, dashboard, clock = setup
    dashboard.receive(message(publisher.frame("DemandForecast", {"Warning": "none", "TimeLeft": 25.0})))
    advice = {"SlipForEfficiencyFront": 0.123, "SlipForEfficiencyRear": 0.105}
    dashboard.receive(message(publisher.frame("TractionAdvice", advice)))
    assert "GETTING STUCK" not in shown(dashboard)
    assert "best slip 0.12/0.10" in shown(dashboard)
    dashboard.receive(message(publisher.frame("DemandForecast", {"Warning": "immobilisation", "TimeLeft": 4.2})))
    assert "GETTING STUCK in 4 s" in shown(dashboard)
    clock.now += 1.0
    assert "GETTING STUCK" not in shown(dashboard)


def test_the_soil_class_is_shown_while_it_is_fresh(setup):
    publisher, dashboard, clock = setup
    dashboard.receive(message(publisher.frame("SoilClass", {})))
    assert "soil: " not in shown(dashboard)
    said = {"Kind": "sandy_loam_15", "Probability": 0.93, "UnknownProbability": 0.05}
    dashboard.receive(message(publisher.frame("SoilClass", said)))
    assert "soil: sandy_loam_15 (0.93)" in shown(dashboard)
    clock.now += 4.0
    assert "sandy_loam" not in shown(dashboard)
    dashboard.receive(message(publisher.frame("SoilClass", {"Kind": "unknown", "Probability": 0.6})))
    assert "soil: unknown (0.60)" in shown(dashboard)
