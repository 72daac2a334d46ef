"""The terminal dashboard believes only fresh frames with a right checksum."""

from __future__ import annotations

import errno
import io
import re

import can
import numpy as np
import pytest
from rich.console import Console

from soilbus.can.bus import BusError, LiveBus
from soilbus.can.checksum import frame_checksum
from soilbus.can.dbc_files import output_database
from soilbus.can.publish import Publisher
from soilbus.report.dashboard import panel, show
from soilbus.report.received_frames import ReceivedFrames
from soilbus.simulator.reference import reference_configuration
from soilbus.validation.fakes import FakeClock, ScriptedBus

WIDTH = 80
"""Columns of the narrowest terminal."""


@pytest.fixture
def setup():
    database = output_database(reference_configuration())
    clock = FakeClock()
    return Publisher(database), ReceivedFrames(database, clock), clock


def message(frame) -> can.Message:
    return can.Message(arbitration_id=frame.arbitration_id, is_extended_id=frame.extended, data=frame.data)


def shown(dashboard) -> str:
    console = Console(width=2 * WIDTH, record=True, file=io.StringIO())
    console.print(panel(dashboard))
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
    assert re.search(r"efficiency +0\.12 +0\.10", shown(dashboard))
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


WHOLE = {
    "SoilbusStatus": {"State": "valid", "Reason": "none", "RejectedShare": 2.0},
    "SoilbusIdentity": {"VersionMajor": 0, "VersionMinor": 3, "VersionPatch": 1, "Uptime": 5},
    "WheelSlip": {f"SlipWheel{i}": 0.11 for i in range(1, 5)},
    "WheelSlip2": {"SlipWheel5": 0.15, "SlipWheel6": 0.16},
    "Traversability": {
        "State": "go", "LimitingCause": "slip", "Probability": 0.97, "Age": 0.4, "SinceValid": 1.4, "Window": 7
    },
    "TorqueDemand": {"TorqueRequired": 3456, "TorqueAvailable": 9600},
    "DraftCapability": {"MaxDraft": 6410, "MaxDraftStd": 110},
    "GradeCapability": {"MaxGrade": 0.271, "MaxGradeStd": 0.004},
    "SoilStrength": {"BearingPressure": 99.1, "BearingPressureStd": 0.45, "Chi2": 1.3},
    "SoilCohesiveModulus": {"Value": 5.3, "Std": 2.0},
    "SoilFrictionalModulus": {"Value": 1515.0, "Std": 30.0},
    "SoilSinkageExponent": {"Value": 0.7, "Std": 0.02},
    "SoilFrictionAngle": {"Value": 29.0, "Std": 0.6},
    "SoilCohesion": {"Value": 1.7, "Std": 0.4},
    "SoilShearModulus": {"Value": 25.0, "Std": 3.0},
    "WheelSinkage": {f"SinkageWheel{i}": 31.0 for i in range(1, 5)},
    "WheelSinkage2": {"SinkageWheel5": 35.0, "SinkageWheel6": 36.0},
    "TractionAdvice": {
        "SlipForEfficiencyFront": 0.12, "SlipForEfficiencyRear": 0.1, "SlipForPullFront": 0.6, "SlipForPullRear": 0.55
    },
    "TractionLimits": {"MaxDraft": 5900, "MaxDraftStd": 120, "MaxGrade": 0.13, "MaxGradeStd": 0.006},
    "DemandForecast": {"Slip": 0.21, "SlipStd": 0.01, "Sinkage": 44.0, "Warning": "immobilisation", "TimeLeft": 4.2},
    "SoilClass": {"Kind": "sandy_loam_15", "Probability": 0.93, "UnknownProbability": 0.05},
    "BusHealth": {"BusState": "error_passive", "Overruns": 7, "Dropped": 3, "ErrorFrames": 21, "Reopened": 2},
}  # fmt: skip
SAID = {
    "SoilbusStatus": ("service: valid", "refused 2.0 %"), "SoilbusIdentity": ("soilbus 0.3.1",),
    "WheelSlip": ("+0.11",), "WheelSlip2": ("+0.15", "+0.16"),
    "Traversability": (" GO ", "p = 0.97", "limit: slip", "0.4 s old", "valid 1.4 s ago"),
    "TorqueDemand": ("torque 3456 of 9600 N m",), "DraftCapability": ("6410 ± 110",),
    "GradeCapability": ("0.271 ± 0.004",), "SoilStrength": ("99.1 ± 0.45", "1.3"),
    "SoilCohesiveModulus": ("5.3 ± 2",), "SoilFrictionalModulus": ("1515 ± 30",),
    "SoilSinkageExponent": ("0.7 ± 0.02",), "SoilFrictionAngle": ("29 ± 0.6",), "SoilCohesion": ("1.7 ± 0.4",),
    "SoilShearModulus": ("25 ± 3",), "WheelSinkage": ("31",), "WheelSinkage2": ("35", "36"),
    "TractionAdvice": ("0.12   0.10", "0.60   0.55"), "TractionLimits": ("5900 ± 120", "0.13 ± 0.006"),
    "DemandForecast": ("slip to come 0.21", "sinkage 44 mm", "GETTING STUCK in 4 s"),
    "SoilClass": ("soil: sandy_loam_15 (0.93)", "none of the known 0.05"),
    "BusHealth": ("bus: error_passive", "overruns 7", "dropped 3", "errors 21", "reopened 2"),
}  # fmt: skip


