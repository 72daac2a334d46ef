"""Several fields, one vehicle: what is the same on every field is the vehicle's, what differs is the fields'."""

import dataclasses

import numpy as np
import pytest

from records import recorded
from soilbus.config.model import Config
from soilbus.diagnosis.diagnose import Diagnosis, diagnose
from soilbus.diagnosis.records import Record
from soilbus.estimation.assembly import prior_of
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.along import mean_height, through_knots
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.vehicle import GRAVITY

SECONDS = 40.0
SOILS = ("loam", "wet_clay", "dry_sand", "clayey_soil_38")
WITHOUT_GAINS = [f"noise.{quantity}.gain=0.0" for quantity in ("torque", "load", "speed", "ground_speed", "draft")]
CONFIG = reference_configuration(WITHOUT_GAINS)
BLIND = CONFIG.model_copy(update={"signals": CONFIG.signals.model_copy(update={"pitch": None})})
"""The same tractor without a pitch sensor."""
PITCH_OF_OFFSET = 400.0 / (CONFIG.vehicle.mass * GRAVITY)
"""Slope [rad] that holds back as much as an offset of 400 N."""
RIVALS = [
    CATALOGUE[name] for name in ("draft_offset", "grade", "draft_gain", "bulldozing", "drivetrain_loss", "inertia")
]
"""What pushes or seems to push."""


def field(config: Config, soil: str, slope: float, seed: int, *effects: str) -> Record:
    scenario = dataclasses.replace(excited(soil, SECONDS), slope=((0.0, slope),))
    unheard = () if config.signals.pitch else ("pitch",)
    return recorded(scenario, seed, *effects, config=config, without=unheard, name=soil)


def diagnosed(config: Config, seed: int, slopes: tuple[float, ...], *effects: str) -> Diagnosis:
    drives = enumerate(zip(SOILS, slopes, strict=True))
    records = [field(config, soil, slope, 10 * seed + i, *effects) for i, (soil, slope) in drives]
    return diagnose(records, prior_of(config), RIVALS)


def chances(found: Diagnosis) -> dict[str, float]:
    first = found.additions[0]
    return {first.effect.name: first.probability} | first.alternatives


def test_a_draft_offset_is_no_slope_of_four_fields():
    """The pitch is measured: that sensor would have to be off by a whole degree."""
    found = diagnosed(CONFIG, 1, (0.0,) * 4, "draft_offset=400")
    assert found.additions[0].effect.name == "draft_offset"
    assert chances(found)["draft_offset"] > 0.8
    assert len(found.additions) == 1
    offset = found.completed.parameters()["draft_offset"]["offset"]
    assert abs(offset.value - 400.0) < max(4.0 * offset.std, 8.0)


def test_a_push_that_is_the_same_on_four_fields_is_an_offset():
    """Nothing measures the pitch, and four fields might each have that slope: by chance, which counts."""
    found = diagnosed(BLIND, 1, (0.0,) * 4, "draft_offset=400")
    assert found.additions[0].effect.name == "draft_offset"
    assert chances(found)["draft_offset"] > 0.8


def test_slopes_that_differ_from_field_to_field_are_no_offset():
    slopes = tuple(PITCH_OF_OFFSET * share for share in (1.3, -0.8, 1.0, 0.2))
    found = diagnosed(BLIND, 3, slopes)
    assert [addition.effect.name for addition in found.additions] == ["grade"]
    assert chances(found)["grade"] > 0.98
    n_sensors = found.completed.checks[0].problem.n_sensors
    place = [f.parameter.name for f in found.completed.free].index("slope_0")
    std = found.completed.free[place].std
    reported = [fit.mode.gains[n_sensors + place] * std for fit in found.completed.fits]
    assert reported == pytest.approx(slopes, abs=0.006)


def test_a_curve_has_the_mean_of_its_heights_along_the_way():
    heights = np.random.default_rng(3).normal(size=16).tolist()
    share = np.linspace(0.0, 1.0, 20001)
    assert mean_height(heights) == pytest.approx(np.trapezoid(through_knots(share, heights), share), abs=1e-7)
