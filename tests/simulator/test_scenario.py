"""Waves stay in their range and are what their rates and integrals say; soils follow the way."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soilbus.simulator.scenario import Patch, Profile, Scenario, Swing, realise, soil_along, soil_names
from soilbus.terra.soils import soil_named


@given(st.integers(0, 10**6), st.floats(-5.0, 5.0), st.floats(0.0, 10.0), st.floats(2.0, 150.0))
def test_waves_stay_in_range_with_exact_rate_and_integral(seed, low, span, duration):
    t = np.linspace(0.0, duration, 5001)
    wave = realise(Swing(low, low + span), t, np.random.default_rng(seed))
    assert wave.value.min() >= low
    assert wave.value.max() <= low + span
    step = t[1]
    area = np.concatenate([[0.0], np.cumsum((wave.value[1:] + wave.value[:-1]) / 2.0) * step])
    assert np.abs(wave.integral - area).max() <= 1e-3 * (abs(low) + span)
    assert np.abs(np.gradient(wave.value, t) - wave.rate)[1:-1].max() <= 1e-3 * span + 1e-9


def test_a_profile_is_as_given_with_its_rate_and_integral():
    t = np.linspace(0.0, 10.0, 2001)
    wave = realise(Profile((2.0, 6.0), (1.0, 3.0)), t, np.random.default_rng(0))
    assert wave.value[[0, 400, 800, 1200, 2000]].tolist() == pytest.approx([1.0, 1.0, 2.0, 3.0, 3.0])
    assert wave.rate[[100, 800, 1900]].tolist() == pytest.approx([0.0, 0.5, 0.0])
    assert wave.integral[-1] == pytest.approx(2.0 + 8.0 + 12.0)
    assert Profile((2.0, 6.0), (1.0, 3.0)).low == 1.0


def test_a_long_wave_sweeps_its_whole_range_slowly():
    t = np.linspace(0.0, 120.0, 6001)
    wave = realise(Swing(0.05, 0.4), t, np.random.default_rng(0))
    assert wave.value.min() < 0.052
    assert wave.value.max() > 0.398
    spectrum = np.abs(np.fft.rfft((wave.value - wave.value.mean()) * np.hanning(len(t)))) ** 2
    frequency = np.fft.rfftfreq(len(t), t[1])
    assert spectrum[frequency > 0.15].sum() < 1e-4 * spectrum.sum()


def test_soil_changes_over_the_transition():
    patches = (Patch(0.0, "loam"), Patch(10.0, "clayey_soil_38"), Patch(20.0, "mine", soil_named("dry_sand")))
    soil = soil_along(patches, np.array([[-3.0, 9.9, 10.5], [11.0, 20.0, 99.0]]), transition=1.0)
    loam, clay, sand = (patch.parameters() for patch in patches)
    assert soil.k_phi[0, :2].tolist() == [loam.k_phi] * 2
    assert soil.c[0, 2] == pytest.approx((loam.c + clay.c) / 2.0)
    assert soil.n[1, :2] == pytest.approx([clay.n] * 2)
    assert soil.K[1, 2] == pytest.approx(sand.K)
    assert soil_names(patches, np.array([0.0, 9.99, 10.0, 25.0])) == ["loam", "loam", "clayey_soil_38", "mine"]


@pytest.mark.parametrize(
    ("wrong", "fault"),
    [
        ({"soils": ()}, "soils"),
        ({"soils": (Patch(5.0, "loam"), Patch(0.0, "loam"))}, "ascending"),
        ({"slip": Swing(0.1, 0.2)}, "one of draft and slip at most"),
        ({"duration": 0.01}, "too short"),
        ({"duration": float("nan")}, "no number of seconds"),
        ({"speed": Swing(0.0, 1.0)}, "above zero"),
        ({"transition": 0.0}, "above zero"),
    ],
)
def test_impossible_scenarios_are_refused(wrong, fault):
    good = {"duration": 10.0, "soils": (Patch(0.0, "loam"),), "draft": Swing(0.0, 1.0)}
    Scenario(**good)
    with pytest.raises(ValueError, match=fault):
        Scenario(**good | wrong)


def test_unknown_soil_names_the_known_ones():
    with pytest.raises(KeyError, match="loam"):
        Patch(0.0, "lome").parameters()
