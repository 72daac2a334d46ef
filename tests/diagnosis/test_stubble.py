"""A recording that nobody here wrote: its effect is named, and the completed model describes it.

By the plain model the noise factor of the draft is above 5 in every window: daemon/test_pipeline.py.
"""

import json
from pathlib import Path

import numpy as np

from soilbus.cli.main import main

FIELD = Path(__file__).resolve().parents[1] / "field/field.toml"


def test_stubble_is_described_once_its_effect_is_in_the_model(field_recording, tmp_path, capsys):
    log, model = str(field_recording("stubble.log.gz")), tmp_path / "completed.toml"
    assert main(["diagnose", "--config", str(FIELD), log, "--json", "-", "--model-out", str(model)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "named"
    assert [effect["name"] for effect in found["effects"]] == ["rate_stiffening"]
    before, after = (found["gap"][when] for when in ("before", "after"))
    assert before > 2.0 > 1.15 > after
    assert after - 1.0 < 0.06 * (before - 1.0)  # what is left: stamps of a bus cycle, 4 ms of the loads
    assert main(["replay", "--config", str(model), log, "--json", str(tmp_path / "windows.jsonl")]) == 0
    windows = [json.loads(line) for line in (tmp_path / "windows.jsonl").read_text().splitlines()]
    assert sum(window["status"] == "valid" for window in windows) >= 0.95 * len(windows) > 100.0
    assert np.median([window["noise_factors"]["draft"] for window in windows]) < 2.0  # what was left is no noise now
