"""What the page of a replay says first where nothing decides whether the vehicle may go on."""

from __future__ import annotations

import numpy as np
import pytest

from soilbus.decision.traversability import Status, Traversability
from soilbus.estimation.posterior import Posterior
from soilbus.pipeline.result import WindowResult
from soilbus.report.replay import headline
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.soils import soil_named

CONFIG = reference_configuration()
SOIL = Posterior(soil_named("loam"), 0.1 * np.eye(6))


def window(status: Status, reason: str) -> WindowResult:
    return WindowResult(1.0, 0, status, reason, SOIL, None, {}, {}, Traversability(), None, 0, {})


@pytest.mark.parametrize(
    ("valid", "said"),
    [
        (0, "The soil is known in none of 3 windows, doubtful in 3; 3 are degraded: not_excited"),
        (2, "The soil is known in 2 of 5 windows"),
    ],
)
def test_a_soil_is_known_where_a_window_is_valid(valid, said):
    results = [window(Status.DEGRADED, "not_excited")] * 3 + [window(Status.VALID, "none")] * valid
    assert headline(results, CONFIG) == said
