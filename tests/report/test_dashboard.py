"""The dashboard believes only fresh frames with a right checksum, and says the state at a glance on any terminal."""

import functools
import io
import itertools
import math
import re

import can
import numpy as np
import pytest
from rich.console import Console

from fakes import FakeClock, message_of
from soilbus.can.checksum import frame_checksum
from soilbus.can.dbc_files import output_database
from soilbus.can.publish import Publisher
from soilbus.config.file import shipped_dbc
from soilbus.report.dashboard import Dashboard, Vehicle
from soilbus.report.received_frames import ReceivedFrames
from soilbus.report.text_charts import area, bar, sparkline
from soilbus.report.watch import page
from soilbus.simulator.reference import reference_configuration

SIZES = [(80, 24), (120, 40), (200, 60)]
SMALLER = [(79, 24), (72, 20), (71, 24), (80, 19), (40, 12), (20, 6), (9, 3)]
PAGES = ("driver", "engineer")
CONFIG = reference_configuration()


class Desk:
    """A dashboard, what sends to it, and its clock."""

    def __init__(self, vehicle: Vehicle | None = None) -> None:
        database = output_database(CONFIG)
        self.clock, self.publisher = FakeClock(), Publisher(database)
        self.known = ReceivedFrames(database, self.clock)
        self.dashboard = Dashboard(self.known, vehicle or Vehicle.of(CONFIG))

    def send(self, name: str, **values) -> None:
        """A frame; of a verdict as many in a row as a reader asks for, the last of them now."""
        now = self.clock.now
        for before in range(5, -1, -1) if name == "Traversability" else (0,):
            self.clock.now = now - 0.1 * before
            self.known.receive(message_of(self.publisher.frame(name, values)))
        self.dashboard.sample()

    def send_all(self, **changed) -> None:
        """Every frame, some with other values."""
        for name, values in WHOLE.items():
            self.send(name, **(values | changed.get(name, {})))

    def text(self, name: str, size=(120, 40), **console) -> str:
        paper = Console(file=io.StringIO(), width=size[0] + 20, height=size[1], **console)
        paper.print(page(self.dashboard, name, *size), end="")
        return paper.file.getvalue()


@pytest.fixture
def desk() -> Desk:
    return Desk()


WHOLE = {
    "SoilbusStatus": {"State": "valid", "Reason": "none", "RejectedShare": 2.0, "DeadlineMisses": 4, "Window": 7},
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
    "PresentDemand": {"Draft": 3120, "Slope": 0.02},
    "WindowQuality": {
        "Chi2Torque": 1.05, "Chi2Draft": 2.35, "Chi2Sinkage": 0.95, "RejectedReason": "bad_checksum", "Rejected": 17
    },
    "BusHealth": {"BusState": "error_passive", "Overruns": 7, "Dropped": 3, "ErrorFrames": 21, "Reopened": 2},
}  # fmt: skip
SAID = {
    "SoilbusStatus": (r"state +valid", r"inputs +2\.0 %", r"late windows +4"),
    "SoilbusIdentity": (r"version +0\.3\.1, up 5 s",),
    "WheelSlip": (r"FR +\+11\.0",), "WheelSlip2": (r"5 +\+15\.0", r"6 +\+16\.0"),
    "Traversability": (r" GO, limit: slip, p = 0\.97", r"data 0\.4 s old, valid 1\.4 s ago"),
    "TorqueDemand": (r"torque 3456 of 9600 N m",), "DraftCapability": (r"on the level +6410 ± 110",),
    "GradeCapability": (r"27\.8 ± 0\.43",), "SoilStrength": (r"bearing +99\.1 ± 0\.45 +kPa", r"window +1\.3"),
    "SoilCohesiveModulus": (r"k_c +5\.3 ± 2 ",), "SoilFrictionalModulus": (r"k_φ +1515 ± 30 ",),
    "SoilSinkageExponent": (r"n +0\.7 ± 0\.02",), "SoilFrictionAngle": (r"φ +29 ± 0\.6 +°",),
    "SoilCohesion": (r"c +1\.7 ± 0\.4 +kPa",), "SoilShearModulus": (r"K +25 ± 3 +mm",),
    "WheelSinkage": (r"RL +\S+ +31",), "WheelSinkage2": (r"5 +\S+ +35", r"6 +\S+ +36"),
    "TractionAdvice": (r"efficiency +12 +10", r"most pull +60 +55"), "TractionLimits": (r"here +5900 ± 120 +13\.1 ±",),
    "DemandForecast": (r"slip to come 21 %", r"sinkage to come 44 mm", r": getting stuck in 4 s"),
    "SoilClass": (r"soil: sandy_loam_15  \(0\.93\)",),
    "PresentDemand": (r"now +3120 +2\.0",),
    "WindowQuality": (r"torque +1\.05", r"draft +2\.35", r"sinkage +0\.95", r"in window +17, most bad_checksum"),
    "BusHealth": (r"bus +error_passive", r"overruns 7 dropped 3", r"error 21 reopened 2"),
}  # fmt: skip


