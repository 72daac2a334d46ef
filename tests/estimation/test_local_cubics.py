"""Curves of samples: which they follow, what they are worth, how they move."""

import numpy as np
import pytest

from soilbus.estimation.local_cubics import curve_of, faithful, kept_noise, variance_of_one
from soilbus.estimation.window import Rig, SensorNoise
from soilbus.sensors.bins import Bins
from soilbus.sensors.rates import resolved_window
from soilbus.terra.vehicle import Chassis

PHASE_PARTS = 16
"""Parts of the time between two samples at which a variance is asked for."""

T = np.cumsum(np.random.default_rng(1).uniform(0.019, 0.021, 2000))


def wave(t, frequency):
    return np.sin(2.0 * np.pi * frequency * t)


@pytest.mark.parametrize("frequency", [0.2, 1.0, 4.0])
def test_a_curve_follows_its_spectrum_and_leaves_noise_behind(frequency):
    rng, noise = np.random.default_rng(2), 0.05
    curve = curve_of(T, wave(T, frequency) + noise * rng.standard_normal(len(T)), np.full(len(T), noise**2))
    off = curve.value - wave(T, frequency)
    assert off.std() < 0.8 * noise
    between = 0.5 * (T[20:-20][1:] + T[20:-20][:-1])
    slope = 2.0 * np.pi * frequency * np.cos(2.0 * np.pi * frequency * between)
    assert np.abs(curve.at(between)[1] - slope).mean() < 0.15 * np.abs(slope).max()


def test_slow_channels_are_averaged_over_more_than_shaking_ones():
    rng = np.random.default_rng(3)
    widths = [
        curve_of(T, wave(T, f) + 0.05 * rng.standard_normal(len(T)), np.full(len(T), 0.0025)).half_width
        for f in (0.2, 1.0, 4.0)
    ]
    assert widths[0] > widths[1] > widths[2] >= 2


def test_a_cubic_is_its_own_curve():
    cubic = np.polynomial.Polynomial([1.0, -2.0, 0.5, 0.1])
    t = 0.02 * np.arange(100)
    smooth = curve_of(t, cubic(t), np.full(len(t), 1e-6))
    for curve in (smooth, faithful(smooth, cubic(t))):
        now = np.linspace(0.1, 1.8, 40)
        for computed, true in zip(curve.at(now), (cubic, cubic.deriv(), cubic.deriv(2)), strict=True):
            assert computed == pytest.approx(true(now), abs=1e-5)


def value_and_slope(noise, half, place):
    """Value and slope of curves (M,) through rows of noise (M, K) at a place between samples."""
    by_power = np.linalg.pinv(np.arange(-half, half + 1.0)[:, None] ** np.arange(4))
    i, u = int(np.floor(place)), place - np.floor(place)
    (a, b), (left, right), (bend, next_bend) = (
        [noise[:, k - half : k + half + 1] @ w for k in (i, i + 1)]
        for w in (by_power[0], by_power[1], 2.0 * by_power[2])
    )

    def between(start, end, left, right):
        rise = end - start
        return start + u * (left + u * (3 * rise - 2 * left - right + u * (left + right - 2 * rise)))

    return between(a, b, left, right), between(left, right, bend, next_bend)


def mean_value(noise, half, place, n, parts):
    """Mean of curves (M,) over parts, evenly spread over n samples about a place."""
    places = [place + n * ((part + 0.5) / parts - 0.5) for part in range(parts)]
    return np.mean([value_and_slope(noise, half, one)[0] for one in places], axis=0)


def noise_of_instants(noise, half, n, phase, middle, parts=1):
    """What noise adds to values at instants by n samples about a place and the curve there."""
    own = np.arange(n) + int(round(middle - (n - 1) / 2.0))
    rest = np.mean([noise[:, k] - value_and_slope(noise, half, k)[0] for k in own], axis=0)
    return rest + mean_value(noise, half, middle + phase, n, parts)


