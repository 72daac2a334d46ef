"""A short seeded run of every fuzz target, and what longer runs have found."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from soilbus.can.dbc_files import load_databases
from soilbus.pipeline.intake import Intake
from tests.lab.fuzz.mutation import mutated
from tests.lab.fuzz.stream import STEPS, frames_of
from tests.lab.fuzz.targets import ROUNDS, TARGETS, known, reference

INPUTS = 6


@pytest.mark.parametrize("name", TARGETS)
def test_mutated_inputs_do_no_harm(name):
    target, rng = TARGETS[name], np.random.default_rng(7)
    seeds = target.seeds()
    for data in [*seeds, *(mutated(seeds, rng) for _ in range(INPUTS))]:
        target.one(data)


def test_the_seeds_are_good_inputs():
    """A fuzzer that starts from what is refused anyway finds nothing."""
    for name, least in (("frames", 20), ("windows", 20), ("service", 20), ("logs", 20), ("dbc", 801), ("config", 801)):
        assert all(TARGETS[name].one(data) >= least for data in TARGETS[name].seeds()), name
    for data in TARGETS["frames"].seeds()[::2]:
        intake = Intake(reference(), load_databases(reference()))
        for frame in frames_of(data, known()):
            intake.admission.feed(*frame)
        intake.ingest()
        assert not intake.refusals.total


BYTE = st.integers(0, 255)
RECORDS = st.lists(
    st.tuples(BYTE, BYTE, st.integers(190, 255), BYTE, st.binary(min_size=8, max_size=8)), max_size=40
)  # fmt: skip


@settings(max_examples=30, suppress_health_check=[HealthCheck.too_slow])
@given(RECORDS)
def test_frames_with_any_stamp_are_counted_and_end(records):
    data = b"".join(bytes(head) + payload for *head, payload in records)
    assert TARGETS["frames"].one(data) == len(records)
    TARGETS["windows"].one(data * 4)


@pytest.fixture
def intake() -> Intake:
    return Intake(reference(), load_databases(reference()))


def fed(intake: Intake, *steps: float) -> float:
    """Good frames of all messages, their clock moved by each step [s]; the last time."""
    messages = len(known()) // ROUNDS
    now = 1000.0
    for i, step in enumerate(steps):
        now += step
        for frame in known()[i % ROUNDS * messages :][:messages]:
            intake.admission.feed(now, frame.identifier, frame.extended, frame.data)
    return now


def test_decades_between_two_frames_of_one_batch_are_no_windows(intake):
    """Found: a clock set from 1970 to today before the first tick counted every window between, for ever."""
    now = fed(intake, *[0.02] * 5, 1.7e9, *[0.02] * 200)
    intake.ingest()
    tasks = intake.due(now)
    assert len(tasks) <= 3
    assert all(task.start > 1.7e9 for task in tasks)


def test_decades_of_refused_samples_are_no_windows(intake):
    """Found: as above, where no sensor had said anything that is admitted."""
    radar = next(k for k in known() if len(k.data) == 8 and k.identifier & 0x3FFFF00 == 0xFE4900)
    for t in (1000.0, 1000.1):
        intake.admission.feed(t, radar.identifier, True, b"\xff" * 8)
    assert intake.due(1000.2) == []
    assert len(intake.due(1.7e9)) <= 62


def test_decades_of_silence_need_no_memory_to_look_back(intake):
    """Found: a glimpse of the present made a bin for each tenth of a second since the last frame."""
    now = fed(intake, *[0.02] * 50)
    intake.ingest()
    assert set(intake.latest(now).slip.values()) != {None}
    for later in (1.7e9, 1e300, math.inf, math.nan):
        assert set(intake.latest(later).slip.values()) == {None}


@pytest.mark.parametrize("t", [s for s in STEPS if abs(s) > 1e11])
def test_a_stamp_that_is_no_time_is_refused_and_changes_nothing(t, intake):
    """Found: 1e300 s is a time at which one second more is the same time, so windows never ended."""
    fed(intake, *[0.02] * 48)
    frame, counts = known()[0], intake.admission.counts
    before = counts.admitted.total()
    intake.admission.feed(t, frame.identifier, frame.extended, frame.data)
    intake.admission.feed(1001.0, frame.identifier, frame.extended, frame.data)
    intake.ingest()
    assert counts.clock_steps == 0
    assert counts.refused == {("MotorFL", "bad_time"): 1}
    assert counts.admitted.total() == before + 48 * len(known()) // ROUNDS + 1