@pytest.mark.parametrize("size", SIZES)
def test_every_frame_is_on_the_engineers_page_and_gone_when_it_is_stale(desk, size):
    assert set(SAID) == set(WHOLE) == set(desk.publisher.schedule)
    desk.send("SoilbusStatus")
    for name, values in WHOLE.items():
        desk.clock.now += 0.01
        desk.send(name, **values)
        text = desk.text("engineer", size)
        if name == "Traversability":  # before the warning takes its place
            assert re.search(SAID[name][0], text)
        for words in SAID[name][name == "Traversability" :]:
            assert re.search(words, text), (name, words)
    desk.clock.now += 4.0
    text = desk.text("engineer", size)
    assert [words for said in SAID.values() for words in said if re.search(words, text)] == []


def test_a_time_at_the_top_of_its_signal_is_said_to_be_longer(desk):
    for since, said in ((24.9, "valid 24.9 s ago"), (57.0, "valid over 25.0 s ago")):
        desk.clock.now += 0.1
        desk.send("Traversability", **WHOLE["Traversability"] | {"SinceValid": since})
        assert said in desk.text("engineer", SIZES[0])


def test_an_age_that_is_not_known_does_not_deny_the_last_valid_estimate(desk):
    for age, since, said in (
        (None, None, "no estimate"), (None, 13.1, "valid 13.1 s ago"), (0.4, None, "data 0.4 s old"),
    ):  # fmt: skip
        desk.clock.now += 0.1
        desk.send("Traversability", **WHOLE["Traversability"] | {"Age": age, "SinceValid": since})
        assert desk.text("driver", SIZES[0]).splitlines()[-1].split("  ")[0] == said


@pytest.mark.parametrize("name", PAGES)
@pytest.mark.parametrize("size", SIZES + SMALLER)
def test_no_line_is_longer_than_the_terminal_is_wide_and_no_page_higher(desk, name, size):
    for _ in range(3):
        desk.send_all()
        lines = desk.text(name, size).splitlines()
        assert max(map(len, lines)) <= size[0]
        assert len(lines) <= size[1]
        if size in SIZES:
            assert len(lines) == size[1]
        assert "…" not in "".join(lines)
        desk.clock.now += 2.0


@pytest.mark.parametrize("size", SIZES + SMALLER)
def test_no_payload_whatever_breaks_a_page(desk, size):
    rng = np.random.default_rng(11)
    for _ in range(6):
        for layout in output_database(CONFIG).messages:
            data = bytearray(rng.bytes(layout.length))
            data[7] = frame_checksum(layout.frame_id, bytes(data), 7)
            desk.known.receive(can.Message(arbitration_id=layout.frame_id, is_extended_id=True, data=data))
        desk.clock.now += 0.1
        desk.dashboard.sample()
        for name in PAGES:
            lines = desk.text(name, size).splitlines()
            assert max(map(len, lines)) <= size[0]
            assert len(lines) <= size[1]
    assert desk.known.value("SoilbusIdentity", "Uptime") is not None


STATES = ("go", "caution", "no_go", "unknown")
LIMITS = ("none", "torque", "traction", "slip", "sinkage", None)
REASONS = [
    str(name)
    for message in output_database(CONFIG).messages
    for signal in message.signals
    if (message.name, signal.name) == ("SoilbusStatus", "Reason")
    for name in (signal.choices or {}).values()
]


