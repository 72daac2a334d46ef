"""The loop with a clock and a bus in hand: what it sends, when, and that it fails safe."""

import errno
import itertools
import math
from collections import Counter
from copy import copy
from dataclasses import replace
from typing import ClassVar

import can
import pytest

from fakes import Bench, FakeClock, ScriptedBus, drive_messages, sent_by
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Publisher
from soilbus.can.wire import MessageWire
from soilbus.daemon.notify import Notifier
from soilbus.pipeline.outputs import hop_frames
from soilbus.simulator.reference import reference_configuration

CONFIG = reference_configuration(["estimator.window=4"])
DURATION = 10.0
STAMPED = 0.001
"""Seconds that the scripted kernel needs from a frame's stamp to the socket."""


@pytest.fixture(scope="module")
def recording() -> list[can.Message]:
    return drive_messages(CONFIG, DURATION)


@pytest.fixture(scope="module")
def good(recording) -> Bench:
    """The service after a good drive."""
    bench = Bench(recording, CONFIG)
    bench.run(DURATION)
    return bench


SILENT = 6.0
"""Seconds for which nothing is heard after the drive."""


@pytest.fixture(scope="module")
def silent(recording) -> Bench:
    """The service after a good drive and the silence that follows."""
    bench = Bench(recording, CONFIG)
    bench.run(DURATION + SILENT)
    return bench


def test_frames_go_out_at_their_cycle_times(good):
    fast = dict.fromkeys(("WheelSlip", "Traversability", "TorqueDemand", "DemandForecast"), 0.1)
    for name, cycle in (fast | {"SoilbusStatus": 1.0}).items():
        times = [f["at"] for f in good.sent(name)]
        gaps = [b - a for a, b in itertools.pairwise(times)]
        assert len(times) >= DURATION / cycle - 2, name
        assert max(gaps) < 1.5 * cycle, name
        assert sum(gaps) / len(gaps) == pytest.approx(cycle, rel=0.05), name
    assert len(good.results) == len(good.sent("SoilStrength")) >= 6


def test_before_each_window_ends_the_loop_has_just_done_its_work_and_then_leaves_the_worker_alone(good):
    beats = [f["at"] + good.wire.offset for f in good.sent("WheelSlip")]
    for end in (result.t for result in good.results[1:]):
        assert 0.005 < end - max(beat for beat in beats if beat < end) < 0.03
        assert min(beat for beat in beats if beat > end) - end > 0.08


def test_a_window_that_the_bus_can_end_waits_for_no_frame_and_says_the_same(recording, monkeypatch):
    """Frames of the kernel are stamped by a clock that can be asked; here it is the scripted bus's."""
    sparse = [message for message in recording if message.timestamp % 0.1 < 0.05]
    benches = [Bench(sparse, CONFIG), Bench(sparse, CONFIG)]
    benches[0].run(DURATION - 0.5)
    told = benches[1].wire

    def present(_) -> float:
        return told.clock.now + told.offset

    def heard_until(_) -> float:
        waits = told.next < len(told.messages) and told.messages[told.next].timestamp <= present(_)
        return -math.inf if waits else present(_) - STAMPED

    monkeypatch.setattr(MessageWire, "stamping_time", present)
    monkeypatch.setattr(MessageWire, "heard_until", heard_until)
    benches[1].run(DURATION - 0.5)
    assert len(benches[0].results) == 6
    assert [r.t for r in benches[1].results] == [r.t for r in benches[0].results]
    assert [str(r.posterior) for r in benches[1].results] == [str(r.posterior) for r in benches[0].results]
    late = [
        [f["at"] + told.offset - r.t for r, f in zip(bench.results, bench.sent("SoilStrength"), strict=True)]
        for bench in benches
    ]
    assert max(late[1]) < STAMPED + 0.001
    assert min(late[0]) > max(late[1])


