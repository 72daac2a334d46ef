"""GO ends with the facts: frames of drives that end stuck in, frames and windows out."""

from __future__ import annotations

from collections.abc import Iterable

import can
import pytest

from fakes import FakeClock, InlineExecutor, ScriptedBus
from feeding import feed_message
from in_vain import STANDS, TRIES, Story, halted_by_a_patch, stop_and_try
from soilbus.can.bus import LiveBus
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Publisher
from soilbus.daemon.notify import Notifier
from soilbus.daemon.pipeline import Pipeline
from soilbus.daemon.result import WindowResult
from soilbus.daemon.service import Service
from soilbus.simulator.reference import reference_configuration
from soilbus.traversability import State, Status

CONFIG = reference_configuration()
IN, OUT = load_databases(CONFIG), output_database(CONFIG)


def replayed(messages: Iterable[can.Message]) -> list[WindowResult]:
    pipeline, results, due, last = Pipeline(CONFIG, IN), [], 0.0, 0.0
    for message in messages:
        last = message.timestamp
        if not due - 1.0 <= last < due:
            results += pipeline.advance(last)
            due = last + 0.1
        feed_message(pipeline.admission, message)
    return results + pipeline.finish(last)


def live(messages: list[can.Message]) -> list[tuple[float, str, dict]]:
    """(time of the drive [s], name, signals) of what the service sends."""
    clock = FakeClock()
    start = messages[0].timestamp
    wire = ScriptedBus(clock, messages, start=start)
    bus = LiveBus(lambda: wire, clock, clock.sleep)
    service = Service(
        CONFIG, Pipeline(CONFIG, IN), bus, Publisher(OUT), Notifier(), InlineExecutor(), clock, waiting=clock.wait_for
    )  # fmt: skip
    end = 1000.0 + messages[-1].timestamp - start
    while clock.now < end:
        service.step()
    sent = []
    for at, message in wire.sent:
        name = OUT.get_message_by_frame_id(message.arbitration_id).name
        if name in ("Traversability", "DemandForecast", "DraftCapability"):
            sent.append((at - 1000.0 + start, name, OUT.decode_message(message.arbitration_id, bytes(message.data))))
    return sent


def states(sent, name="Traversability", signal="State"):
    return [(at, str(values[signal])) for at, of, values in sent if of == name]


def judge(story: Story, sent) -> None:
    """GO before, gone within one second, NO-GO within two and as long as it lasts; the warning with it."""
    before = [state for at, state in states(sent) if story.begins - 3.0 < at < story.begins - 2.0]
    assert "go" in before
    for at, state in states(sent):
        if at > story.begins + 1.0:
            assert state != "go", f"{at - story.begins:.2f} s"
        if at > story.begins + 2.0:
            assert state == "no_go", f"{at - story.begins:.2f} s"
    assert {w for at, w in states(sent, "DemandForecast", "Warning") if at > story.begins + 1.0} == {"immobilisation"}
    promised = [v for at, of, v in sent if of == "DraftCapability" and at > story.begins + 2.2]
    assert promised
    assert {str(v["MaxDraft"]) for v in promised} == {"not_available"}
    assert "valid" not in {str(v["Status"]) for v in promised}


@pytest.mark.parametrize("attempt", TRIES)
def test_a_start_in_vain_ends_go_on_the_bus(attempt):
    story = stop_and_try(CONFIG, TRIES[attempt], seed=list(TRIES).index(attempt))
    judge(story, live(story.messages))


@pytest.mark.parametrize("seed", [11, 12])
def test_a_soft_patch_under_one_side_ends_go_on_the_bus(seed):
    story = halted_by_a_patch(CONFIG, seed)
    sent = live(story.messages)
    assert "go" in {state for at, state in states(sent) if at < story.begins - 2.0}
    for at, state in states(sent):
        if at > story.begins + 1.0:
            assert state in ("no_go", "caution") if at < story.begins + 2.0 else state == "no_go"
    assert {w for at, w in states(sent, "DemandForecast", "Warning") if at > story.begins + 1.0} == {"immobilisation"}


@pytest.mark.parametrize("attempt", ["left wheels spin", "motors at their limit"])
def test_a_replay_says_what_the_service_says(attempt):
    story = stop_and_try(CONFIG, TRIES[attempt], seed=21)
    results = replayed(story.messages)
    assert State.GO in {r.traversability.state for r in results if r.t < story.begins}
    after = [r for r in results if r.t > story.begins + 1.0]
    assert all(r.traversability.state is not State.GO and r.watch.warning == "immobilisation" for r in after)
    late = [r for r in after if r.t > story.begins + 2.0]
    assert len(late) >= 5
    for r in late:
        assert r.traversability.state is State.NO_GO
        assert r.traversability.probability == 0.0
        assert r.traversability.max_draft is None
        assert r.status is not Status.VALID


def test_a_vehicle_that_merely_stands_is_unknown_after_the_age_of_its_data():
    story = stop_and_try(CONFIG, STANDS, seed=31)
    stood = story.begins - 1.5
    sent = live(story.messages)
    by_speed = 0.2 / 0.5  # below min_speed no slip is judged
    last = max(at for at, state in states(sent) if state == "go")
    max_age = CONFIG.traversability.max_age
    assert stood - by_speed + max_age - 0.6 < last < stood - by_speed + max_age + 0.3
    assert {state for at, state in states(sent) if at > last + 0.2} == {"unknown"}
    assert "immobilisation" not in {w for at, w in states(sent, "DemandForecast", "Warning") if at > stood}
