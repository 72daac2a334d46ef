"""A mass that is uncertain is estimated by the window, and what it leaves open is part of the largest draft's std."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fakes import drive_messages
from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.decision.capability import assess
from soilbus.estimation.assembly import model_of, rig_of
from soilbus.estimation.posterior import Posterior
from soilbus.offline.replay import replay
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.reference import REFERENCES, reference_configuration
from soilbus.terra.soils import soil_named

HEAVIER = 1.3


def rear_driven(mass: float, std: float):
    settings = [f"vehicle.mass.value={mass}", f"vehicle.mass.std={std}", "estimator.hop=3.0"]
    return reference_configuration(settings, REFERENCES["tractor-2wd"])


def test_the_largest_draft_follows_the_mass_that_the_drive_shows(tmp_path):
    """Of the data sheet's mass it would be too small by about a quarter."""
    sheet = reference_configuration([], REFERENCES["tractor-2wd"]).vehicle.mass
    driven, config, log = rear_driven(HEAVIER * sheet, 0.0), rear_driven(sheet, 0.25 * sheet), tmp_path / "drive.log"
    exact, limits = Posterior(soil_named("loam"), np.diag([1e-6] * 6)), np.array([0.0, 0.0, np.nan, np.nan])
    true = assess(exact, rig_of(driven), model_of(driven), None, limits, 0.6, 0.5)[0].max_draft.value
    found = []
    for seed in (5, 6, 7):
        write_log(drive_messages(driven, 24.0, seed), log)
        drafts = [r.traversability.max_draft for r in replay(Pipeline(config, load_databases(config)), [log])]
        found.append(np.median([(d.value, d.std) for d in drafts if d is not None], axis=0))
    value, std = np.array(found).T
    assert abs(value.mean() / true - 1.0) < 0.12
    assert (np.abs(value - true) < 1.96 * std).all()


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
