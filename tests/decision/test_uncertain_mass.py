"""A mass that is uncertain is estimated by the window, and what it leaves open is part of the largest draft's std."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.decision.capability import assess
from soilbus.estimation.assembly import model_of, rig_of
from soilbus.estimation.posterior import Posterior
from soilbus.offline.replay import replay
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import REFERENCES, reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.soils import soil_named

HEAVIER = 1.3


def rear_driven(mass: float, std: float):
    settings = [f"vehicle.mass.value={mass}", f"vehicle.mass.std={std}", "estimator.hop=3.0"]
    return reference_configuration(settings, REFERENCES["tractor-2wd"])


@pytest.fixture(scope="module")
def drafts(tmp_path_factory) -> dict[str, np.ndarray]:
    """Largest draft and std [N], medians over each of three drives of a machine heavier than its data sheet says."""
    sheet = reference_configuration([], REFERENCES["tractor-2wd"]).vehicle.mass
    true = HEAVIER * sheet
    log = tmp_path_factory.mktemp("heavy") / "drive.log"
    driven = rear_driven(true, 0.0)
    configs = {"known": rear_driven(true, 1.0), "open": rear_driven(sheet, 0.25 * sheet)}
    out: dict[str, list] = {name: [] for name in configs}
    for seed in (5, 6, 7):
        write_log(frames(simulate(driven, excited("loam", 24.0), seed=seed), driven), log)
        for name, config in configs.items():
            found = [r.traversability.max_draft for r in replay(Pipeline(config, load_databases(config)), [log])]
            out[name].append(np.median([(d.value, d.std) for d in found if d is not None], axis=0))
    return {name: np.array(found) for name, found in out.items()}


def test_the_largest_draft_follows_the_mass_that_the_drive_shows(drafts):
    """Of the data sheet's mass it would be too small by about a quarter."""
    known, found = drafts["known"], drafts["open"]
    assert abs((found / known)[:, 0].mean() - 1.0) < 0.12
    assert (np.abs(found - known)[:, 0] < 1.96 * found[:, 1]).all()


def test_the_std_of_the_mass_is_part_of_the_std_of_the_pull():
    config = rear_driven(4000.0, 400.0)
    rig, soil = rig_of(config), Posterior(soil_named("loam"), np.diag([0.1, 0.1, 0.05, 0.05, 0.1, 0.1]) ** 2)
    limits = np.array([0.0, 0.0, np.nan, np.nan])
    sure, open_ = (
        assess(soil, replace(rig, mass_std=std), model_of(config), None, limits, 0.6, 0.5)[0] for std in (0.0, 0.1)
    )
    assert open_.max_draft.value == sure.max_draft.value
    assert open_.max_draft.std == pytest.approx(math.hypot(sure.max_draft.std, 0.1 * sure.max_draft.value))
    assert open_.max_grade == sure.max_grade