def test_every_frame_is_shown_and_gone_when_it_is_stale(setup):
    publisher, dashboard, clock = setup
    assert set(SAID) == set(WHOLE) == set(publisher.schedule)
    for name, values in WHOLE.items():
        before = shown(dashboard)
        dashboard.receive(message(publisher.frame(name, values)))
        text = shown(dashboard)
        for words in SAID[name]:
            assert words in text, name
            assert words not in before, name
        assert max(len(line) for line in text.splitlines()) <= WIDTH
    clock.now += 4.0
    text = shown(dashboard)
    assert not [words for said in SAID.values() for words in said if words in text]


def test_what_is_not_vouched_for_is_grey(setup):
    publisher, dashboard, _ = setup
    for status, grey in (("valid", False), ("not_excited", True), ("degraded", True)):
        values = {"MaxDraft": 6410, "MaxDraftStd": 110, "Status": status}
        dashboard.receive(message(publisher.frame("DraftCapability", values)))
        console = Console(width=WIDTH, record=True, file=io.StringIO(), force_terminal=True, color_system="standard")
        console.print(panel(dashboard))
        (line,) = (line for line in console.export_text(styles=True).splitlines() if "6410" in line)
        assert ("\x1b[2m6410" in line) == grey
        assert dashboard.is_valid("DraftCapability") != grey
    assert not dashboard.is_valid("TractionAdvice")
    dashboard.receive(message(publisher.frame("WheelSlip", WHOLE["WheelSlip"])))
    assert dashboard.is_valid("WheelSlip")  # has no status of its own


def with_code(frame, byte: int, code: int) -> can.Message:
    """The frame with other low four bits in a byte, and the checksum that belongs to it."""
    data = bytearray(frame.data)
    data[byte] = data[byte] & 0xF0 | code
    data[7] = frame_checksum(frame.arbitration_id, bytes(data), 7)
    return can.Message(arbitration_id=frame.arbitration_id, is_extended_id=True, data=data)


@pytest.mark.parametrize("code", range(4, 14))
def test_a_state_that_has_no_name_yet_is_unknown(setup, code):
    publisher, dashboard, _ = setup
    dashboard.receive(with_code(publisher.frame("Traversability", {"State": "go", "Probability": 0.9}), 0, code))
    assert dashboard.bad_frames == 0
    assert dashboard.value("Traversability", "State") is None
    assert dashboard.number("Traversability", "Probability") == pytest.approx(0.9, abs=3e-4)
    text = shown(dashboard)
    assert " UNKNOWN " in text
    assert "p = 0.90" in text


def test_no_payload_whatever_breaks_the_dashboard():
    database = output_database(reference_configuration())
    dashboard = ReceivedFrames(database, FakeClock())
    rng = np.random.default_rng(11)
    for _ in range(30):
        for layout in database.messages:
            data = bytearray(rng.bytes(layout.length))
            data[7] = frame_checksum(layout.frame_id, bytes(data), 7)
            dashboard.receive(can.Message(arbitration_id=layout.frame_id, is_extended_id=True, data=data))
        assert "soilbus" in shown(dashboard)
    assert dashboard.value("SoilbusIdentity", "Uptime") is not None


def test_a_bus_that_goes_is_said_and_waited_for(setup):
    publisher, dashboard, clock = setup
    wire = ScriptedBus(clock, [message(publisher.frame("Traversability", {"State": "go"}))], start=-5.0)
    wire.fail_receive.append(can.CanOperationError("Network is down", errno.ENETDOWN))
    tries, screens = [], []

    def opened():
        tries.append(clock.now)
        if 1 < len(tries) < 4:
            raise BusError("bus socketcan:can0: Network is down", may_come=True)
        return wire

    bus = LiveBus(opened, clock, clock.sleep)
    bus.open()

    def is_back() -> bool:
        screens.append(shown_with(dashboard, bus.fault))
        return dashboard.value("Traversability", "State") == "go"

    show(dashboard, bus, Console(file=io.StringIO()), done=is_back)
    assert len(tries) == 4
    assert any("bus: away (bus socketcan:can0: Network is down)" in screen for screen in screens)
    assert "away" not in screens[-1]


def shown_with(dashboard, fault: str) -> str:
    console = Console(width=WIDTH, record=True, file=io.StringIO())
    console.print(panel(dashboard, fault))
    return console.export_text()
