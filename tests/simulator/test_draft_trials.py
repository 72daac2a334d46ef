"""The largest draft predicted from a window, beside the truth; and the command that prints it."""

import json

import numpy as np
import pytest

from soilbus.cli.main import main
from soilbus.estimation.assembly import rig_of
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.soils import SOILS as KNOWN
from soilbus.trials.draft_trials import SOILS, DraftTrial, draft_trials, figures, trial, true_largest_draft
from statics import MODEL, WHEELS, brute

CONFIG = reference_configuration()
RIG = rig_of(CONFIG)


def test_the_truth_equals_brute_force():
    soil = KNOWN[SOILS[0]]
    free = true_largest_draft(soil, RIG, np.full(4, np.nan), 0.6, MODEL)
    assert free == pytest.approx(brute(soil, 0.6)[0], rel=1e-6)
    held = true_largest_draft(soil, RIG, np.full(4, 1000.0), 0.6, MODEL)
    slips = np.linspace(0.02, 0.6, 60)
    usable = [s for s in slips if brute(soil, s)[1][2, WHEELS].max() <= 1000.0]
    below, above = brute(soil, usable[-1])[0], brute(soil, usable[-1] + slips[1] - slips[0])[0]
    assert below <= held <= above
    assert np.isnan(true_largest_draft(KNOWN["snow_us"]._replace(k_phi=2e3), RIG, np.full(4, np.nan), 0.6, MODEL))


def test_figures_of_trials_that_have_them():
    trials = [DraftTrial("x", 1000.0 * (1.0 + e), 20.0, 1000.0) for e in (-0.05, -0.03, 0.01, 0.02, 0.03)]
    found = figures("x", [*trials, DraftTrial("x", np.nan, np.nan, 900.0)])
    assert (found.drives, found.failed, found.true) == (6, 1, 1000.0)
    assert found.error == pytest.approx(0.03)
    assert found.bias == pytest.approx(0.01)
    assert found.coverage == pytest.approx(4 / 5)  # 1.96 times 20 N reach 39 N
    assert np.isnan(figures("x", [DraftTrial("x", np.nan, np.nan, 900.0)]).coverage)


def test_the_largest_draft_is_predicted_on_held_soils():
    found = list(draft_trials(CONFIG, 5, 3))
    assert [f.soil for f in found] == [*SOILS, "all"]
    assert all(f.error < 0.05 and f.failed == 0 for f in found)
    assert found[-1].drives == 15
    assert 0.86 <= found[-1].coverage <= 1.0  # the command looks closer: 15 drives scatter by 6 points
    assert trial(CONFIG, SOILS[0], 5) == trial(CONFIG, SOILS[0], 5)


def test_the_command(tmp_path, capsys):
    out = tmp_path / "out.json"
    few = ["--drives", "1", "--calls", "2", "--boggings", "1", "--hours", "0", "--seed", "4"]
    assert main(["decisions", *few, "--json", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith((*SOILS, "all")) for line in lines) == 4
    said = json.loads(out.read_text())
    assert [d["drives"] for d in said["max_draft"]] == [1, 1, 1, 3]
    assert said["calls"]["drives"] == 2
    assert sum(b["calls"] for b in said["calls"]["bins"]) == 2 - said["calls"]["failed"]
    assert set(said["immobilisation"]) == {"softening"}  # the first of the kinds
    of_kind = said["immobilisation"]["softening"]
    assert set(of_kind) == {"boggings", "in_time", "lead", "least_lead", "sudden", "delay", "hours", "false"}
    assert (of_kind["hours"], of_kind["false"]) == (0.0, 0)
    assert said["false_warnings"] == {}


@pytest.mark.parametrize(
    "wrong", [["--drives", "0"], ["--calls", "0"], ["--boggings", "x"], ["--hours", "-1"], ["--seed", "-1"]]
)
def test_wrong_usage_of_the_command(wrong, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["decisions", *wrong])
    assert stop.value.code == 2


def test_a_configuration_without_a_vehicle_is_one_line(tmp_path, capsys):
    empty = tmp_path / "empty.toml"
    empty.write_text("")
    assert main(["decisions", "--config", str(empty), "--drives", "1"]) == 1
    assert capsys.readouterr().err.splitlines() == ["soilbus: the simulator needs a [vehicle] with [[wheel]]s"]
