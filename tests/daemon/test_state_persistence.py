"""When the state is stored, what it costs the loop, and what the next run makes of it."""

import json
import logging
from collections import Counter
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
import pytest

from fakes import Bench, FakeClock, HeldExecutor, InlineExecutor, ScriptedBus, drive_messages
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.daemon.state_persistence import StatePersistence
from soilbus.daemon.state_store import Owner, read
from soilbus.estimation.gaussian import Gaussian
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.reference import reference_configuration

CONFIG = reference_configuration()
DATABASE = load_databases(CONFIG)
OWNER = Owner.of(CONFIG, Pipeline(CONFIG, DATABASE).intake.channels, DATABASE)
BELIEF = Gaussian(OWNER.median[:6], OWNER.median[6:], np.diag(OWNER.std**2))
DURATION = 14.0
MINUTE, DAY = 60.0, 86400.0
"""Seconds: what a power cut may take, and what a clock that was set back makes of an age."""


@pytest.fixture(scope="module")
def recording():
    return drive_messages(CONFIG, DURATION)


def persistence_in(folder: Path, clock, writer: Executor | None = None) -> StatePersistence:
    return StatePersistence(folder, OWNER, writer or InlineExecutor(), lambda: 1.7e9 + clock())


def stored(folder: Path):
    state = read(folder / "state.json", OWNER)
    assert state is not None
    return state


def service_with(keeper: StatePersistence | None, clock: FakeClock, messages=()) -> Bench:
    return Bench(messages, CONFIG, keeper=keeper, pipeline=Pipeline(CONFIG, DATABASE), clock=clock)


def test_whenever_it_is_killed_the_state_is_no_older_than_a_minute(tmp_path: Path):
    clock = FakeClock()
    bench = service_with(persistence_in(tmp_path, clock), clock)
    oldest, writings = 0.0, set()
    for _ in range(1900):  # a killed service leaves what is there now
        bench.run(0.1)
        at = stored(tmp_path).at
        writings.add(at)
        oldest = max(oldest, 1.7e9 + clock() - at)
    assert oldest <= MINUTE + 0.2
    assert len(writings) == 4  # once a minute and not oftener


def test_a_disk_that_hangs_costs_the_loop_nothing(tmp_path: Path):
    clock, writer = FakeClock(), HeldExecutor()  # a disk that never answers
    bench = service_with(persistence_in(tmp_path, clock, writer), clock)
    bench.run(300.0)
    assert bench.service.deadline_misses == 0
    assert len(writer.held) == 1


@pytest.mark.parametrize(
    ("content", "why"), [(b"{}", "not a state of soilbus"), (b"\x00" * 50, "not JSON"), (None, "Is a directory")]
)
def test_a_state_that_cannot_be_used_is_one_warning_and_a_fresh_start(content, why, tmp_path: Path, caplog):
    if content is None:
        (tmp_path / "state.json").mkdir()
    else:
        (tmp_path / "state.json").write_bytes(content)
    clock = FakeClock()
    with caplog.at_level(logging.INFO):
        persistence = persistence_in(tmp_path, clock)
    assert persistence.stored_prior is None
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    if content is not None:
        assert why in caplog.text
        persistence.tick(clock(), None, dict)
        assert stored(tmp_path).starts == 1


def test_a_folder_that_cannot_be_written_is_one_warning_until_it_can(tmp_path: Path, caplog):
    clock, folder = FakeClock(), tmp_path / "gone"
    persistence = persistence_in(folder, clock)

    def minutes(n: int) -> None:
        for _ in range(n):
            persistence.tick(clock(), BELIEF, dict)
            clock.now += MINUTE

    minutes(10)
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert "No such file or directory" in caplog.text
    folder.mkdir()
    minutes(2)
    assert len(caplog.records) == 1
    assert stored(folder).gaussian is not None
    (folder / "state.json").unlink()
    folder.rmdir()
    minutes(3)
    assert len(caplog.records) == 2


