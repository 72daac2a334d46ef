"""`python -m tests.mutations [WORD…]`: each guard taken out of a copy of service/, and the tests that must notice.

Prints for each mutation whether it was killed; exit code 1 if one survived, if its text is gone from the code (the
list must then be mended), or if its tests fail without it.  With words, only mutations whose names hold one of them.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
SOURCE = "service/soilbus"
FAILED = 1
"""Exit code of pytest where tests fail, and not the machinery."""


class Mutation(NamedTuple):
    """Another text in one place of a file below service/soilbus, and the tests (pytest arguments) that kill it."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


STORIES = "tests/lab/test_stories.py"
DECISION = "tests/daemon/test_decision.py"
MUTATIONS = (
    Mutation(
        "a window of before an interruption counts", "daemon/service.py",
        "None if self._reached <= self._interrupted else self.result", "self.result",
        (f"{STORIES}::test_an_interruption_ends_what_was_known_before_it",),
    ),
    Mutation(
        "a decision after an outage rests on data of before", "daemon/service.py",
        "ended - (result.t - result.basis.end) if len(result.basis.instants) else ended", "ended",
        ("tests/daemon/test_loop.py::"
         "test_a_window_that_ends_after_an_outage_but_whose_data_end_before_it_is_no_decision",),
    ),
    Mutation(
        "a posterior counts at any age", "decision/judgement.py",
        "now - basis.end <= settings.max_age and ", "",
        (f"{STORIES}::test_a_window_that_is_solved_when_it_is_too_old_is_no_go",),
    ),
    Mutation(
        "a posterior's age is by the stamps alone", "daemon/service.py",
        "max(by_stamps, self.result.t + now - self._ended)", "by_stamps",
        (f"{STORIES}::test_go_ends_with_the_age_by_our_own_clock_where_the_stamps_stand",),
    ),
    Mutation(
        "frames that wait in the kernel are as fresh as if they had just come", "daemon/bus_time.py",
        "max(self._stamp, now + self._offset)", "self._stamp + max(0.0, now - self.last_frame)",
        ("tests/daemon/test_loop.py::test_a_loop_that_falls_behind_says_so_and_nothing_it_reads_is_fresh",),
    ),
    Mutation(
        "a late result of the old epoch is taken", "daemon/service.py",
        "if pending.epoch == self.intake.epoch:", "if True:",
        (f"{STORIES}::test_what_the_worker_says_of_the_time_before_the_clock_was_set_is_not_taken",),
    ),
    Mutation(
        "stale inputs do not interrupt", "pipeline/intake.py",
        "if not now - self.last_seen.get(c.name, since) <= self._timeout(c)", "if False",
        ("tests/daemon/test_loop.py::test_losing_a_needed_stream_ends_go_within_its_timeout",),
    ),
    Mutation(
        "another sender does not interrupt", "daemon/service.py",
        "if now - self.bus.last_foreign < FOREIGN_SENDER_HOLD_TIME:", "if False:",
        ("tests/daemon/test_loop.py::test_a_second_sender_ends_go",),
    ),
    Mutation(
        "wheels that spin leave go as it was", "decision/judgement.py",
        "if watch.spinning and decision.state is not State.NO_GO:", "if False:",
        (f"{DECISION}::test_a_wheel_that_spins_is_caution_at_best_and_at_least",),
    ),
    Mutation(
        "a vehicle that is stuck may go", "decision/judgement.py",
        "    if watch.stuck:\n        return Traversability(", "    if False:\n        return Traversability(",
        ("tests/daemon/test_facts.py::test_a_start_in_vain_ends_go_on_the_bus",),
    ),
    Mutation(
        "ground left behind counts as the present one", "decision/judgement.py",
        " and basis.unseen <= length):", "):",
        (f"{DECISION}::test_ground_left_behind_is_unknown",),
    ),
    Mutation(
        "a little measured since a wheel spun is enough", "decision/judgement.py",
        "measured < settings.min_share * config.estimator.window", "False",
        (f"{DECISION}::test_a_little_measured_since_a_wheel_spun_is_no_go",),
    ),
    Mutation(
        "hysteresis without a past", "pipeline/estimator.py",
        "settled(self._held, decision", "settled(Held(), decision",
        (f"{DECISION}::test_a_better_state_needs_two_windows_in_a_row",),
    ),
    Mutation(
        "a new ground does not end what was held", "pipeline/estimator.py",
        "self._held, self._valid_at = Held(), None", "self._valid_at = None",
        (f"{DECISION}::test_a_fresh_window_is_not_held_back_by_hysteresis",),
    ),
    Mutation(
        "any bit of a new soil is enough", "pipeline/estimator.py",
        " or tracked.since > task.end - enough", "",
        (f"{DECISION}::test_a_little_of_a_new_soil_is_no_go",),
    ),
    Mutation(
        "a torque limit holds for a second", "pipeline/intake.py",
        "value[t <= now][-self._samples :]", "value[(t <= now) & (t > now - 1.0)][-self._samples :]",
        (f"{STORIES}::test_a_torque_limit_that_is_not_sent_any_more_holds",),
    ),
    Mutation(
        "a torque limit is forgotten with the clock", "pipeline/intake.py",
        "(np.full(len(t), -math.inf), value) for wheel, (t, value) in self._reported.items()",
        "(t[:0], value[:0]) for wheel, (t, value) in self._reported.items()",
        (f"{STORIES}::test_a_torque_limit_that_is_not_sent_any_more_holds",),
    ),
    Mutation(
        "a wild torque limit counts", "sensors/options.py",
        "limit_samples: int = 3", "limit_samples: int = 1",
        (f"{STORIES}::test_one_wild_torque_limit_moves_nothing",),
    ),
    Mutation(
        "gains never drift", "estimation/tracker.py",
        "forgotten = 1.0 / self.options.gain_memory + (t - end) / self.options.gain_correlation_time",
        "forgotten = 0.0",
        ("tests/estimation/test_tracker_drift.py::test_gains_are_known_for_hours_and_not_for_ever",),
    ),
    Mutation(
        "the soil never drifts", "estimation/tracker.py",
        "gaussian.drifted(self._drift(gaussian, elapsed))",
        "gaussian.drifted(0.0 * self._drift(gaussian, elapsed))",
        ("tests/estimation/test_tracker_drift.py::test_the_soil_of_an_hour_ago_is_no_more_than_another_soil",),
    ),
    Mutation(
        "a state is written through a link", "daemon/state_store.py",
        "flags | os.O_NOFOLLOW", "flags",
        ("tests/daemon/test_state_store.py::test_nothing_is_written_through_a_link",),
    ),
    Mutation(
        "a state is read through a link", "daemon/state_store.py",
        "os.O_NONBLOCK | os.O_NOFOLLOW", "os.O_NONBLOCK",
        ("tests/daemon/test_state_store.py::test_what_is_no_file_is_refused_and_nothing_is_nothing",),
    ),
    Mutation(
        "gains may be as negative as they like", "daemon/state_store.py",
        "(np.abs(off) <= STORED_RANGE_SD * std).all()", "(off <= STORED_RANGE_SD * std).all()",
        ("tests/daemon/test_state_store.py::test_each_fault_is_told_in_one_line",),
    ),
    Mutation(
        "gaps are those of the last window", "pipeline/model_gap.py",
        "self._minutes.ratios().items()", "self._window.ratios().items()",
        ("tests/estimation/test_prediction.py::"
         "test_a_watch_averages_squares_over_the_last_window_and_reports_gaps_of_minutes",),
    ),
    Mutation(
        "one repeated reading makes a sensor coarse", "sensors/consistency.py",
        "> rare * (np", "> 0.0 * (np",
        ("tests/estimation/test_plausibility.py::test_how_often_readings_repeat_elsewhere_tells_coarse_from_frozen",),
    ),
    Mutation(
        "no sensor is coarse", "sensors/consistency.py",
        "> rare * (np", "> 1.0 * (np",
        ("tests/estimation/test_plausibility.py::test_how_often_readings_repeat_elsewhere_tells_coarse_from_frozen",),
    ),
    Mutation(
        "readings that repeat for long count as repeated elsewhere", "sensors/consistency.py",
        "same[:, i].sum() - within > rare * (np.isfinite(value[:, i]).sum() - within)",
        "same[:, i].sum() > rare * np.isfinite(value[:, i]).sum()",
        ("tests/estimation/test_plausibility.py::test_how_often_readings_repeat_elsewhere_tells_coarse_from_frozen",),
    ),
    Mutation(
        "the state follows from the pull alone", "decision/judgement.py",
        "state=state_of(min(pull, depth), status, settings)", "state=state_of(pull, status, settings)",
        ("tests/decision/test_traversability.py::test_ground_that_holds_the_pull_but_not_the_depth_is_no_go",),
    ),
    Mutation(
        "a margin makes being pushed harder", "decision/judgement.py",
        "settings.margin * max(demand.pull, 0.0)", "settings.margin * abs(demand.pull)",
        ("tests/decision/test_traversability.py::test_the_margin_counts_for_pulling_only",),
    ),
    Mutation(
        "a margin makes being pushed easier", "decision/judgement.py",
        "settings.margin * max(demand.pull, 0.0)", "settings.margin * demand.pull",
        ("tests/decision/test_traversability.py::test_the_margin_counts_for_pulling_only",),
    ),
    Mutation(
        "PDU format 240 has a destination", "can/j1939.py",
        "< _PDU2 else", "<= _PDU2 else",
        ("tests/can/test_j1939.py",),
    ),
    Mutation(
        "PDU format 239 has none", "can/j1939.py",
        "_PDU2 = 0xF0", "_PDU2 = 0xEF",
        ("tests/can/test_j1939.py",),
    ),
)  # fmt: skip