def test_a_good_drive_passes_the_states_in_order_and_ends_in_go(good):
    states = [str(f["State"]) for f in good.sent("SoilbusStatus")]
    order = list(dict.fromkeys(states))
    assert order[-1] == "valid"
    assert order[: order.index("valid")] in (["degraded", "estimating"], ["estimating"], ["listening", "estimating"])
    ways = {str(f["State"]) for f in good.sent("Traversability", since=good.clock.now - 2.0)}
    assert ways == {"go"}
    before_first = [f for f in good.sent("Traversability") if f["at"] < good.sent("SoilStrength")[0]["at"]]
    assert {str(f["State"]) for f in before_first} == {"unknown"}


def test_the_soil_class_on_the_bus_is_the_likeliest_of_the_result(good):
    sent = good.sent("SoilClass")
    for result, frame in zip(good.results, sent, strict=True):
        share = result.soil_class
        assert share[str(frame["Kind"])] == max(share.values()) == pytest.approx(frame["Probability"], abs=1.26e-4)
        assert frame["UnknownProbability"] == pytest.approx(share["unknown"], abs=1.26e-4)
        assert (frame["Window"], str(frame["Status"])) == (result.index % 251, str(result.status))
    assert str(sent[-1]["Kind"]) == "sandy_loam_15"  # what the recording drives on
    nothing = next(values for name, values in hop_frames(replace(result, soil_class=None)) if name == "SoilClass")
    assert (nothing["Kind"], nothing["Probability"], nothing["UnknownProbability"]) == (None, None, None)


def test_advice_limits_and_forecast_are_those_of_the_result(good):
    for result, advice, limits in zip(
        good.results, good.sent("TractionAdvice"), good.sent("TractionLimits"), strict=True
    ):
        able = result.traversability.capability
        for axle, name in (("front", "Front"), ("rear", "Rear")):
            points = able.set_points[axle]
            assert advice[f"SlipForEfficiency{name}"] == pytest.approx(points.efficiency.value, abs=5.1e-4)
            assert advice[f"SlipForPull{name}"] == pytest.approx(points.pull.value, abs=5.1e-4)
        assert limits["MaxDraft"] == pytest.approx(able.max_draft_here.value, abs=50.1)
        assert limits["MaxDraftStd"] == pytest.approx(able.max_draft_here.std, abs=10.1)
        assert limits["MaxGrade"] == pytest.approx(able.max_grade_with_draft.value, abs=1.01e-3)
        assert limits["MaxGradeStd"] == pytest.approx(able.max_grade_with_draft.std, abs=1.01e-3)
        assert str(limits["LimitingCause"]) == result.traversability.limit
        assert advice["Window"] == limits["Window"] == result.index % 251
        assert str(advice["Status"]) == str(limits["Status"]) == str(result.status)
    known = [f for f in good.sent("DemandForecast") if f["Window"] != "not_available"]
    by_window = {result.index: result.traversability.capability.forecast for result in good.results}
    assert {int(f["Window"]) for f in known} == set(by_window)
    for frame in known:
        forecast = by_window[int(frame["Window"])]
        assert frame["Slip"] == pytest.approx(forecast.slip.value, abs=5.1e-4)
        assert frame["SlipStd"] == pytest.approx(forecast.slip.std, abs=1.01e-3)
        assert frame["Sinkage"] == pytest.approx(1e3 * forecast.deepest.value, abs=0.251)


def test_present_draft_is_that_of_the_vehicles_own_frames_and_blank_without_them(recording, silent):
    of_hitch = load_databases(silent.config).get_message_by_name("DrawbarPin")
    drafts = [
        (m.timestamp, of_hitch.decode(bytes(m.data))["Draft"])
        for m in recording
        if m.arbitration_id == of_hitch.frame_id
    ]
    sent = [(f["at"] + silent.wire.offset, f["Draft"], f["Slope"]) for f in silent.sent("PresentDemand")]
    compared = [f for f in sent if recording[0].timestamp + 2.0 < f[0] < recording[-1].timestamp - 0.2]
    assert len(compared) > 70
    for at, draft, slope in compared[::10]:
        of_last = [value for t, value in drafts if at - 0.4 < t < at]
        assert min(of_last) <= draft <= max(of_last)
        assert abs(slope) < 0.1
    assert (str(sent[-1][1]), str(sent[-1][2])) == ("not_available", "not_available")


