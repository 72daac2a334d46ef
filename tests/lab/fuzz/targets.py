"""What is fuzzed: each target takes bytes and raises only where the code under test is wrong."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

import can
import numpy as np
from cantools.database import Database

from fakes import Bench, ScriptedBus
from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.config.file import load_config, shipped_dbc
from soilbus.config.model import Config, ConfigError
from soilbus.grouping import grouped
from soilbus.offline.replay import LogError, read_frames
from soilbus.pipeline.intake import Intake
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import TRACTOR, reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from tests.lab.fuzz.stream import RECORD, Fed, Known, frames_of

MOTORS = [f"wheel.{w}.motor_speed=Motor{w}.ShaftSpeed" for w in ("FL", "FR", "RL", "RR")]
MOST_WINDOWS = 62
"""Per frame: a clock that is set ahead by hours costs a minute of empty windows."""
ROUNDS = 16
MOST_FRAMES = 20_000
"""Of one log that are read."""


class Target(NamedTuple):
    """`one` takes an input and says how many frames it held; seeds are good inputs to start from."""

    one: Callable[[bytes], int]
    seeds: Callable[[], list[bytes]]


@cache
def reference() -> Config:
    return reference_configuration(["estimator.window=2.0", *MOTORS])


@cache
def drive() -> tuple[can.Message, ...]:
    """Two seconds of a drive on clay that is too soft for the draft, where GO would always be wrong."""
    soft = Scenario(
        2.0, (Patch(0.0, "wet_clay"),), Swing(1.2, 1.6), draft=Swing(2e3, 4e3), lift_slip=Swing(0.5, 0.65)
    )  # fmt: skip
    return tuple(frames(simulate(reference(), soft, seed=3), reference()))


@cache
def known() -> tuple[Known, ...]:
    """Its last ROUNDS frames of each message, round after round: a whole turn of the counters."""
    heard = (Known(m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in drive())
    of = grouped(heard, lambda frame: frame.identifier)
    return tuple(k for turn in zip(*(frames[-ROUNDS:] for frames in of.values()), strict=True) for k in turn)


def good_stream() -> list[bytes]:
    """These frames over and over, at some 50 Hz; and the same with bits turned over in every fifth."""
    n, messages = len(known()), len(known()) // ROUNDS
    rows = [bytes([0, i % n, 2 if i % messages else 5, 0, *bytes(8)]) for i in range(20 * n)]
    rng = np.random.default_rng(1)
    harmed = [row[:3] + b"\1" + (rng.bytes(8) if rng.random() < 0.2 else bytes(8)) for row in rows]
    return [b"".join(some) for some in (rows[: 5 * n], harmed[: 5 * n], rows, harmed)]


# --- frames: decoding, admission, binning


def check_frames(data: bytes) -> int:
    """Every frame of a mapped message is admitted or refused for one reason; samples are numbers in their order."""
    return _admitted(_intake(), frames_of(data, known()))


@cache
def vehicle() -> Database:
    return load_databases(reference())


def _intake() -> Intake:
    return Intake(reference(), vehicle())


def _admitted(intake: Intake, stream: Iterator[Fed]) -> int:
    n, counts, now = 0, intake.admission.counts, -math.inf
    last: dict[str, float] = {}
    for n, frame in enumerate(stream, 1):
        intake.admission.feed(*frame)
        now = frame.t if math.isfinite(frame.t) else now
        if n % 64 == 0:
            steps = counts.clock_steps
            for name, column in intake.admission.take(now).columns.items():
                assert np.isfinite(column.t).all()
                assert np.isfinite(column.value).all()
                assert (np.diff(column.t) >= 0.0).all()
                if counts.clock_steps == steps and len(column.t):
                    last[name] = float(column.t[-1])
    intake.admission.take()
    received, admitted = sum(counts.received.values()), sum(counts.admitted.values())
    assert received == admitted + sum(counts.refused.values()), "a frame is neither admitted nor refused"
    assert received + counts.unknown == n, "a frame is not counted"
    assert len(counts.unknown_ids) <= 1024
    return n


# --- windows: what the intake makes of any frames


def check_windows(data: bytes) -> int:
    """Windows come in their order and end; no sensor's reading is infinite in them."""
    intake = _intake()
    n, now, seen = 0, 0.0, 0
    for n, frame in enumerate(frames_of(data, known()), 1):
        intake.admission.feed(*frame)
        now = frame.t if math.isfinite(frame.t) else now
        if n % 100 == 0:
            intake.latest(now)
            seen += _looked_at(intake, now)
            assert seen <= MOST_WINDOWS * n, "windows without end"
    return n


def _looked_at(intake: Intake, now: float) -> int:
    tasks = intake.due(now)
    for task in tasks:
        assert not any(np.isinf(getattr(task.window, q)).any() for q in task.window.variance)
        assert task.end <= now or task.epoch < intake.epoch  # ended before the clock was set
        assert len(task.window.t) <= 21
    return len(tasks)


# --- service: the whole loop


