"""GO ends with the facts: frames of drives that end stuck in, frames and windows out."""

from __future__ import annotations

from collections.abc import Iterable

import can
import pytest

from fakes import Bench, ScriptedBus, feed_message
from in_vain import (
    STANDS,
    TRIES,
    Story,
    halted_by_a_patch,
    stop_and_try,
    turned_onto,
    with_a_dead_axle,
    with_a_soft_side,
)
from soilbus.can.dbc_files import load_databases
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.simulator.reference import REFERENCES, reference_configuration

CONFIG = reference_configuration()
NOT_STRICT = ["estimator.max_bearing_std=1.0", "estimator.max_draft_std=1.0"]
"""Short drives of machines without load cells say little of pressure and draft, and a go is to end here."""
MACHINES = {
    name: reference_configuration([] if name == "tractor" else NOT_STRICT, path) for name, path in REFERENCES.items()
}


def replayed(messages: Iterable[can.Message], config=CONFIG, database=None) -> list[WindowResult]:
    database = load_databases(config) if database is None else database
    pipeline, results, due, last = Pipeline(config, database), [], 0.0, 0.0
    for message in messages:
        last = message.timestamp
        if not due - 1.0 <= last < due:
            results += pipeline.advance(last)
            due = last + 0.1
        feed_message(pipeline.admission, message)
    return results + pipeline.finish(last)


def live(messages: list[can.Message], config=CONFIG) -> list[tuple[float, str, dict]]:
    """(time of the drive [s], name, signals) of what the service sends."""
    bench, start = Bench(config=config, pipeline=Pipeline(config, load_databases(config))), messages[0].timestamp
    bench.wire = ScriptedBus(bench.clock, messages, start)
    began = bench.run(messages[-1].timestamp - start)
    sent = [
        (frame["at"] - began + start, name, frame)
        for name in ("Traversability", "DemandForecast", "DraftCapability")
        for frame in bench.sent(name)
    ]
    return sorted(sent, key=lambda frame: frame[0])


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


@pytest.mark.parametrize(
    ("machine", "attempt"),
    [
        ("tractor", "left wheels spin"), ("tractor", "diagonal wheels spin"), ("tractor", "all wheels spin slowly"),
        ("tractor", "half of the limit"), ("tractor", "motors at their limit"), ("tractor-2wd", "one wheel spins"),
        ("tractor-2wd", "rear wheels spin"),
    ],
)  # fmt: skip
def test_a_start_in_vain_ends_go_on_the_bus(machine, attempt):
    config = MACHINES[machine]
    story = stop_and_try(config, TRIES[attempt], seed=list(TRIES).index(attempt))
    judge(story, live(story.messages, config))


@pytest.mark.parametrize("machine", ["tractor", "tractor-axles"])
def test_a_soft_patch_under_one_side_ends_go_on_the_bus(machine):
    config = MACHINES[machine]
    story = halted_by_a_patch(config, 11)
    sent = live(story.messages, config)
    assert "go" in {state for at, state in states(sent) if at < story.begins - 2.0}
    for at, state in states(sent):
        if at > story.begins + 1.0:
            assert state in ("no_go", "caution") if at < story.begins + 2.0 else state == "no_go"
    assert {w for at, w in states(sent, "DemandForecast", "Warning") if at > story.begins + 1.0} == {"immobilisation"}


def test_a_vehicle_that_merely_stands_is_unknown_after_the_age_of_its_data():
    config = MACHINES["tractor-axles"]
    story = stop_and_try(config, STANDS, seed=31)
    stood = story.begins - 1.5
    sent = live(story.messages, config)
    by_speed = 0.2 / 0.5  # below min_speed no slip is judged
    last = max(at for at, state in states(sent) if state == "go")
    max_age = CONFIG.traversability.max_age
    assert stood - by_speed + max_age - 0.6 < last < stood - by_speed + max_age + 0.3
    assert {state for at, state in states(sent) if at > last + 0.2} == {"unknown"}
    assert "immobilisation" not in {w for at, w in states(sent, "DemandForecast", "Warning") if at > stood}


def test_a_turn_leaves_the_measured_ground_behind():
    # In a turn no instant is judged: once the vehicle is off the ground that was, nothing says that it may go on.
    story = turned_onto(CONFIG, "wet_clay", seed=51)
    wheelbase, speed, window_hop = 1.95, 1.2, 1.0
    left_behind = wheelbase / speed + window_hop
    found = [(at - story.begins, state) for at, state in states(live(story.messages))]
    assert "go" in {state for at, state in found if -2.0 < at < 0.0}
    assert not [at for at, state in found if left_behind + 0.2 < at < 8.0 and state == "go"]


@pytest.mark.parametrize("dead", ["front", "rear"])
def test_motors_that_give_nothing_are_not_counted_on(dead):
    # Their limit says 2400 N m.
    story, most = with_a_dead_axle(CONFIG, dead, "loam", seed=61)
    results = replayed(story.messages)
    judged = [r.traversability for r in results if r.traversability.max_draft is not None]
    assert len(judged) >= 5
    for way in judged:
        assert way.max_draft.value == pytest.approx(most, abs=max(4.0 * way.max_draft.std, 150.0))
    asked = [w.torque_available for w in judged]
    assert asked == pytest.approx([2.0 * 2400.0] * len(asked), rel=5e-3)


def test_a_side_that_gives_way_takes_go_and_its_promises_away():
    # The left wheels come onto wet clay within three seconds; the draft is all but the most that is then pulled.
    story, most, held = with_a_soft_side(CONFIG, "wet_clay", seed=71)
    assert held > most / (1.0 + CONFIG.traversability.margin)
    sent = live(story.messages)
    assert "go" in {state for at, state in states(sent) if at < story.begins}
    after = [(at, of, values) for at, of, values in sent if at > story.begins + 1.3]
    assert "go" not in {str(v["State"]) for _, of, v in after if of == "Traversability"}
    odds = [v["Probability"] for _, of, v in after if of == "Traversability"]
    assert not [p for p in odds if isinstance(p, float) and p > CONFIG.traversability.go]
    promised = [v["MaxDraft"] for _, of, v in after if of == "DraftCapability"]
    assert not [draft for draft in promised if isinstance(draft, float) and draft > 1.2 * most]
