"""What systemd's watchdog hears: that the service works, and nothing while it does not."""

import errno
import itertools
import logging
import re
from concurrent.futures import Executor
from dataclasses import dataclass, field

import can
import pytest

from fakes import Bench, FakeClock, HeldExecutor, drive_messages
from soilbus.can.dbc_files import load_databases
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.reference import reference_configuration

WINDOW = 8.0
CONFIG = reference_configuration([f"estimator.window={WINDOW}"])
DATABASE = load_databases(CONFIG)
WATCHDOG = 10.0
HARD_WINDOW = 18.0
"""Seconds that a window may take: a slow machine's hardest take a few."""
FULL_BUS = 28.0
"""Seconds for which nothing of ours may find room on a bus that is full."""
AT_LEAST = 4.0
"""Seconds beyond these and systemd's patience within which what hangs is restarted."""
LONG = 60.0
"""Seconds by which all that hangs was restarted: more than FULL_BUS, AT_LEAST and systemd's patience together."""
SEVERAL = 3
"""Windows in a row that fail by a defect before the service reports a fault: one may be of bad luck."""


@dataclass
class Systemd:
    """The notifier's place, with a clock: when it was told that all is well, and what the status was."""

    clock: FakeClock
    watchdog_interval: float = WATCHDOG / 2.0
    fed: list[float] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)

    def watchdog(self) -> None:
        self.fed.append(self.clock())

    def status(self, text: str) -> None:
        self.texts.append(text)

    def would_restart(self, since: float) -> bool:
        """Whether it was left alone for longer than WatchdogSec."""
        fed = [since, *(t for t in self.fed if t > since), self.clock()]
        return max(b - a for a, b in itertools.pairwise(fed)) > WATCHDOG


@pytest.fixture(scope="module")
def drive():
    """Frames of a good drive."""
    return drive_messages(CONFIG, 16.0)


@pytest.fixture(scope="module")
def moments(drive):
    """A few of them, as often as a needed input must be heard."""
    return [m for m in drive if m.timestamp < drive[0].timestamp + 4.0]


class WatchedBench(Bench):
    """A service that systemd watches, with these frames, or with them over and over for so many seconds."""

    def __init__(self, moments, seconds: float = 0.0, worker: Executor | None = None) -> None:
        clock, pipeline = FakeClock(), Pipeline(CONFIG, DATABASE)
        self.systemd, self.estimator = Systemd(clock), pipeline.estimator
        self.made = 0
        """Estimators in place of the first one."""
        self.replacement: WindowEstimator | None = None
        """What is taken in its place; None: one that knows nothing."""
        usual = pipeline.new_estimator

        def new_estimator() -> WindowEstimator:
            self.made += 1
            return self.replacement or usual()

        pipeline.new_estimator = new_estimator
        messages = over_and_over(moments, seconds) if seconds else moments
        super().__init__(messages, CONFIG, worker, self.systemd, pipeline=pipeline, clock=clock)


def over_and_over(moments, seconds: float):
    """The same seconds again and again with time going on; all frames, for their counters must go on by one."""
    length = moments[-1].timestamp - moments[0].timestamp + 0.02
    for i in range(int(seconds / length)):
        for m in moments:
            yield can.Message(
                timestamp=m.timestamp + i * length, arbitration_id=m.arbitration_id, is_extended_id=m.is_extended_id,
                data=m.data,
            )  # fmt: skip


def test_silence_is_no_reason_to_restart(moments):
    bench = WatchedBench(moments, 5.0)
    began = bench.run(LONG)
    assert not bench.systemd.would_restart(began)
    assert bench.systemd.texts[-1].startswith("listening: no_frames")


@pytest.mark.parametrize("at_start", [True, False])
def test_nor_is_a_bus_that_is_down(moments, at_start):
    bench = WatchedBench(moments, 5.0)
    bench.away = at_start
    began = bench.run(5.0)
    bench.away = True
    bench.wire.fail_receive.append(can.CanOperationError("Network is down", errno.ENETDOWN))
    bench.run(LONG)
    assert not bench.systemd.would_restart(began)
    assert bench.systemd.texts[-1].startswith("waiting: bus_down")


def test_nor_is_a_bus_on_which_nobody_else_is(moments, caplog):
    """Without anybody to acknowledge them, our frames fill the queue."""
    bench = WatchedBench([])
    bench.wire.fail_send += [can.CanOperationError("No buffer space", errno.ENOBUFS)] * 100_000
    began = bench.run(LONG)
    assert bench.service.bus.counts.sent == 0
    assert not bench.systemd.would_restart(began)