def test_quality_of_a_window_names_refusals_and_chi_square_of_each_channel(recording):
    of_hitch = load_databases(CONFIG).get_message_by_name("DrawbarPin")
    broken = [copy(message) for message in recording]
    bad = [m for m in broken if m.arbitration_id == of_hitch.frame_id][::50]
    for message in bad:
        message.data = bytes((*message.data[:7], message.data[7] ^ 1))
    bench = Bench(broken, CONFIG)
    bench.run(DURATION)
    for result, frame in zip(bench.results, bench.sent("WindowQuality"), strict=True):
        assert frame["Window"] == result.index % 251
        assert str(frame["RejectedReason"]) == "bad_checksum"
        assert frame["Rejected"] == sum(result.rejected.values()) >= len(bad) / 3
        assert set(result.channel_chi2) == {"torque", "draft", "sinkage"}
        for channel, chi2 in result.channel_chi2.items():
            assert frame[f"Chi2{channel.capitalize()}"] == pytest.approx(chi2, abs=0.026)


def test_the_warning_is_unknown_until_slip_is_known_and_when_the_bus_falls_silent(silent):
    frames = silent.sent("DemandForecast")
    first = silent.sent("SoilStrength")[0]["at"]
    ends = silent.clock.now - SILENT
    assert {str(f["Warning"]) for f in frames if frames[0]["at"] + 1.0 < f["at"] < first + 1.8} == {"none"}
    during = [f for f in frames if first + 2.5 < f["at"] < ends]
    assert {str(f["Warning"]) for f in during} <= {"none", "immobilisation"}
    assert all(0.0 <= f["TimeLeft"] <= 25.0 for f in during)
    for frame in (f for f in frames if f["at"] > ends + 2.5):
        assert str(frame["Warning"]) == "unknown"
        assert {str(frame[k]) for k in ("Slip", "SlipStd", "Sinkage", "TimeLeft", "Window", "Status")} == {
            "not_available"
        }


@pytest.mark.parametrize("lost", ["GroundBasedSpeedAndDistance", "MotorRL"])
def test_losing_a_needed_stream_ends_go_within_its_timeout(recording, lost):
    database = load_databases(CONFIG)
    names = {m.name for m in database.messages}
    full = next(n for n in names if n.startswith(lost))
    frame_id = database.get_message_by_name(full).frame_id
    cut = recording[0].timestamp + 7.0
    kept = [m for m in recording if m.arbitration_id != frame_id or m.timestamp < cut]
    bench = Bench(kept, CONFIG)
    bench.run(DURATION)
    start = bench.clock.now - DURATION
    late = [f for f in bench.sent("Traversability") if f["at"] > start + 7.0 + 1.0 + 0.25]
    assert late
    assert {str(f["State"]) for f in late} == {"unknown"}
    assert str(bench.sent("SoilbusStatus")[-1]["State"]) == "degraded"


def test_the_journal_says_once_a_minute_which_input_fails(recording, caplog):
    load = load_databases(CONFIG).get_message_by_name("WheelLoads").frame_id
    start = recording[0].timestamp

    def is_lost(t: float) -> bool:  # for 3 s, and again a while later
        return 2.0 <= t - start < 5.0 or 7.0 <= t - start < 9.5

    bench = Bench([m for m in recording if m.arbitration_id != load or not is_lost(m.timestamp)], CONFIG)
    bench.run(DURATION)
    said = [record.getMessage() for record in caplog.records]
    assert [text for text in said if "input" in text] == [
        "input_stale load.FL load.FR load.RL load.RR: no decision while it lasts"
    ]


def test_a_bus_on_which_nothing_was_heard_yet_is_no_failure(caplog):
    bench = Bench([])
    bench.run(5.0)
    assert str(bench.sent("SoilbusStatus")[-1]["Reason"]) == "no_frames"
    assert not caplog.records


def test_silence_ends_go_and_is_no_reason_to_stop(silent):
    last = silent.sent("Traversability", since=silent.clock.now - 3.0)
    assert {str(f["State"]) for f in last} == {"unknown"}
    status = silent.sent("SoilbusStatus")[-1]
    assert (str(status["State"]), str(status["Reason"])) == ("listening", "no_frames")
    assert {str(f["SlipWheel1"]) for f in silent.sent("WheelSlip", since=silent.clock.now - 3.0)} == {"not_available"}


