"""Waves stay in their range and are what their rates and integrals say; soils follow the way."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from soilbus.simulator.scenario import Patch, Scenario, Swing, realise, soil_along, soil_names
from soilbus.terra.soils import soil_named


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.integers(0, 10**6), st.floats(-5.0, 5.0), st.floats(0.0, 10.0), st.floats(2.0, 150.0))
def test_waves_stay_in_range_with_exact_rate_and_integral(seed, low, span, duration):
    t = np.linspace(0.0, duration, 5001)
    wave = realise(Swing(low, low + span), t, np.random.default_rng(seed))
    slack = 1e-5 * span + 1e-12
    assert wave.value.min() >= low - slack and wave.value.max() <= low + span + slack
    step = t[1]
    area = np.concatenate([[0.0], np.cumsum((wave.value[1:] + wave.value[:-1]) / 2.0) * step])
    assert wave.integral == pytest.approx(area, abs=1e-3 * (abs(low) + span) + 1e-12)
    assert np.gradient(wave.value, t)[1:-1] == pytest.approx(wave.rate[1:-1], abs=2e-2 * span + 1e-12)


def test_a_long_wave_sweeps_its_whole_range_slowly():
    t = np.linspace(0.0, 120.0, 6001)
    wave = realise(Swing(0.05, 0.4), t, np.random.default_rng(0))
    assert wave.value.min() < 0.052 and wave.value.max() > 0.398
    spectrum = np.abs(np.fft.rfft(wave.value - wave.value.mean())) ** 2
    frequency = np.fft.rfftfreq(len(t), t[1])
    assert spectrum[frequency > 0.15].sum() < 0.01 * spectrum.sum()


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
    "wrong",
    [
        {"soils": ()},
        {"soils": (Patch(5.0, "loam"), Patch(0.0, "loam"))},
        {"draft": None},
        {"slip": Swing(0.1, 0.2)},
        {"duration": 0.01},
        {"speed": Swing(0.0, 1.0)},
        {"transition": 0.0},
    ],
)
def test_impossible_scenarios_are_refused(wrong):
    good = {"duration": 10.0, "soils": (Patch(0.0, "loam"),), "draft": Swing(0.0, 1.0)}
    Scenario(**good)
    with pytest.raises(ValueError):
        Scenario(**good | wrong)


def test_unknown_soil_names_the_known_ones():
    with pytest.raises(KeyError, match="loam"):
        Patch(0.0, "lome").parameters()
