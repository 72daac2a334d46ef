"""Sinkages on another scale: seen before they lead astray, and by nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soilbus.decision.traversability import Status
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.result import WindowResult
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from tests.lab.driven_windows import task_of, windows

SOILS = ("loam", "wet_clay", "dry_sand", "clayey_soil_38")


def results(soil: str, scale: float | np.ndarray, seed: int) -> list[WindowResult]:
    """Windows of a drive whose sinkage sensors read the truth times a factor (W,)."""
    config = reference_configuration()
    scenario = Scenario(14.0, (Patch(0.0, soil),), slip=Swing(0.05, 0.40))
    estimator = WindowEstimator(config)
    return [
        estimator.estimate(
            task_of(replace(window, sinkage=window.sinkage * scale), end, config, round(end - 10))
        ).result
        for window, end in windows(config, simulate(config, scenario, seed))
    ]


@pytest.mark.parametrize("soil", SOILS)
def test_sinkages_a_tenth_too_low_are_never_valid(soil):
    # Without the test along this direction 13 % of the bearing pressure were missing on loam, 25 sd, and valid.
    assert {r.reason for r in results(soil, 0.9, 1)} == {"model_mismatch"}


@pytest.mark.parametrize("soil", SOILS)
def test_one_wheels_sinkage_a_fifth_too_high_is_never_valid(soil):
    scale = np.array([1.0, 1.0, 1.2, 1.0])
    assert {r.reason for r in results(soil, scale, 2)} == {"model_mismatch"}


@pytest.mark.parametrize("soil", SOILS)
def test_right_ones_are_valid(soil):
    assert {(r.status, r.reason) for r in results(soil, 1.0, 3)} == {(Status.VALID, "none")}