def test_an_outage_between_two_beats_ends_go_too(recording):
    bench = Bench(recording, CONFIG)
    bench.run(7.5)
    assert str(bench.sent("Traversability")[-1]["State"]) == "go"
    gone = bench.clock.now
    bench.wire.fail_receive.append(can.CanOperationError("Network is down", errno.ENETDOWN))
    assert bench.bus.receive(0.0) is None
    assert not bench.bus.is_open
    bench.bus.open()  # before anybody has looked
    bench.run(0.3)  # no window ends meanwhile
    assert bench.bus.counts.lost == 1
    states = [str(f["State"]) for f in bench.sent("Traversability", since=gone + 0.01)]
    assert states
    assert set(states) == {"unknown"}
    bench.run(2.0)
    assert str(bench.sent("Traversability")[-1]["State"]) == "go"


def test_a_window_that_ends_after_an_outage_but_whose_data_end_before_it_is_no_decision(recording):
    """The bus is back in time for the window's window's end at 8 s, and nothing was heard for 0.7 s."""
    begin, gone = recording[0].timestamp, 7.3
    bench = Bench([m for m in recording if not begin + gone <= m.timestamp < begin + gone + 0.7], CONFIG)
    bench.run(gone)
    bench.away = True
    bench.wire.fail_receive.append(can.CanOperationError("Network is down", errno.ENETDOWN))
    bench.run(0.7)
    bench.away, back = False, bench.clock.now
    bench.run(1.5)
    known = [f for f in bench.sent("Traversability", since=back) if str(f["State"]) != "unknown"]
    assert known
    assert all(f["Age"] < f["at"] - back + 0.05 for f in known)  # in steps of 0.1 s


def error_frame(t: float, error_class: int, *data: int) -> can.Message:
    return can.Message(timestamp=t, arbitration_id=error_class, is_error_frame=True, data=bytes(data).ljust(8, b"\0"))


def test_bus_off_ends_go_until_the_controller_is_back(recording):
    begin = recording[0].timestamp
    off, back = error_frame(begin + 7.0, 0x040), error_frame(begin + 8.5, 0x100)
    passed = [m for m in recording if not begin + 7.0 <= m.timestamp < begin + 8.5]
    bench = Bench(sorted([*passed, off, back], key=lambda m: m.timestamp), CONFIG)
    start = bench.clock.now
    bench.run(DURATION)
    during = bench.sent("SoilbusStatus", since=start + 7.05)[0]
    assert (str(during["State"]), str(during["Reason"])) == ("waiting", "bus_error")
    assert {str(f["State"]) for f in bench.sent("Traversability", since=start + 7.1)[:14]} == {"unknown"}
    assert str(bench.sent("BusHealth", since=start + 7.05)[0]["BusState"]) == "bus_off"
    last = bench.sent("BusHealth")[-1]
    assert (str(last["BusState"]), last["ErrorFrames"]) == ("error_active", 2)
    assert str(bench.sent("SoilbusStatus")[-1]["Reason"]) not in ("bus_error", "bus_down")


def test_an_error_passive_controller_is_told_of_beside_a_valid_state(recording):
    passive = error_frame(recording[0].timestamp + 6.5, 0x004, 0, 0x20)
    bench = Bench(sorted([*recording, passive], key=lambda m: m.timestamp), CONFIG)
    bench.run(DURATION)
    status = bench.sent("SoilbusStatus")[-1]
    assert (str(status["State"]), str(status["Reason"])) == ("valid", "bus_error")
    assert str(bench.sent("Traversability")[-1]["State"]) == "go"