@functools.cache
def verdicts() -> list:
    """A verdict of every state, limit, warning and reason, and of silence."""
    return list(made_verdicts())


def made_verdicts():
    for state, limit, warning in itertools.product(STATES, LIMITS, ("none", "immobilisation")):
        for reason in REASONS if state == "unknown" else ("none",):
            desk = Desk()
            desk.send("SoilbusStatus", State="valid", Reason=reason, Window=3)
            desk.send("Traversability", State=state, LimitingCause=limit, Probability=0.5)
            desk.send("DemandForecast", Warning=warning, TimeLeft=6.0)
            yield state, warning, desk.dashboard.verdict()
    silent = Desk()
    yield "unknown", "none", silent.dashboard.verdict()
    silent.send_all()
    silent.clock.now += 9.0
    yield "unknown", "none", silent.dashboard.verdict()


def test_what_to_do_has_at_most_five_words_and_the_sentence_begins_with_the_state():
    words = {"go": "GO", "caution": "CAUTION", "no_go": "NO-GO", "unknown": "UNKNOWN"}
    seen = verdicts()
    for state, warning, verdict in seen:
        assert 2 <= len(verdict.todo.split()) <= 5, verdict
        assert re.match(rf"{words[state]}\b", verdict.said)
        assert ("stuck" in verdict.said) == (warning == "immobilisation")
        assert verdict.word in (*words.values(), "STUCK", "WAIT", "GONE")
        assert state == "go" or "keep" not in verdict.todo.lower()
    assert {verdict.kind for *_, verdict in seen} == {"go", "caution", "no_go", "unknown", "warned", "gone"}


@pytest.mark.parametrize(
    ("state", "limited", "held"),
    [
        ("caution", "Less draft, more load", "Go slowly, caution is held"),
        ("no_go", "Stop, lift the implement", "Stop, no-go is held"),
    ],
)
def test_a_state_that_only_waits_for_a_second_window_asks_for_no_less_draft(desk, state, limited, held):
    """The first good window after a no-go: probable enough for go, and held back by hysteresis alone."""
    said = {}
    for probability in (0.94, 0.97):
        desk.send("SoilbusStatus", State="valid", Reason="none", Window=3)
        desk.send("Traversability", State=state, LimitingCause="traction", Probability=probability)
        said[probability] = desk.dashboard.verdict().todo
    assert said == {0.94: limited, 0.97: held}


def test_no_negative_draft_is_said_to_be_possible(desk):
    desk.send("PresentDemand", Draft=1600.0)
    desk.send("TractionLimits", **WHOLE["TractionLimits"] | {"MaxDraft": -480.0, "Status": "valid"})
    assert desk.dashboard.sentences()[2] == "Draft 1.6 kN of 0.0 kN"


@pytest.mark.parametrize("warning", ["none", "immobilisation"])
@pytest.mark.parametrize("state", ["caution", "no_go"])
def test_a_vehicle_that_pulls_nothing_is_not_told_to_lift_or_to_reduce_the_draft(desk, state, warning):
    said = {}
    for draft in (3000.0, 0.0, -40.0):
        desk.send("Traversability", State=state, LimitingCause="slip", Probability=0.5)
        desk.send("DemandForecast", Warning=warning, TimeLeft=6.0)
        desk.send("PresentDemand", Draft=draft)
        said[draft] = desk.dashboard.verdict().todo
    assert re.search("draft|lift", said[3000.0], re.I)
    assert said[0.0] == said[-40.0] == ("Stop" if state == "no_go" else "Go slowly") + ", add no torque"


def test_every_reason_for_an_unknown_state_is_said_in_words_of_its_own():
    said = {}
    for reason in set(REASONS) - {"none", "model_gap", "error", "not_available"}:
        desk = Desk()
        desk.send("SoilbusStatus", State="degraded", Reason=reason, Window=1)
        desk.send("Traversability", State="unknown")
        said[reason] = desk.dashboard.verdict().said
    assert len(said) > 12
    assert len(set(said.values())) == len(said)
    assert not any("_" in words or "too old" in words for words in said.values())


