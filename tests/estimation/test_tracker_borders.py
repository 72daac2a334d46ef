"""A small version of tests.lab.soil_borders: how soon the new soil is estimated, and whether its intervals hold."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm
from soilbus.estimation.laplace import confidence, density, longer_side

from soilbus.simulator.reference import reference_configuration
from tests.lab.soil_borders import crossed, drive, first_of_tyres, first_valid, least_sd, wrong, wrong_of_tyres

SPEED = 1.5


@pytest.mark.parametrize("pair", ["loam:clayey_soil_38", "wet_clay:loam"])
def test_a_new_soil_is_valid_within_two_seconds_of_its_border(pair):
    config = reference_configuration()
    for seed in range(3):
        seen = crossed(config, pair, SPEED, 1.0, seed, after=3.0)
        assert first_valid(seen) <= 2.0
        assert not wrong(seen)


CLOSED = [f"model.form.{name}=0" for name in ("peak", "peak_by_slip", "exit", "shear")]


@pytest.mark.parametrize(
    ("seed", "form", "latest"),  # what the form leaves open took a hop more on one of four seeds
    [(103, [], 2.0), (106, [], 2.0), (702, [], 2.0), (108, CLOSED, 2.0), (108, [], 3.0)],
)
def test_on_wet_clay_it_is_known_by_then_however_badly(seed, form, latest):
    # Intervals by the posterior alone were 2.3 to 4.3 sd off there, and all such windows had to wait.
    seen = crossed(reference_configuration(form), "loam:wet_clay", SPEED, 1.0, seed, after=3.0)
    assert first_of_tyres(seen) <= latest
    assert not wrong_of_tyres(seen)
    known = [w for w in seen if w.t > 1.0]
    assert known[0].t <= 2.0
    for w in known:
        assert w.reason in ("none", "not_excited load_range")
        assert w.away < 3.0


def test_a_confidence_distribution_has_the_quantiles_of_the_signed_root():
    u = np.linspace(-3.0, 5.0, 41)
    fine = np.linspace(-3.0, 5.0, 2001)
    root = np.where(u < 0.0, 2.0 * u, 0.7 * u)  # one side steep, the other flat
    share = np.cumsum(confidence(u, root**2 + 4.0, fine))
    for place in (-1.0, -0.4, 0.0, 1.0, 2.5):
        expected = norm.cdf(2.0 * place if place < 0.0 else 0.7 * place)
        assert np.interp(place, fine, share) == pytest.approx(expected, abs=0.005)
    # As a density the flat side has more than half.
    assert density(u, root**2 + 4.0, fine)[fine < 0.0].sum() == pytest.approx(0.7 / 2.7, abs=0.005)


def test_the_longer_side_of_a_distribution_counts():
    at = np.linspace(0.0, 20.0, 20001)
    exponential = np.exp(-at) / np.exp(-at).sum()
    # Of its square distances from the mean, 1 in all, those above are 2 on average.
    assert longer_side(at - 1.0, exponential) == pytest.approx(2.0, rel=0.01)
    assert longer_side(1.0 - at, exponential) == pytest.approx(2.0, rel=0.01)
    assert longer_side(at - 10.0, np.full(20001, 1.0 / 20001)) == pytest.approx(1.0, rel=0.01)


def test_no_estimate_can_be_surer_than_the_bound_says():
    config, seed = reference_configuration(), 202
    driven = drive(config, "loam:wet_clay", SPEED, 1.0, seed, after=3.0)
    seen = [w for w in crossed(config, "loam:wet_clay", SPEED, 1.0, seed, after=3.0) if w.t > 1.0]
    least = [least_sd(config, driven, w.t) for w in seen]
    assert least == sorted(least, reverse=True)
    assert least[0] > 0.10  # no status can be valid then
    assert all(w.sd > 0.9 * bound for w, bound in zip(seen, least, strict=True))
