"""A recording that nobody here wrote: the plain model fails on every window, the completed one on none."""

from __future__ import annotations

import json
from collections import Counter
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
    status, draft = {}, {}
    for name, config in (("plain", FIELD), ("completed", model)):
        assert main(["replay", "--config", str(config), log, "--json", str(tmp_path / name)]) == 0
        windows = [json.loads(line) for line in (tmp_path / name).read_text().splitlines()]
        status[name] = Counter(window["status"] for window in windows)
        draft[name] = np.median([window["noise_factors"]["draft"] for window in windows])
    assert status["completed"]["valid"] >= 0.95 * sum(status["completed"].values()) > 100.0
    assert draft["plain"] > 5.0 > 2.0 > draft["completed"]  # what the plain model leaves is noise to it