def check_service(data: bytes) -> int:
    """The loop sends what the DBC can say, at its times, and never GO."""
    messages = [
        can.Message(
            timestamp=f.t, arbitration_id=f.identifier, is_extended_id=f.extended, is_remote_frame=f.remote,
            data=b"" if f.remote else f.data[:8],
        )
        for f in frames_of(data[: RECORD * 2400], known())
        if f.extended or f.identifier <= 0x7FF
    ]  # fmt: skip
    bench = Bench(config=reference(), pipeline=Pipeline(reference(), vehicle()))
    bench.wire, database, clock = _Paced(bench.clock, messages), bench.database, bench.clock
    end = clock.now + 0.005 * len(messages) + 2.0
    rounds = 0
    while clock.now < end:
        bench.service.step()
        rounds += 1
        assert rounds < 200 + 400 * (end - 1000.0), "the loop does not wait"
    verdict = database.get_message_by_name("Traversability").frame_id
    for _, message in bench.wire.sent:
        sent = database.decode_message(message.arbitration_id, bytes(message.data))
        assert isinstance(sent, dict)
        assert message.arbitration_id != verdict or str(sent["State"]) != "go"
    return len(messages)


class _Paced(ScriptedBus):
    """Hands out messages every 5 ms, not by their stamps."""

    def recv(self, timeout: float | None = None) -> can.Message | None:
        due = 1000.0 + 0.005 * self.next
        if self.next >= len(self.messages) or due > self.clock.now + (timeout or 0.0):
            self.clock.sleep(max(timeout or 0.0, 1e-4))
            return None
        self.clock.now = max(self.clock.now, due)
        self.next += 1
        return self.messages[self.next - 1]


# --- files: DBC, configuration, model, logs


def check_dbc(data: bytes) -> int:
    """A DBC is refused with ConfigError, or what it says is decoded."""
    with _folder() as folder:
        (folder / "tractor.dbc").write_bytes(data)
        (folder / "f.toml").write_bytes(TRACTOR.read_bytes())
        try:
            config = load_config(folder / "f.toml")
            intake = Intake(config, load_databases(config))
        except ConfigError as error:
            return _refused(error.faults)
        return _admitted(intake, frames_of(_some_frames(), known()))


def check_config(data: bytes) -> int:
    """A configuration is refused with ConfigError, each fault on one line, or a pipeline can be built of it."""
    with _folder() as folder:
        (folder / "f.toml").write_bytes(data)
        try:
            config = load_config(folder / "f.toml")
            pipeline = Pipeline(config, load_databases(config))
        except ConfigError as error:
            return _refused(error.faults)
        return _admitted(pipeline.intake, frames_of(_some_frames(), known()))


def _refused(faults: list[str], where: str = "") -> int:
    """No frame, but what is wrong, each fault on a line of its own."""
    assert faults
    assert all(fault.strip() and "\n" not in fault and where in fault for fault in faults), faults
    return 0


LOGS = (".log", ".log.gz", ".asc", ".blf", ".csv")


def check_logs(data: bytes) -> int:
    """A log of the kind that the first byte picks is read, or refused with one line that names it."""
    with _folder() as folder:
        path = folder / f"a{LOGS[data[0] % len(LOGS)] if data else LOGS[0]}"
        path.write_bytes(data[1:])
        n, intake = 0, _intake()
        try:
            for n, (t, identifier, extended, content, remote, error) in enumerate(read_frames(path), 1):
                if not error:
                    intake.admission.feed(t, identifier, extended, content, remote)
                if n >= MOST_FRAMES:
                    break
        except LogError as error:
            _refused([str(error)], str(path))
        intake.ingest(1.7e9 + 10.0)
        return n


def _log_seeds() -> list[bytes]:
    found = []
    with _folder() as folder:
        for i, suffix in enumerate(LOGS):
            path = folder / f"good{suffix}"
            write_log(drive()[:200], path)
            found.append(bytes([i]) + path.read_bytes())
    return found


@cache
def _some_frames() -> bytes:
    return good_stream()[1]


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="soilbus-fuzz-") as path:
        yield Path(path)


def _dbc_seeds() -> list[bytes]:
    whole = shipped_dbc("tractor.dbc").read_bytes()
    return [whole, whole.split(b"CM_ ")[0]]


MODEL = b"""
[model]
effects = [
    {name = "slip_sinkage", softening = {value = 0.3, std = 0.1}},
    {name = "wheel_load_offset", offset = {FL = 100.0, RR = {value = -50.0, std = 10.0}}},
]
"""


TARGETS: dict[str, Target] = {
    "frames": Target(check_frames, good_stream),
    "windows": Target(check_windows, good_stream),
    "service": Target(check_service, lambda: good_stream()[:2]),
    "dbc": Target(check_dbc, _dbc_seeds),
    "config": Target(check_config, lambda: [TRACTOR.read_bytes(), TRACTOR.read_bytes() + MODEL]),
    "logs": Target(check_logs, _log_seeds),
}
