"""Where shear turns under a skidding wheel, against a root finder on the shear displacement itself."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from soilbus.terra.rim import Quadrature, place_of_turn

PEAK = 0.3


def displacement(angle: float, entry: float, slip: float) -> float:
    """Shear displacement over the radius (Wong & Reece 1967, part II, eq. 5)."""
    return entry - angle - (1.0 - slip) * (math.sin(entry) - math.sin(angle))


def expected(entry: float, slip: float, leave: float) -> float:
    """The place on 0..1 of the turn, on the branch in which it lies; 1 without one."""
    last, most = leave * entry, math.acos(min(1.0 / (1.0 - slip), 1.0))
    if most >= entry or displacement(last, entry, slip) >= 0.0:
        return 1.0
    turn = brentq(displacement, last, most, args=(entry, slip), xtol=1e-15)
    front, rear = (entry - turn) / (entry * (1.0 - PEAK)), (turn - last) / (entry * (PEAK - leave))
    return min(front if turn > PEAK * entry else rear, 1.0)


@pytest.mark.parametrize("leave", [0.0, -0.1, -0.4])
def test_shear_turns_where_its_displacement_is_back_at_zero(leave: float) -> None:
    rng = np.random.default_rng(5)
    entry, slip = np.exp(rng.uniform(math.log(0.05), math.log(1.4), 400)), rng.uniform(-0.5, 0.05, 400)

    found = place_of_turn(entry, slip, PEAK, Quadrature(8, 3, PEAK, leave))

    wanted = np.array([expected(e, s, leave) for e, s in zip(entry, slip, strict=True)])
    assert 50 < np.count_nonzero(wanted < 1.0) < 350
    assert found == pytest.approx(wanted, abs=1e-6)
    usual = entry < 1.0
    assert found[usual] == pytest.approx(wanted[usual], abs=1e-9)