def test_a_second_sender_under_our_identifiers_is_told_of_and_never_believed(recording):
    begin = recording[0].timestamp
    ours = Publisher(output_database(CONFIG))
    forged = []
    for i in range(5):
        forged += sent_by(ours, {"Traversability": {"State": "go"}}, begin + 2.0 + 0.1 * i)
    bench = Bench(sorted([*recording, *forged], key=lambda m: m.timestamp), CONFIG)
    start = bench.clock.now
    bench.run(DURATION)
    health = bench.sent("BusHealth")[-1]
    assert (health["ForeignFrames"], bench.bus.counts.foreign) == (5, 5)
    assert bench.service.intake.admission.counts.unknown == 0
    assert health["Received"] == sum(m.timestamp + start - begin <= health["at"] for m in recording) % 4016 > 0
    reasons = {round(f["at"] - start, 1): str(f["Reason"]) for f in bench.sent("SoilbusStatus")}
    told = [t for t, reason in reasons.items() if reason == "foreign_sender"]
    assert told
    assert 2.0 <= min(told) <= max(told) <= 2.4 + 3.0 + 0.1
    assert str(bench.sent("Traversability")[-1]["State"]) == "go"


def test_a_second_sender_ends_go(recording):
    forged = can.Message(timestamp=recording[0].timestamp + 7.0, arbitration_id=0x18FF649A, data=bytes(8))
    bench = Bench(sorted([*recording, forged], key=lambda m: m.timestamp), CONFIG)
    start = bench.clock.now
    bench.run(DURATION)
    verdicts = bench.sent("Traversability")
    assert str(next(f for f in reversed(verdicts) if f["at"] < start + 6.9)["State"]) == "go"
    assert {str(f["State"]) for f in verdicts if f["at"] > start + 7.05} == {"unknown"}
    assert {str(r.status) for r in bench.results} == {"valid"}
    for name in ("SoilStrength", "DraftCapability", "TractionLimits", "SoilClass"):  # nor is anything else vouched for
        status = [(f["at"] - start, str(f["Status"])) for f in bench.sent(name)]
        assert {s for t, s in status if t < 7.0} == {"valid"}
        assert {s for t, s in status if t > 7.05} == {"degraded"}
        assert len(status) == len(bench.results)


def test_stop_says_unknown_last(recording):
    bench = Bench(recording, CONFIG)
    bench.run(7.0)
    assert str(bench.sent("Traversability")[-1]["State"]) == "go"
    bench.service.stop()
    bench.service.run()
    assert str(bench.sent("Traversability")[-1]["State"]) == "unknown"
    assert bench.wire.closed


def test_the_output_dbc_decides_the_identifiers(recording, tmp_path):
    text = output_database(CONFIG).as_dbc_string()
    moved = text.replace(str(0x80000000 | 0x18FF629A), str(0x80000000 | 0x18FF909A))
    (tmp_path / "moved.dbc").write_text(moved)
    ours = output_database(CONFIG).get_message_by_name("WheelSlip").frame_id
    assert ours == 0x18FF629A
    config = reference_configuration([f'output.dbc="{tmp_path / "moved.dbc"}"'])
    bench = Bench(recording, config)
    bench.run(1.0)
    assert 0x18FF909A in {m.arbitration_id for _, m in bench.wire.sent}
    assert ours not in {m.arbitration_id for _, m in bench.wire.sent}


def test_a_window_that_ended_before_the_bus_came_back_says_nothing_of_the_present(recording):
    begin = recording[0].timestamp
    bench = Bench([m for m in recording if not 6.9 <= m.timestamp - begin < 7.25], CONFIG)
    start = bench.clock.now
    bench.run(6.85)
    gone = bench.clock.now
    assert str(bench.sent("Traversability")[-1]["State"]) == "go"
    bench.away = True
    bench.wire.fail_receive.append(can.CanOperationError("Network is down", errno.ENETDOWN))
    bench.run(start + 7.2 - gone)  # a window ends meanwhile, and hardly a half second of it is missing
    bench.away = False
    bench.run(start + 7.95 - bench.clock.now)
    assert bench.bus.is_open
    assert 3 in [result.index for result in bench.results]
    since = [str(f["State"]) for f in bench.sent("Traversability", since=gone + 0.01)]
    assert len(since) >= 4
    assert set(since) == {"unknown"}