def test_an_estimator_that_hangs_is_restarted(moments, caplog):
    worker = HeldExecutor(holds=False)
    bench = WatchedBench(moments, 60.0, worker)
    began = bench.run(6.0)
    assert not bench.systemd.would_restart(began)
    worker.holds = True
    hung = bench.run(HARD_WINDOW)
    assert not bench.systemd.would_restart(hung)
    bench.run(WATCHDOG + AT_LEAST)
    assert bench.systemd.would_restart(hung)
    assert bench.service.deadline_misses > 3  # windows that found no worker
    last = bench.sent("SoilbusStatus")[-1]
    assert (str(last["State"]), str(last["Reason"])) == ("fault", "overload")
    assert last["DeadlineMisses"] == pytest.approx(bench.service.deadline_misses, abs=1)
    told = re.search(r"deadline misses (\d+)", bench.systemd.texts[-1])
    assert int(told[1]) == last["DeadlineMisses"]
    assert {str(f["State"]) for f in bench.sent("Traversability", hung + 4.0)} == {"unknown"}
    assert [r.levelname for r in caplog.records] == ["ERROR"]


def test_a_sender_that_hangs_on_a_living_bus_is_restarted(moments, caplog):
    bench = WatchedBench(moments, 60.0)
    bench.run(5.0)
    bench.wire.fail_send += [can.CanOperationError("No buffer space", errno.ENOBUFS)] * 100_000
    mute = bench.run(FULL_BUS)
    assert not bench.systemd.would_restart(mute)
    bench.run(WATCHDOG + AT_LEAST)
    assert bench.systemd.would_restart(mute)
    assert bench.systemd.texts[-1].startswith("fault: internal nothing can be sent")
    assert sum(r.levelname == "ERROR" for r in caplog.records) == 1
    bench.wire.fail_send.clear()
    healed = bench.run(8.0)
    assert any(t > healed for t in bench.systemd.fed)
    assert not bench.systemd.texts[-1].startswith("fault")


def broken(estimator, windows: range):
    """Has the estimator raise at these windows."""
    usual = estimator.estimate

    def estimate(task):
        if task.index in windows:
            raise ZeroDivisionError("what nobody\nthought of")
        return usual(task)

    estimator.estimate = estimate


def test_one_defect_costs_one_window(drive, caplog):
    bench = WatchedBench(drive)
    broken(bench.estimator, range(6, 7))
    bench.run(WINDOW + 5.5)
    known = bench.estimator.tracker.newest_posterior
    assert known is not None
    assert bench.service.windows == 6
    bench.run(1.0)
    assert bench.estimator.tracker.newest_posterior is known
    assert bench.service.failures["internal"] == 1
    assert bench.sent("Traversability")[-1]["State"] == "unknown"
    assert str(bench.sent("SoilStrength")[-1]["Status"]) == "invalid"
    bench.run(1.0)
    assert "failed solves: internal 1" in bench.systemd.texts[-1]
    assert bench.estimator.tracker.newest_posterior is not known
    assert bench.sent("Traversability")[-1]["State"] == "go"
    assert bench.service.failures["internal"] == 1
    assert all(f["State"] != "fault" for f in bench.sent("SoilbusStatus"))
    (record,) = [r for r in caplog.records if r.levelno >= logging.ERROR]
    assert record.exc_info is None
    assert "\n" not in record.getMessage()
    assert "window 6 failed: ZeroDivisionError: what nobody thought of (test_health.py:" in record.getMessage()


def test_a_defect_in_every_window_is_a_fault_until_an_estimator_that_knows_nothing_heals_it(drive, caplog):
    bench = WatchedBench(drive)
    broken(bench.estimator, range(1, 100))
    bench.run(WINDOW + SEVERAL)
    assert "fault" not in {str(f["State"]) for f in bench.sent("SoilbusStatus")}
    bench.run(0.9)  # until just before the next window ends
    last = bench.sent("SoilbusStatus")[-1]
    assert (str(last["State"]), str(last["Reason"])) == ("fault", "internal")
    assert bench.made == 1
    bench.run(2.2)
    assert bench.sent("SoilbusStatus")[-1]["State"] == "valid"
    assert bench.service.failures["internal"] == SEVERAL
    assert len([r for r in caplog.records if r.levelno >= logging.ERROR]) == SEVERAL


def test_a_fault_that_stays_is_not_logged_window_by_window(drive, caplog):
    bench = WatchedBench(drive)
    bench.replacement = bench.estimator
    broken(bench.estimator, range(100))
    bench.run(16.0)
    assert bench.service.failures["internal"] > 2 * SEVERAL
    assert len([r for r in caplog.records if r.levelno >= logging.ERROR]) == SEVERAL
    assert bench.sent("SoilbusStatus")[-1]["State"] == "fault"
    assert {str(f["State"]) for f in bench.sent("Traversability")} == {"unknown"}