@pytest.mark.parametrize("half", [2, 4, 9])
@pytest.mark.parametrize(("n", "phase"), [(1, 0.25), (2, 0.0), (5, 0.5), (3, -0.75)])
def test_the_variance_of_a_value_at_one_instant_is_what_noise_makes_of_it(half, n, phase):
    """The same sums over white noise, 20 000 times."""
    noise = np.random.default_rng(4).standard_normal((20_000, 2 * half + 2 * n + 6))
    computed = noise_of_instants(noise, half, n, phase, half + n + 2 + (n - 1) / 2.0)
    assert variance_of_one(half, n, round(phase * PHASE_PARTS)) == pytest.approx(computed.var(), rel=0.04)


@pytest.mark.parametrize("half", [3, 9])
@pytest.mark.parametrize(("n", "phase", "parts"), [(1, 0.25, 1), (2, -0.5, 1), (6, 0.0, 3)])
@pytest.mark.parametrize("ahead", [0.4, -9.0, 3.0])
def test_a_shift_along_a_curve_leaves_the_noise_of_instants_as_large_as_it_is(half, n, phase, parts, ahead):
    """Else a sound channel seems late, as some shift leaves smaller residuals."""
    noise, middle = np.random.default_rng(6).standard_normal((50_000, 60)), 30.0 + (n - 1) / 2.0
    now = noise_of_instants(noise, half, n, phase, middle, parts)
    off = now - mean_value(noise, half, middle + phase, n, parts)
    kept = kept_noise(half, n, phase, half, parts, ahead)
    shifted = kept * off + mean_value(noise, half, middle + phase + ahead, n, parts)
    assert shifted.var() == pytest.approx(now.var(), rel=0.03)


def test_an_averaged_curve_is_that_of_means():
    """Of a sine, means over a length are smaller by sin(x) / x, x half the length's phase."""
    t, length, f = 0.02 * np.arange(400), 0.24, 1.3
    curve = curve_of(t, np.sin(2.0 * np.pi * f * t), np.full(400, 1e-8)).averaged(length, 12)
    at = np.linspace(1.0, 6.0, 77)
    phase = 2.0 * np.pi * f * at
    x = np.pi * f * length
    assert curve.at(at)[0] == pytest.approx(np.sin(x) / x * np.sin(phase), abs=2e-3)
    assert curve.at(at)[1] == pytest.approx(np.sin(x) / x * 2.0 * np.pi * f * np.cos(phase), abs=2e-2)


def store_of(shake: float, step: float = 0.02) -> Bins:
    """A vehicle of one wheel whose load shakes at 4 Hz, its messages at phases of their own."""
    names = ("torque", "load", "speed", "ground_speed", "draft")
    noise = {q: SensorNoise(absolute=0.01) for q in (*names, "sinkage", "pitch", "acceleration", "yaw_rate")}
    chassis = Chassis(1000.0, 2.0, 1.0, 0.5, 0.5)
    rig = Rig(("W",), np.array([0.5]), np.array([0.3]), np.array([True]), chassis, noise)
    rng, store = np.random.default_rng(5), Bins(rig, 0.1, 0.0)
    samples = {}
    for name in names:
        t = rng.uniform(0.0, step) + step * np.arange(int(20.0 / step))
        truth = 3.0 + wave(t, 0.1) + (shake * wave(t, 4.0) if name == "load" else 0.0)
        channel = f"{name}.W" if name in ("torque", "load", "speed") else name
        samples[channel] = t, truth + 0.01 * rng.standard_normal(len(t))
    store.add(samples)
    return store


def test_bins_are_short_where_a_channel_shakes_and_no_shorter_than_its_samples_are_apart():
    steps = [float(np.diff(resolved_window(store_of(*case), 20.0).t)[0]) for case in ((0.0,), (0.3,), (0.3, 0.05))]
    assert steps[0] == pytest.approx(0.1)
    assert steps[1] < 0.05
    assert steps[2] == pytest.approx(0.05, rel=0.02)


def test_a_value_is_that_of_the_bins_centre_and_its_variance_true():
    window = resolved_window(store_of(0.3), 20.0)
    inner = slice(20, -20)
    off = (window.load[:, 0] - 3.0 - wave(window.t, 0.1) - 0.3 * wave(window.t, 4.0))[inner]
    assert np.mean(off**2 / window.variance["load"][inner, 0]) == pytest.approx(1.0, abs=0.2)
