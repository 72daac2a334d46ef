"""Coordinates of the estimation and back."""

import numpy as np
import pytest

from soilbus.estimation.parametrization import Coordinates
from soilbus.terra.soils import SOILS

BOUND_SD = 4.0
"""Prior standard deviations to which a free parameter is confined."""


def test_coordinates_and_back(simulated):
    wet_clay = simulated(SOILS["wet_clay"], 50)
    rng = np.random.default_rng(1)
    coordinates = Coordinates(wet_clay.prior, 0.32)
    soil = np.asarray(wet_clay.soil)
    for _ in range(20):
        soil = np.asarray(wet_clay.soil) * np.exp(rng.normal(0.0, 0.3, 6))
        assert coordinates.soil_at(coordinates.position(soil)) == pytest.approx(soil, rel=1e-12)
    directions = coordinates.log_directions(soil)
    for k in range(6):
        h = 1e-6 * np.eye(6)[k]
        up, down = (coordinates.soil_at(coordinates.position(soil) + s * h) for s in (1, -1))
        assert np.log(up / down) / 2e-6 == pytest.approx(directions[:, k], abs=1e-8)
    far = coordinates.stepped(soil, np.full(6, 1e6))
    for _ in range(50):
        far = coordinates.stepped(far, np.full(6, 1e6))
    away = np.abs(np.log(far / wet_clay.prior.median)) / wet_clay.prior.log_std
    assert away.max() < BOUND_SD * (1.0 + 1e-9)
