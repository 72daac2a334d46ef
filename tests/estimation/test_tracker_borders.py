"""How soon a new soil is estimated, and whether its intervals hold."""

from __future__ import annotations

import pytest

from soil_borders import crossed, drive, first_of_tyres, first_valid, least_sd, wrong, wrong_of_tyres
from soilbus.simulator.reference import reference_configuration

SPEED = 1.5


@pytest.mark.parametrize("pair", ["loam:clayey_soil_38", "wet_clay:loam"])
def test_a_new_soil_is_valid_within_two_seconds_of_its_border(pair):
    config = reference_configuration()
    for seed in range(3):
        seen = crossed(config, pair, SPEED, 1.0, seed, after=3.0)
        assert first_valid(seen) <= 2.0
        assert not wrong(seen)


# What the form leaves open takes a hop more on one of three seeds.
@pytest.mark.parametrize(("seed", "latest"), [(103, 2.0), (106, 2.0), (108, 3.0)])
def test_on_wet_clay_it_is_known_by_then_however_badly(seed, latest):
    # Intervals by the posterior alone were 2.3 to 4.3 sd off there, and all such windows had to wait.
    seen = crossed(reference_configuration(), "loam:wet_clay", SPEED, 1.0, seed, after=3.0)
    assert first_of_tyres(seen) <= latest
    assert not wrong_of_tyres(seen)
    known = [w for w in seen if w.t > 1.0]
    assert known[0].t <= 2.0
    for w in known:
        assert w.reason in ("none", "not_excited load_range")
        assert w.away < 3.0


def test_no_estimate_can_be_surer_than_the_bound_says():
    config, seed = reference_configuration(), 202
    driven = drive(config, "loam:wet_clay", SPEED, 1.0, seed, after=3.0)
    seen = [w for w in crossed(config, "loam:wet_clay", SPEED, 1.0, seed, after=3.0) if w.t > 1.0]
    least = [least_sd(config, driven, w.t) for w in seen]
    assert least == sorted(least, reverse=True)
    assert least[0] > 0.10  # no status can be valid then
    assert all(w.sd > 0.9 * bound for w, bound in zip(seen, least, strict=True))
