"""The table of soils: spot checks against Wong's printed numbers, and sanity of every row."""

import math

import pytest

from soilbus.terra.soils import SOILS, soil_named
from soilbus.terra.wheel import Soil, lumped_modulus


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("dry_sand", (0.99e3, 1528.43e3, 1.10, math.radians(28.0), 1.04e3)),
        ("clayey_soil_38", (13.19e3, 692.15e3, 0.50, math.radians(13.0), 4.14e3)),
        ("heavy_clay_25", (12.70e3, 1555.95e3, 0.13, math.radians(34.0), 68.95e3)),
        ("lete_sand", (102.0e3, 5301.0e3, 0.79, math.radians(31.1), 1.3e3)),
        ("snow_us", (4.37e3, 196.72e3, 1.60, math.radians(19.7), 1.03e3)),
    ],
)
def test_wongs_numbers_in_si(name, expected):
    assert soil_named(name)[:5] == pytest.approx(expected, rel=1e-12)


def test_the_papers_two_soils():
    clay, loam = soil_named("xi_wet_clay"), soil_named("xi_sandy_loam")
    assert lumped_modulus(clay.k_c, clay.k_phi, 0.3) == pytest.approx(644.9e3, rel=1e-12)
    assert clay == pytest.approx((43.68e3, 499.3e3, 0.85, math.radians(14.0), 7.58e3, 0.025), rel=1e-12)
    assert loam == pytest.approx((5.3e3, 1515e3, 0.70, math.radians(29.0), 1.7e3, 0.025), rel=1e-12)
    assert (soil_named("loam"), soil_named("wet_clay")) == (loam, clay)


def test_bearing_pressure_by_hand():
    # (5300/0.3 + 1515000) * 0.02^0.7
    assert soil_named("loam").bearing_pressure(0.02, 0.3) == pytest.approx(99_121.69, rel=1e-6)


@pytest.mark.parametrize("soil", SOILS.values(), ids=SOILS)
def test_every_soil_is_physical(soil: Soil):
    assert 0.05 < soil.n < 2.0
    assert 0.0 <= soil.c < 100e3
    assert 0.0 < soil.phi < math.radians(50.0)
    assert 0.003 <= soil.K <= 0.05
    # two hands deep, a tyre's width: from slush to a hard road
    assert 5e3 < soil.bearing_pressure(0.2, 0.3) < 5e6


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(KeyError, match=r"no soil is named mud; known: dry_sand, .*wet_clay"):
        soil_named("mud")
