"""Never go unless the truth allows it: random stories, and services without one of their checks."""

from __future__ import annotations

import logging

import pytest

from soilbus.daemon.service import Service
from soilbus.decision.traversability import State as Way
from soilbus.decision.traversability import Traversability
from soilbus.pipeline.intake import Intake
from soilbus.pipeline.states import ServiceState
from tests.lab.stories.drives import cheap, real
from tests.lab.stories.onlooker import CONFIG, Drive, good_moment, good_tracked
from tests.lab.stories.story import TO_ALL, TO_SOME, Event, begin, drawn, end, played

ENOUGH, HEALED = 30, 5
"""Stories that find out each service without a check; every fifth is told until go is due again."""


@pytest.fixture(autouse=True)
def quiet():
    """The journal of a story is long."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize(("machine", "stories"), [("tractor", 10), ("tractor-2wd", 5), ("tractor-axles", 5)])
def test_go_is_said_where_the_truth_allows_it_and_nowhere_else(machine, stories):
    go = 0
    for seed in range(stories):
        drive = cheap(machine)
        story = drawn(seed, drive.needed)
        played(drive, story, healed=seed % HEALED == 0)
        assert drive.faults == [], f"story {seed}: {story}"
        go += drive.go
    assert go > 10 * stories


@pytest.mark.parametrize(("machine", "seed"), [("tractor", 2), ("tractor-2wd", 10)])
def test_an_estimator_that_is_given_nothing_says_no_more_than_the_truth(machine, seed):
    drive = real(seed, machine)
    played(drive, drawn(seed, drive.needed, (*TO_SOME, *TO_ALL)))
    assert drive.faults == []
    assert drive.go


def without_stale_check(monkeypatch):
    monkeypatch.setattr(Intake, "stale", lambda self, now, since=0.0: [])


def without_memory_of_epochs(monkeypatch):
    monkeypatch.setattr(Intake, "epoch", property(lambda self: 1, lambda self, value: None), raising=False)


def with_any_status(monkeypatch):
    monkeypatch.setattr("soilbus.decision.traversability.state_of", lambda p, status, settings: "go")


def with_the_verdict_of_the_run_before(monkeypatch):
    """What was known when the service was stopped is taken for known now, as soon as the inputs are there."""
    usual = Service.present_decision

    def present_decision(self, now):
        knows = self.result is None and self._persistence.stored_prior is not None
        return Traversability(Way.GO) if knows and self._state[0] is ServiceState.ESTIMATING else usual(self, now)

    monkeypatch.setattr(Service, "present_decision", present_decision)


@pytest.mark.parametrize(
    "mutation", [without_stale_check, without_memory_of_epochs, with_any_status, with_the_verdict_of_the_run_before]
)
def test_a_service_without_a_check_is_found_out(mutation, monkeypatch):
    mutation(monkeypatch)
    assert any(played(drive := cheap(), drawn(seed, drive.needed)).faults for seed in range(ENOUGH))


def test_a_go_beside_a_warning_or_beside_slip_that_was_not_forecast_is_found_out(monkeypatch):
    drive = played(cheap(), [])
    assert str(drive.last["State"]) == "go"
    assert "immobilisation is warned of" in set(
        drive.objections(drive.clock.now, drive.last | {"Warning": "immobilisation"})
    )
    monkeypatch.setattr(drive, "excess_slip", lambda: 0.3)
    drive.run(2.0)
    assert any("slipped more than forecast" in fault for fault in drive.faults)


def test_a_window_that_is_solved_when_it_is_too_old_is_no_go():
    drive = played(cheap(), [])
    drive.worker.takes = 2.6  # longer than a posterior counts
    drive.run(3.0)
    before = drive.go
    drive.run(6.0)
    assert drive.go == before
    assert drive.result.status == "valid"
    assert drive.faults == []


def test_go_ends_with_the_age_by_our_own_clock_where_the_stamps_stand():
    drive = played(cheap(), [])
    assert str(drive.last["State"]) == "go"
    drive.wire.halted = True
    drive.run(3.0)
    before = drive.go
    drive.run(3.0)
    assert drive.go == before
    assert drive.last["Age"] > 3.0
    assert drive.faults == []


def test_the_time_since_the_last_valid_posterior_grows_until_there_is_one():
    drive = Drive(good_moment(), good_tracked())
    drive.run(1.0)
    assert drive.last["SinceValid"] == "not_available"
    drive.run(6.5)
    assert drive.last["SinceValid"] <= drive.last["Age"] < 1.2 + CONFIG.estimator.bin
    drive.wire.blind = True
    drive.run(4.0)
    assert str(drive.last["State"]) == "caution"
    assert drive.last["Age"] < 1.2
    assert drive.last["SinceValid"] == pytest.approx(4.5, abs=0.7)
    assert drive.result.traversability.since_valid == pytest.approx(4.0, abs=1.1)
    drive.wire.blind = False
    drive.run(1.2)
    assert drive.last["SinceValid"] < 1.2
    drive.step_clock(-5.0)
    drive.run(0.5)
    assert drive.last["SinceValid"] == "not_available"
    assert drive.faults == []


def test_an_interruption_ends_what_was_known_before_it():
    """Of half a second, so that the window before is still young when the bus is back."""
    drive = played(cheap(), [])
    drive.wire.off = True
    drive.run(0.5)
    drive.wire.off = False
    before = drive.go
    drive.run(0.2)
    assert drive.go == before
    assert drive.last["Age"] < 2.0
    assert drive.faults == []


def test_what_the_worker_says_of_the_time_before_the_clock_was_set_is_not_taken():
    drive = played(cheap(), [])
    drive.run(0.5)
    drive.worker.hangs = True
    drive.run(1.0)
    drive.step_clock(-3600.0)
    drive.run(0.5)
    drive.worker.wake()
    drive.run(0.4)
    assert {str(drive.last[signal]) for signal in ("Window", "Age", "SinceValid")} == {"not_available"}
    assert drive.faults == []


@pytest.mark.parametrize("by", [0.0, -3600.0, 3600.0])
def test_a_torque_limit_that_is_not_sent_any_more_holds(by):
    drive = played(cheap(), [])
    begin(drive, {"unsaid": True})
    drive.run(3.0)
    before = drive.go
    drive.step_clock(by)
    drive.run(4.0)
    assert drive.go == before
    assert str(drive.last["State"]) == "no_go"
    end(drive)
    drive.run(4.0)
    assert str(drive.last["State"]) == "go"
    assert drive.faults == []


def test_one_wild_torque_limit_moves_nothing():
    drive = played(cheap(), [Event({"unsaid": True}, 2.0)])
    begin(drive, {"unsaid": True})
    drive.run(3.0)
    assert str(drive.last["State"]) == "no_go"
    drive.wire.power, drive.wire.mute_from = 1.0, drive.clock.now + drive.wire.cycle  # once
    drive.run(5.0)
    assert str(drive.last["State"]) == "no_go"
    assert drive.faults == []
