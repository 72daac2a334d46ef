"""Stress laws against hand-made numbers, numerical integration and their own derivatives."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from soilbus.terra.soil_laws import SHEAR_LAWS, normal_stress, shear_displacement

RATIOS = st.floats(-50.0, 50.0)


def test_normal_stress_is_bekkers_and_nothing_above_the_ground():
    z = np.array([-0.1, 0.0, 0.01, 0.04])
    assert normal_stress(1e6, 0.5, z) == pytest.approx([0.0, 0.0, 1e5, 2e5], rel=1e-12)
    assert normal_stress(7e5, 1.0, 0.03) == pytest.approx(21e3, rel=1e-12)


@given(entry=st.floats(0.05, 1.2), part=st.floats(-0.5, 1.0), slip=st.floats(-0.5, 0.95))
def test_shear_displacement_integrates_the_slip_velocity(entry, part, slip):
    # eq. 15: the rim moves at r omega - V cos(theta) against the soil; dt = d theta / omega
    angle = part * entry
    expected = quad(lambda t: 0.5 * (1.0 - (1.0 - slip) * math.cos(t)), angle, entry, epsabs=1e-14)[0]
    assert shear_displacement(entry, angle, slip, 0.5) == pytest.approx(expected, rel=1e-9, abs=1e-13)


@pytest.mark.parametrize("law", SHEAR_LAWS.values(), ids=SHEAR_LAWS)
@given(ratio=RATIOS, other=RATIOS)
def test_shear_laws_are_odd_bounded_and_rising(law, ratio, other):
    share, slope = law(ratio)
    assert law(-ratio) == (-share, slope)
    assert -1.0 <= share <= 1.0
    assert 0.0 <= slope <= 1.0
    assert (law(other)[0] - share) * (other - ratio) >= 0.0
