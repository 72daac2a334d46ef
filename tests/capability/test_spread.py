"""Means within 2 % and deviations within 10 % of Monte Carlo, where limits meet the ground too."""

from __future__ import annotations

import pytest

from tests.lab.capability_spread import Case, posterior_of, quantities

SEED, DRAWS = 6, 4000
CASES = (
    Case("heavy_clay_40", "narrow", False),
    Case("lean_clay_32", "wide", True),
    Case("sandy_loam_11_michigan", "wide", True),
    Case("xi_wet_clay", "narrow", False),
    Case("north_gower_clayey_loam_46", "wide", True, "rough c and K"),
    Case("sandy_loam_15", "narrow", True),
    Case("clayey_soil_38", "wide", False, "rough c and K"),
    Case("upland_sandy_loam_51", "wide", True),
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: " ".join(map(str, case)))
def test_every_quantity_equals_monte_carlo(case):
    posterior = posterior_of(case, SEED)
    found = list(quantities(posterior, DRAWS))
    assert len(found) >= 30
    assert not [f"{limit}: {each}" for limit, each in found if each.wrong]