def is_there(mutation: Mutation) -> bool:
    """Whether the text that the mutation replaces is in the code, once."""
    return (ROOT / SOURCE / mutation.file).read_text(encoding="utf-8").count(mutation.old) == 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Mutate, test, tell."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutations", description=__doc__)
    parser.add_argument("words", nargs="*", help="only mutations whose names hold one of these")
    words = parser.parse_args(arguments).words
    chosen = [m for m in MUTATIONS if not words or any(word in m.name for word in words)]
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        shutil.copytree(ROOT / "service", copy / "service", ignore=shutil.ignore_patterns("__pycache__"))
        for beside in ("dbc", "systemd"):
            (copy / beside).symlink_to(ROOT / beside)
        told = {mutation.name: _told(mutation, copy) for mutation in chosen}
        sound = _code(copy, sorted({test for mutation in chosen for test in mutation.tests}))
    for name, what in told.items():
        print(f"{what:<10} {name}")
    if sound != 0:
        print(f"their tests fail without any mutation (pytest ended with {sound})")
    return int(sound != 0 or any(what != "killed" for what in told.values()))


def _told(mutation: Mutation, copy: Path) -> str:
    """What became of one mutation."""
    if not is_there(mutation):
        return "text gone"
    file = copy / SOURCE / mutation.file
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")
    try:
        code = _code(copy, mutation.tests)
    finally:
        file.write_text(text, encoding="utf-8")
    return {0: "survived", FAILED: "killed"}.get(code, "no test")


def _code(copy: Path, tests: Sequence[str]) -> int:
    """How pytest ends with the copy's code."""
    paths = " ".join([str(copy / "service"), "tests/guest", "tests/support"])
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-n0",
        "-p",
        "no:cacheprovider",
        "-o",
        f"pythonpath={paths}",
        *tests,
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL).returncode


if __name__ == "__main__":
    raise SystemExit(main())