class Stamped(ScriptedBus):
    """Hands out messages in the time of the drive, whatever their stamps say."""

    def __init__(self, clock: FakeClock, messages, by: float, since: float) -> None:
        start = messages[0].timestamp
        super().__init__(clock, [copy(m) for m in messages], start)
        self.at = [m.timestamp - self.offset for m in messages]
        for message in self.messages:
            message.timestamp += by if message.timestamp >= start + since else 0.0

    def due(self) -> float:
        return self.at[self.next] if self.next < len(self.at) else math.inf


@pytest.mark.parametrize("by", [-3600.0, 20.0])
def test_a_clock_that_is_set_begins_windows_anew_at_once(by):
    """With it set ahead the service handed out a window of nothing for each second that never was."""
    since, window, duration = 7.0, 4.0, 16.0
    messages = drive_messages(CONFIG, duration)
    bench = Bench(messages, CONFIG)
    bench.wire = Stamped(bench.clock, messages, by, since)
    bench.run(duration)
    start = messages[0].timestamp
    ends = [r.t - start for r in bench.results]
    before, after = ends[:-5], ends[-5:]
    assert before == pytest.approx([4.0, 5.0, 6.0, 7.0][: len(before)], abs=0.01)
    assert len(before) >= 3  # the last one ends with the old time
    assert after == pytest.approx([since + by + window + i for i in range(5)], abs=0.02)
    assert {str(r.status) for r in bench.results} == {"valid"}
    assert [r.index for r in bench.results] == list(range(len(ends)))


def test_garbled_frames_change_nothing_but_a_count(recording, good):
    garbled = Bench(recording, CONFIG)
    while garbled.clock.now < 1000.0 + DURATION - 1.0:
        if len(garbled.wire.fail_receive) == 0:
            garbled.wire.fail_receive.append(ValueError("invalid literal for int() with base 16: 'x3'"))
        garbled.run(0.4)
    assert garbled.bus.counts.garbled > 20
    assert garbled.bus.counts.lost == 0
    found, clean = ([(r.t, r.samples, r.status) for r in bench.results] for bench in (garbled, good))
    assert len(found) >= 5
    assert found == clean[: len(found)]


def test_a_frame_that_is_not_for_us_says_nothing_of_those_behind_it(recording):
    """The machine stands still as a window ends; a frame under our identifier is the first that waits."""
    samples = []
    for theirs in (False, True):
        bench = Bench(recording, CONFIG)
        bench.run(3.895)
        following = bench.wire.next
        if theirs:
            at = recording[following].timestamp
            bench.wire.messages.insert(following, can.Message(timestamp=at, arbitration_id=0x18FF649A, data=bytes(8)))
        bench.clock.now += 0.5
        bench.run(1.0)
        samples.append([result.samples for result in bench.results])
    assert samples[0] == samples[1]
    assert samples[0][0] > 1000


class SlowBus(ScriptedBus):
    """A bus of which each frame takes `cost` [s] to take."""

    cost = 0.0

    def recv(self, timeout: float | None = None) -> can.Message | None:
        message = super().recv(timeout)
        self.clock.now += self.cost if message is not None else 0.0
        return message


def test_a_loop_that_falls_behind_says_so_and_nothing_it_reads_is_fresh(recording):
    """Half of the frames that come can be taken: what is read is ever older, and the frames still go out in time."""
    bench = Bench(recording, CONFIG)
    bench.wire = wire = SlowBus(bench.clock, recording)
    bench.run(DURATION - 4.0)
    assert str(bench.sent("Traversability")[-1]["State"]) == "go"
    wire.cost = 2.0 * DURATION / len(recording)
    began = bench.run(6.0)
    fell_behind = [f for f in bench.sent("Traversability", since=began) if f["at"] > began + 3.5]
    late = wire.clock.now + wire.offset - wire.messages[wire.next].timestamp
    assert late > 2.0
    assert fell_behind
    assert {str(f["State"]) for f in fell_behind} == {"unknown"}
    last = bench.sent("SoilbusStatus")[-1]
    assert (str(last["State"]), str(last["Reason"])) == ("degraded", "overload")
    assert fell_behind[-1]["Age"] == "not_available" or fell_behind[-1]["Age"] > late
    assert {str(f["Status"]) for f in bench.sent("TractionAdvice", since=began + 3.5)} <= {"degraded", "not_available"}
    wire.cost = 0.0
    bench.run(0.5)
    bench.service.step()
    assert str(bench.sent("SoilbusStatus")[-1]["Reason"]) != "no_frames"


