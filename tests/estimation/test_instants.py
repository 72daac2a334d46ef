"""Instants: means of a window's known bins and their variances; windows share them."""

from dataclasses import replace

import numpy as np
import pytest

from soilbus.estimation.assembly import rig_of
from soilbus.estimation.instants import averaged
from soilbus.estimation.window import window_of_samples
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.soils import SOILS

CONFIG = reference_configuration()
WHEELS = rig_of(CONFIG).wheels


@pytest.fixture(scope="module")
def window(simulated):
    return simulated(SOILS["loam"], 3).window


def instants_of(window, end: float, length: float) -> list[np.ndarray]:
    """Indices of the bins of each instant, the earliest first."""
    number = np.round((end - window.t) * 1000.0) // round(length * 1000.0)
    return [np.flatnonzero(number == i) for i in sorted(set(number.tolist()), reverse=True)]


@pytest.mark.parametrize("length", [0.2, 0.25, 0.5, 10.0])
def test_means_of_the_known_bins(window, length) -> None:
    speed = window.speed.copy()
    speed[::3, 1] = np.nan
    window, end = replace(window, speed=speed), float(window.t[-1]) + 0.05
    means, bins = averaged(window, end, length), instants_of(window, end, length)
    assert len(means.t) == len(bins)
    assert means.t == pytest.approx([window.t[b].mean() for b in bins], abs=1e-6)
    for quantity in ("torque", "ground_speed", "draft"):
        value, variance = getattr(window, quantity), window.variance[quantity]
        for i, b in enumerate(bins):
            n = np.isfinite(value[b]).sum(axis=0)
            assert getattr(means, quantity)[i] == pytest.approx(np.nansum(value[b], axis=0) / n)
            known = np.where(np.isfinite(variance[b]), variance[b], 0.0)
            counted = np.isfinite(variance[b]).sum(axis=0)
            assert means.variance[quantity][i] == pytest.approx(known.sum(axis=0) / counted**2)


def test_the_slip_of_an_instant_is_the_mean_of_its_bins() -> None:
    t = np.arange(0.05, 10.0, 0.1)
    swinging = 1.0 + 0.4 * np.sin(2.0 * np.pi * 1.7 * t)[:, None] * [0.1, 0.5, 1.0, 1.0]
    window = window_of_samples(rig_of(CONFIG), t, {f"speed.{w}": 3.0 * swinging[:, i] for i, w in enumerate(WHEELS)})
    window = replace(window, ground_speed=np.full(len(t), 1.2))
    means = averaged(window, 10.0, 0.5)
    of_bins = (1.2 / window.speed).reshape(-1, 5, 4).mean(axis=1)
    assert 1.2 / means.speed == pytest.approx(of_bins)
    assert np.abs(means.speed / window.speed.reshape(-1, 5, 4).mean(axis=1) - 1.0).max() > 0.05


def test_unknown_where_no_bin_is_known(window) -> None:
    speed = window.speed.copy()
    speed[:, 0] = np.nan
    means = averaged(replace(window, speed=speed), float(window.t[-1]) + 0.05, 0.5)
    assert np.isnan(means.speed[:, 0]).all()
    assert np.isfinite(means.speed[:, 1]).all()


def test_windows_a_second_apart_share_their_instants(window) -> None:
    end = float(window.t[-1]) + 0.05
    whole, earlier = averaged(window, end, 0.25), averaged(window.rows(slice(0, -10)), end - 1.0, 0.25)
    assert earlier.t == pytest.approx(whole.t[:-4], abs=1e-9)
    assert earlier.torque == pytest.approx(whole.torque[:-4])


def test_bins_stay_as_they_are_without_a_length(window) -> None:
    assert averaged(window, float(window.t[-1]), 0.0) is window
    assert averaged(window, float(window.t[-1]) + 0.05, 0.1) is window