@pytest.mark.parametrize(
    ("status", "more", "said", "todo"),
    [
        # wheels that spin on the spot are not told to drive on
        (("degraded", "standstill", 1), {"WheelSlip": {"SlipWheel1": 0.1}}, "standing still", "Drive on to measure"),
        (("degraded", "standstill", 1), {"WheelSlip": {"SlipWheel3": 0.2}}, "standing still", "Drive on to measure"),
        (
            ("degraded", "standstill", 1),
            {"WheelSlip": {"SlipWheel3": 0.7}},
            "the wheels spin",
            "Stop, lift, add no torque",
        ),
        # the loads may be what hardly varies
        (("degraded", "not_excited", 1), {}, "load or slip hardly varies", None),
        # an estimate that is not there yet is not called old, nor is one before a status was heard
        (("estimating", "none", 7), {"PresentDemand": {"Draft": 900.0}}, "the next window is due", None),
        (None, {}, "no status of soilbus", None),
        # a draft that no sensor shows is why a good estimate gives no state
        (("valid", "none", 7), {"PresentDemand": {"Draft": None}}, "no sensor shows the draft", None),
        (("valid", "none", 7), {"PresentDemand": {"Draft": 1200.0}}, "the estimate is too old", None),
    ],
)
def test_an_unknown_state_is_said_with_its_own_reason_and_what_to_do(desk, status, more, said, todo):
    if status is not None:
        desk.send("SoilbusStatus", **dict(zip(("State", "Reason", "Window"), status, strict=True)))
    for name, values in more.items():
        desk.send(name, **values)
    desk.send("Traversability", State="unknown", Age=0.6 if said == "the next window is due" else None)
    verdict = desk.dashboard.verdict()
    assert verdict.said == f"UNKNOWN: {said}"
    assert todo in (verdict.todo, None)


def luminance(colour: tuple[int, int, int]) -> float:
    """Relative luminance of an sRGB colour, WCAG 2."""
    parts = [c / 255.0 for c in colour]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_contrast_of_every_state_is_above_seven_also_where_a_terminal_has_256_colours():
    from rich.color import ColorSystem

    for *_, verdict in verdicts():
        for system in (ColorSystem.TRUECOLOR, ColorSystem.EIGHT_BIT):
            pair = [c.downgrade(system).get_truecolor() for c in (verdict.style.color, verdict.style.bgcolor)]
            dark, light = sorted(luminance(tuple(c)) for c in pair)
            assert (light + 0.05) / (dark + 0.05) >= 7.0, verdict
        assert verdict.style.reverse, "else nothing is left of it without colour"


