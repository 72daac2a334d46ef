"""Stress laws against hand-made numbers, numerical integration and their own derivatives."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from soilbus.terra.soil_laws import SHEAR_LAWS, exponential_shear, normal_stress, rational_shear, shear_displacement

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


def test_shear_displacement_at_its_ends():
    assert shear_displacement(0.4, 0.4, 0.3, 0.5) == 0.0
    # A locked-in-place wheel (slip 1) drags the soil along the whole arc.
    assert shear_displacement(0.4, 0.0, 1.0, 0.5) == pytest.approx(0.5 * 0.4, rel=1e-12)
    # notes.md, section 2.4: 51 mm at r = 0.5, entry 0.45, slip 0.2
    assert shear_displacement(0.45, 0.0, 0.2, 0.5) == pytest.approx(0.051, abs=5e-4)
    # In skid the soil is first dragged along, then pushed back beyond where it was.
    front, middle, rear = shear_displacement(0.4, np.array([0.3, 0.2, -0.4]), -0.05, 0.5)
    assert front > 0.0 > middle > rear


def test_shear_laws_at_known_points():
    assert exponential_shear(math.log(2.0)) == pytest.approx((0.5, 0.5), rel=1e-12)
    assert rational_shear(1.0) == pytest.approx((0.5, 0.25), rel=1e-12)
    # notes.md, figure 2: j/K = 51/25
    assert exponential_shear(51 / 25)[0] == pytest.approx(0.87, abs=5e-3)
    assert rational_shear(51 / 25)[0] == pytest.approx(0.67, abs=5e-3)


@pytest.mark.parametrize("law", SHEAR_LAWS.values(), ids=SHEAR_LAWS)
@given(ratio=RATIOS, other=RATIOS)
def test_shear_laws_are_odd_bounded_and_rising(law, ratio, other):
    share, slope = law(ratio)
    assert law(-ratio) == (-share, slope)
    assert -1.0 <= share <= 1.0
    assert 0.0 <= slope <= 1.0
    assert (law(other)[0] - share) * (other - ratio) >= 0.0


@pytest.mark.parametrize("law", SHEAR_LAWS.values(), ids=SHEAR_LAWS)
def test_slopes_of_shear_laws_equal_central_differences(law):
    ratio = np.concatenate([np.linspace(-6.0, -0.01, 200), np.linspace(0.01, 6.0, 200)])
    _, slope = law(ratio)
    errors = []
    for h in (1e-3, 1e-4):
        central = (law(ratio + h)[0] - law(ratio - h)[0]) / (2.0 * h)
        errors.append(np.abs(central - slope).max())
    assert errors[0] / errors[1] == pytest.approx(100.0, rel=0.05)
    assert law(np.zeros(1))[1] == 1.0
