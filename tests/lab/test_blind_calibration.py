"""The calibration curve of stated probabilities."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.lab.blind.calibration import curve, main, stated

TRIALS = [
    {"verdict": "named", "sets": [{"lugs": 0.9, "grade": 0.05}, {"inertia": 0.85}], "hidden": ["lugs"]},
    {"verdict": "unknown", "sets": [{"lugs": 0.9}], "hidden": []},
    {"verdict": "none", "sets": [], "hidden": ["lugs"]},
]


def test_names_of_all_sets_count_but_those_beside_unknown():
    assert sorted(stated(TRIALS)) == [(0.05, False), (0.85, False), (0.9, True)]


def test_names_that_are_right_as_often_as_stated_lie_on_the_diagonal():
    rng = np.random.default_rng(4)
    probabilities = rng.uniform(0.02, 1.0, 20000)
    found = curve(zip(probabilities.tolist(), (rng.uniform(size=20000) < probabilities).tolist(), strict=True))
    assert sum(one.names for one in found) == 20000
    for one in found:
        assert one.right / one.names == pytest.approx(one.stated, abs=4.0 * np.sqrt(0.25 / one.names))
        assert one.low < one.right / one.names < one.high


def test_what_blind_wrote_is_read_and_drawn(tmp_path, capsys):
    written, picture = tmp_path / "trials.jsonl", tmp_path / "curve.svg"
    written.write_text("".join(json.dumps(trial) + "\n" for trial in TRIALS))
    assert main(["--trials", str(written), "--svg", str(picture)]) == 0
    assert "0.88" in capsys.readouterr().out
    assert picture.read_text().startswith("<?xml")
