"""Instants: means of a window's known bins and their variances; windows share them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soilbus.estimation.instants import averaged
from soilbus.terra.soils import SOILS


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
    for quantity in ("torque", "speed", "ground_speed", "draft"):
        value, variance = getattr(window, quantity), window.variance[quantity]
        for i, b in enumerate(bins):
            n = np.isfinite(value[b]).sum(axis=0)
            assert getattr(means, quantity)[i] == pytest.approx(np.nansum(value[b], axis=0) / n)
            known = np.where(np.isfinite(variance[b]), variance[b], 0.0)
            counted = np.isfinite(variance[b]).sum(axis=0)
            assert means.variance[quantity][i] == pytest.approx(known.sum(axis=0) / counted**2)


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