class Told(Notifier):
    """What systemd hears."""

    texts: ClassVar[list[str]] = []

    def status(self, text: str) -> None:
        self.texts.append(text)


def test_inputs_whose_samples_are_all_refused_are_called_so_and_not_silent(recording):
    loads = load_databases(CONFIG).get_message_by_name("WheelLoads").frame_id
    cut = [copy(message) for message in recording]
    for message in cut:
        if message.arbitration_id == loads and message.timestamp > recording[0].timestamp + 5.0:
            message.data = message.data[:7]
    bench = Bench(cut, CONFIG)
    bench.service.notifier = told = Told()
    bench.run(4.9)
    assert bench.sent("SoilbusStatus")[-1]["RejectedShare"] == 0.0
    bench.run(5.0)
    last = bench.sent("SoilbusStatus")[-1]
    assert (str(last["State"]), str(last["Reason"])) == ("degraded", "input_rejected")
    assert "input_rejected load.FL (wrong_length) load.FR (wrong_length)" in told.texts[-1]
    signals = Counter(channel.message for channel in bench.service.intake.channels)
    names = {m.frame_id: m.name for m in load_databases(bench.config).messages}
    second = [names[m.arbitration_id] for m in recording if 8.0 < m.timestamp - recording[0].timestamp < 9.0]
    of_loads, of_all = 4 * second.count("WheelLoads"), sum(signals[name] for name in second)
    assert last["RejectedShare"] == pytest.approx(100.0 * of_loads / of_all, abs=1.5)  # not of all since the start


@pytest.mark.parametrize("step", [0.0, -3600.0])
def test_an_input_that_has_had_no_time_to_come_is_not_called_missing(recording, step):
    """Frames begin, or the clock is set, a moment before a status is due, and the loads come last."""
    loads = load_databases(CONFIG).get_message_by_name("WheelLoads").frame_id
    begin, changes = recording[0].timestamp, recording[0].timestamp + (0.0 if step == 0.0 else 3.0)
    messages = [copy(m) for m in recording if m.arbitration_id != loads or not 0.0 <= m.timestamp - changes < 0.3]
    bench = Bench(messages, CONFIG)
    bench.wire.offset -= 0.9
    bench.run(0.9 + changes - begin)
    for message in messages:
        message.timestamp += step
    bench.wire.offset += step
    since = bench.run(3.0)
    assert {str(f["Reason"]) for f in bench.sent("SoilbusStatus", since)} == {"none"}
    bench.wire.messages = [m for m in messages if m.arbitration_id != loads]
    bench.wire.next = len([m for m in bench.wire.messages if m.timestamp < bench.clock.now + bench.wire.offset])
    bench.run(2.5)
    assert str(bench.sent("SoilbusStatus")[-1]["Reason"]) == "input_stale"


def test_after_a_pause_of_an_input_its_windows_say_why_they_are_not_valid(recording):
    """A window with a hole in it is no reason that inputs fail now."""
    loads = load_databases(CONFIG).get_message_by_name("WheelLoads").frame_id
    begin = recording[0].timestamp
    bench = Bench([m for m in recording if m.arbitration_id != loads or not 5.0 < m.timestamp - begin < 6.5], CONFIG)
    bench.run(DURATION - 0.5)
    assert bench.results[-1].reason.startswith("input_stale load.FL")
    again = [f for f in bench.sent("SoilbusStatus") if f["at"] + bench.wire.offset > begin + 7.5]
    assert len(again) >= 2
    assert {(str(f["State"]), str(f["Reason"])) for f in again} == {("degraded", "input_stale")}
    of_loop = {str(f["State"]) for f in bench.sent("Traversability", since=again[0]["at"])}
    assert of_loop == {str(bench.results[-1].traversability.state)} == {"caution"}