@pytest.mark.parametrize("size", SIZES)
def test_the_state_fills_a_third_of_the_drivers_page(desk, size):
    desk.send_all(DemandForecast={"Warning": "none"})
    coloured = desk.text("driver", size, force_terminal=True, color_system="truecolor").splitlines()
    band = [line for line in coloured if re.search(r"\x1b\[[\d;]*48;2;|\x1b\[[\d;]*38;2;", line)]
    assert len(band) == size[1] // 3
    plain = desk.text("driver", size).splitlines()[: len(band)]
    assert all(len(line) == size[0] for line in plain)
    assert "G O" in plain[len(band) // 2 - 1]
    assert "GO" in plain[-1]


@pytest.mark.parametrize("name", PAGES)
def test_without_colour_the_state_stands_there_in_words_and_reverse_video(desk, name, monkeypatch):
    monkeypatch.setenv("NO_COLOR", "1")
    desk.send_all(Traversability={"State": "no_go"}, DemandForecast={"Warning": "none"})
    text = desk.text(name, force_terminal=True, color_system="truecolor")
    assert not re.search(r"\x1b\[[\d;]*[34]8;", text)
    assert re.search(r"\x1b\[[\d;]*7m[^\n]*NO-GO", text)


def test_a_frame_with_one_bit_wrong_is_not_believed(desk):
    good = message_of(desk.publisher.frame("Traversability", {"State": "no_go"}))
    for bit in range(64):
        bad = bytearray(good.data)
        bad[bit // 8] ^= 1 << bit % 8
        desk.known.receive(can.Message(arbitration_id=good.arbitration_id, is_extended_id=True, data=bad))
    assert desk.known.bad_frames == 64
    assert desk.known.value("Traversability", "State") is None


def test_a_frame_of_can_fd_is_never_ours(desk):
    frame = message_of(desk.publisher.frame("Traversability", {"State": "no_go"}))
    frame.is_fd = True
    desk.known.receive(frame)
    assert (desk.known.bad_frames, desk.known.value("Traversability", "State")) == (1, None)


def test_a_second_sender_is_named_and_nothing_of_its_message_is_shown(desk):
    desk.send_all(DemandForecast={"Warning": "none"})
    assert desk.dashboard.verdict().word == "GO"
    desk.send("WheelSlip", SlipWheel1=0.1)
    twin = Publisher(output_database(CONFIG))
    for _ in range(2):
        frame = twin.frame("WheelSlip", {"SlipWheel1": 0.3})
    desk.known.receive(message_of(frame))
    assert desk.dashboard.verdict()[:3] == (
        "UNKNOWN", "UNKNOWN: another node sends our frames", "Remove the second soilbus"
    )  # fmt: skip
    assert desk.known.value("WheelSlip", "SlipWheel1") is None
    assert not desk.known.is_valid("TractionLimits")
    desk.clock.now += 3.0
    desk.send_all(DemandForecast={"Warning": "none"})
    assert desk.dashboard.verdict().word == "GO"


def test_a_stuck_counter_keeps_nothing_fresh(desk):
    stuck, after = (message_of(desk.publisher.frame("Traversability", {"State": "go"})) for _ in range(2))
    for _ in range(10):
        desk.known.receive(stuck)
        desk.clock.now += 0.1
    assert desk.known.bad_frames == 9
    assert desk.known.value("Traversability", "State") is None
    desk.known.receive(after)
    assert desk.known.value("Traversability", "State") == "unknown"
    for _ in range(5):
        desk.clock.now += 0.1
        desk.known.receive(message_of(desk.publisher.frame("Traversability", {"State": "go"})))
    assert desk.known.value("Traversability", "State") == "go"


def test_not_available_is_shown_as_nothing(desk):
    desk.send("WheelSlip")
    assert desk.known.value("WheelSlip", "SlipWheel1") is None


def test_a_stale_go_is_no_go_any_more(desk):
    desk.send("SoilbusStatus", State="valid", Window=1)
    desk.send("Traversability", State="go", Probability=0.99)
    assert desk.dashboard.verdict().word == "GO"
    desk.clock.now += 1.0
    assert desk.known.value("Traversability", "State") is None
    verdict = desk.dashboard.verdict()
    assert (verdict.word, verdict.said) == ("UNKNOWN", "UNKNOWN: its frames stopped")


def test_soilbus_is_gone_when_its_frames_stop_and_for_how_long(desk):
    assert desk.dashboard.verdict().said == "UNKNOWN: no frame of soilbus yet, 0 s"
    desk.send_all()
    assert desk.dashboard.verdict().word != "GONE"
    desk.clock.now += 3.0
    desk.send("WheelSlip")  # a gateway may go on with one frame
    assert desk.dashboard.verdict().word != "GONE"
    desk.clock.now += 9.0
    assert desk.dashboard.verdict().said == "UNKNOWN: soilbus is gone, for 12 s"
    for name in PAGES:
        assert "soilbus is gone, for 12 s" in desk.text(name, (80, 24))
    desk.dashboard.fault = "bus socketcan:can0: Network is down"
    for name in PAGES:
        assert desk.text(name, (80, 24)).splitlines()[-1].startswith("bus away: bus socketcan:can0: Network is down")
    desk.send("Traversability", State="go")
    assert desk.dashboard.verdict().word == "GO"


def test_before_the_first_window_it_is_said_how_long_that_takes():
    desk = Desk(Vehicle(window=5.0))
    desk.send("SoilbusStatus", State="listening", Reason="no_frames")
    desk.send("Traversability", State="unknown")
    assert "nothing on the bus" in desk.dashboard.verdict().said
    desk.send("SoilbusStatus", State="estimating", Reason="none")
    assert desk.dashboard.verdict().said == "UNKNOWN: the first window takes 5 s"
    desk.send("SoilbusStatus", State="valid", Reason="none", Window=0)
    desk.send("Traversability", State="go", Probability=0.99)
    assert desk.dashboard.verdict().word == "GO"


def test_frames_that_were_moved_to_identifiers_of_11_bits_are_read_under_these_alone(tmp_path):
    text = shipped_dbc("soilbus.dbc").read_text()
    for number, layout in enumerate(output_database(CONFIG).messages):
        text = text.replace(str(layout.frame_id | 1 << 31), str(0x400 + number))
    (tmp_path / "moved.dbc").write_text(re.sub(r".*VFrameFormat.*\n", "", text))
    database = output_database(reference_configuration([f'output.dbc="{tmp_path / "moved.dbc"}"']))
    known, publisher = ReceivedFrames(database, FakeClock()), Publisher(database)
    frame = message_of(publisher.frame("Traversability", {"State": "no_go"}))
    assert not frame.is_extended_id
    frame.is_extended_id = True
    known.receive(frame)
    assert known.value("Traversability", "State") is None
    frame.is_extended_id = False
    known.receive(frame)
    assert known.value("Traversability", "State") == "no_go"


def test_the_slip_bar_is_of_the_wheel_that_slips_most_and_the_best_slip_of_its_axle(desk):
    slips = {"SlipWheel1": 0.05, "SlipWheel2": 0.08, "SlipWheel3": 0.31, "SlipWheel4": -0.02}
    advice = {"SlipForEfficiencyFront": 0.12, "SlipForEfficiencyRear": 0.2, "SlipForPullFront": 0.5, "Status": "valid"}
    desk.send("WheelSlip", **slips)
    desk.send("TractionAdvice", **advice)
    assert desk.dashboard.slip() == (pytest.approx(0.31), "RL", pytest.approx(0.2), None)
    text = desk.text("driver", (80, 24))
    assert re.search(r"SLIP +31 % at wheel RL", text)
    row, marks = re.search(r"\n(█.*)\n( *▲ best 20 %)", text).groups()
    assert row.index("·") == pytest.approx(80 * 0.31 / CONFIG.traversability.max_slip, abs=1.5)
    assert marks.index("▲") == pytest.approx(80 * 0.2 / CONFIG.traversability.max_slip, abs=1.0)
    nameless = Desk(Vehicle())
    nameless.send("WheelSlip", **slips)
    nameless.send("TractionAdvice", **advice)
    assert nameless.dashboard.slip() == (pytest.approx(0.31), "3", pytest.approx(0.12), pytest.approx(0.5))
    nameless.send("TractionAdvice", **(advice | {"Status": "degraded"}))
    assert nameless.dashboard.slip().best is None


def test_the_chart_of_the_draft_has_a_gap_where_its_frames_did_not_come_and_never_a_zero(desk):
    for i in range(600):
        if not 200 <= i < 300:
            desk.send("PresentDemand", Draft=2000.0 + 5.0 * i)
            desk.send("TractionLimits", MaxDraft=8000.0, MaxDraftStd=100.0, Status="valid")
        desk.dashboard.sample()
        desk.clock.now += 0.1
    draft = desk.dashboard.history("draft", 60)
    assert draft[0] == pytest.approx(2000.0, abs=60.0)
    assert draft[-1] == pytest.approx(4990.0, abs=60.0)
    assert all(a is None or b is None or a < b for a, b in itertools.pairwise(draft))
    assert 8 <= draft.count(None) <= 10
    assert {i for i, value in enumerate(draft) if value is None} <= set(range(19, 31))
    text = desk.text("driver", (120, 40))
    assert re.search(r"DRAFT  5\.0 kN  of possible 8\.0 kN", text)
    bottom = next(line for line in text.splitlines() if line.startswith("        0 ┤"))
    assert re.fullmatch(r" +0 ┤█+ +█+", bottom)


def test_draft_and_slope_that_nobody_measures_are_no_zero(desk):
    desk.send_all(PresentDemand={"Draft": None, "Slope": None}, TractionLimits={"Status": "valid"})
    assert re.search(r"DRAFT  -  of possible 5\.9 kN", desk.text("driver"))
    assert re.search(r"now +- +-\s", desk.text("engineer"))


def test_a_slip_that_rounds_to_zero_has_no_sign(desk):
    desk.send("WheelSlip", **dict.fromkeys(WHOLE["WheelSlip"], -0.004))
    assert "SLIP  0 % at wheel FL" in desk.text("driver")


def test_slopes_are_in_per_cent(desk):
    desk.send("GradeCapability", MaxGrade=0.3, MaxGradeStd=0.01, Status="valid")
    of_slope = re.search(r"on the level +- +(\S+) ± (\S+)", desk.text("engineer"))
    assert float(of_slope[1]) == pytest.approx(100.0 * math.sin(0.3) / math.cos(0.3), abs=0.06)
    steeper = [100.0 * math.sin(0.3 + d) / math.cos(0.3 + d) for d in (-0.01, 0.01)]
    assert float(of_slope[2]) == pytest.approx((steeper[1] - steeper[0]) / 2.0, abs=0.02)


def test_what_is_not_vouched_for_is_grey(desk):
    for status, grey in (("valid", False), ("not_excited", True), ("degraded", True)):
        desk.send("DraftCapability", MaxDraft=6410, MaxDraftStd=110, Status=status)
        text = desk.text("engineer", force_terminal=True, color_system="standard")
        (line,) = (line for line in text.splitlines() if "6410" in line)
        assert ("\x1b[2m6410" in line) == grey
        assert desk.known.is_valid("DraftCapability") != grey
    assert not desk.known.is_valid("TractionAdvice")
    desk.send("WheelSlip", **WHOLE["WheelSlip"])
    assert desk.known.is_valid("WheelSlip")  # has no status of its own


def test_a_bad_frame_is_counted_on_the_engineers_page(desk):
    frame = message_of(desk.publisher.frame("Traversability", {"State": "go"}))
    frame.data[0] ^= 1
    desk.known.receive(frame)
    assert re.search(r"bad frames +1", desk.text("engineer", (80, 24)))


def with_code(frame, byte: int, code: int) -> can.Message:
    """The frame with other low four bits in a byte, and the checksum that belongs to it."""
    data = bytearray(frame.data)
    data[byte] = data[byte] & 0xF0 | code
    data[7] = frame_checksum(frame.arbitration_id, bytes(data), 7)
    return can.Message(arbitration_id=frame.arbitration_id, is_extended_id=True, data=data)


@pytest.mark.parametrize("code", range(4, 14))
def test_a_state_that_has_no_name_yet_is_unknown(desk, code):
    desk.send("SoilbusStatus", State="valid", Window=1)
    desk.known.receive(with_code(desk.publisher.frame("Traversability", {"State": "go", "Probability": 0.9}), 0, code))
    assert desk.known.bad_frames == 0
    assert desk.known.value("Traversability", "State") is None
    assert desk.known.number("Traversability", "Probability") == pytest.approx(0.9, abs=3e-4)
    assert desk.dashboard.verdict().word == "UNKNOWN"


def test_charts_are_to_scale_and_blank_where_nothing_is_known():
    assert bar(0.25, 1.0, 8) == "██      "
    assert bar(-0.3, 1.0, 4) == bar(None, 1.0, 4) == "    "
    assert bar(7.0, 1.0, 4) == "████"
    assert sparkline([0.0, None, 7.0]) == "▁ █"
    assert sparkline([5.0, 5.0]) == "▄▄"
    assert area([0.0, 4.0, None, 8.0], 2, 8.0) == ["   █", " █ █"]
    assert area([1.0, 1.0], 2, 8.0, [8.0, None]) == ["─ ", "▂▂"]


@pytest.mark.parametrize(
    ("slip", "says"), [(0.09, "getting stuck now"), (0.97, "NO-GO: stuck"), (None, "NO-GO: stuck")]
)
def test_a_vehicle_whose_wheels_hardly_slip_is_not_called_stuck(desk, slip, says):
    desk.send("Traversability", State="no_go", LimitingCause="slip", Probability=0.0)
    desk.send("DemandForecast", Warning="immobilisation", TimeLeft=0.0)
    desk.send("WheelSlip", SlipWheel1=slip, SlipWheel2=slip)
    assert says in desk.dashboard.verdict().said
