"""A few cases of the blind test, beside those of tests/golden; `python -m tests.lab.blind` runs them all."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.golden.outputs import the_case
from tests.lab.blind.cases import cases
from tests.lab.blind.table import in_set
from tests.lab.blind.trial import tried
from tests.lab.blind.visible import NOTHING


def test_a_hidden_effect_is_named_by_another_formula():
    case = the_case("single/inertia:flywheel/medium/")
    trial = tried(case, truth=NOTHING)
    assert trial.verdict == "named"
    assert trial.named == case.hidden
    assert trial.gap_after < 1.1
    assert abs(trial.bearing_after) < max(0.15, abs(trial.bearing_before))


def test_effects_alike_are_reported_as_a_set():
    trial = tried(the_case("single/slip_sinkage:factor/medium/"), truth=NOTHING)
    assert trial.verdict == "ambiguous"
    likely = {name for name, chance in trial.sets[0].items() if chance > 0.2}
    assert likely == {"slip_sinkage", "stress_peak_shift"}
    assert in_set(trial) >= likely
    assert sum(trial.sets[0].values()) == pytest.approx(1.0, abs=0.05)


def test_where_nothing_is_missing_nothing_is_named():
    trial = tried(the_case("hard/"), truth=NOTHING)
    assert (trial.verdict, trial.named) == ("none", ())


def test_a_machine_without_load_cells_is_diagnosed_too():
    shown = next(
        case for case in cases("single", 1, "tractor-axles") if case.id.startswith("single/soil_drift:ramp/large/")
    )
    trial = tried(shown, truth=NOTHING)
    assert trial.named[:1] == shown.hidden
    assert trial.gap_after < trial.gap_before


def test_cases_are_diagnosed_in_processes_of_their_own():
    words = ["--seed", "311", "--kind", "plain", "--only", "clayey_soil_38/bare/311.20", "--processes", "2"]
    run = subprocess.run(
        [sys.executable, "-m", "tests.lab.blind", *words],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "plain/clayey_soil_38/bare/311.20 [0]: none" in run.stdout, run.stderr