def test_a_start_with_another_configuration_leaves_what_is_stored_until_it_knows_better(tmp_path: Path):
    clock = FakeClock()
    persistence_in(tmp_path, clock).close(BELIEF, {"frames": 3})
    other_config = reference_configuration(["vehicle.mass=3100.0"])
    other = Owner.of(other_config, Pipeline(other_config, DATABASE).intake.channels, DATABASE)
    wrong = StatePersistence(tmp_path, other, InlineExecutor(), lambda: 1.7e9 + clock())
    wrong.tick(clock(), None, lambda: {"frames": 1})
    assert stored(tmp_path).totals == {"frames": 3}
    wrong.close(Gaussian(other.median[:6], other.median[6:], np.diag(other.std**2)), {"frames": 2})
    assert read(tmp_path / "state.json", other).totals == {"frames": 2}


def test_counters_add_up_over_the_runs(tmp_path: Path):
    clock = FakeClock()
    for number in range(1, 4):
        persistence = persistence_in(tmp_path, clock)
        persistence.tick(clock(), None, lambda: {"windows": 7})
        persistence.close(None, {"windows": 10, f"failed.{number}": 1})
        state = stored(tmp_path)
        assert state.starts == number
        assert state.totals == Counter({"windows": 10 * number} | {f"failed.{i}": 1 for i in range(1, number + 1)})


def test_a_belief_keeps_its_age_until_there_is_a_new_one(tmp_path: Path):
    clock = FakeClock()
    first = persistence_in(tmp_path, clock)
    first.close(BELIEF, {})
    began = stored(tmp_path).gaussian.at
    clock.now += 500.0
    second = persistence_in(tmp_path, clock)
    assert second.stored_prior.elapsed == 500.0
    assert np.array_equal(second.stored_prior.gaussian.covariance, BELIEF.covariance)
    second.tick(clock(), None, dict)
    assert stored(tmp_path).gaussian.at == began
    other = Gaussian(BELIEF.soil, BELIEF.gains + 1e-3, BELIEF.covariance)
    for _ in range(3):
        clock.now += MINUTE
        second.tick(clock(), other, dict)
        assert stored(tmp_path).gaussian.at == began + 560.0
    clock.now -= 1e6
    assert persistence_in(tmp_path, clock).stored_prior.elapsed == DAY


def test_a_belief_that_cannot_be_is_not_stored(tmp_path: Path):
    clock = FakeClock()
    persistence = persistence_in(tmp_path, clock)
    persistence.tick(clock(), BELIEF, dict)
    known = stored(tmp_path).gaussian
    persistence.close(Gaussian(BELIEF.soil * np.nan, BELIEF.gains, BELIEF.covariance), {"windows": 3})
    assert stored(tmp_path).gaussian == known
    assert stored(tmp_path).totals == {"windows": 3}


def test_a_run_leaves_what_it_learnt_and_the_next_one_knows_the_sensors(recording, tmp_path: Path):
    clock = FakeClock()
    bench = service_with(persistence_in(tmp_path, clock), clock, recording)
    service = bench.service
    bench.run(DURATION)
    learnt = service.newest_posterior
    service.stop()
    service.run()
    state = stored(tmp_path)
    assert state.gaussian.gains == dict(zip(OWNER.gains, learnt.gains.tolist(), strict=True))
    assert state.totals["windows"] == service.windows > 3
    assert state.totals["frames"] == sum(service.intake.admission.counts.received.values()) > 1000
    assert state.totals["bus.sent"] == service.bus.counts.sent

    for kept in (None, persistence_in(tmp_path, clock)):
        bench = service_with(kept, clock, recording)
        bench.run(DURATION)
        assert first_verdict(bench.wire) >= CONFIG.estimator.window  # what is known of sensors is no window
        gains = bench.service.newest_posterior.gains
    assert not np.array_equal(gains, learnt.gains)


def first_verdict(wire: ScriptedBus) -> float:
    """Seconds from the first frame to the first traversability that is not unknown."""
    message = output_database(CONFIG).get_message_by_name("Traversability")
    known = [
        t for t, m in wire.sent if m.arbitration_id == message.frame_id and message.decode(m.data)["State"] != "unknown"
    ]
    return known[0] - wire.sent[0][0]


def test_the_file_can_be_read_by_people(tmp_path: Path):
    persistence_in(tmp_path, FakeClock()).close(BELIEF, {"windows": 3})
    state = json.loads((tmp_path / "state.json").read_text())["state"]
    assert list(state["gaussian"]["soil"]) == ["k_c", "k_phi", "n", "phi", "c", "K"]
    assert state["gaussian"]["gains"]["torque.FL"] == 0.0
    assert state["totals"] == {"windows": 3}
