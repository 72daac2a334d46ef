"""Bins of samples: channels slower than the bins, and how long the bins are behind differentials."""

from __future__ import annotations

import numpy as np
import pytest

from soilbus.estimation.assembly import rig_of
from soilbus.sensors.bins import Bins
from soilbus.simulator.reference import REFERENCES, reference_configuration
from tests.lab.computed_loads import Task, errors

NOISE = 0.01
"""Sd of a sample of ground speed [m/s]."""


def stored(period, lost=()):
    """Ground speed of the reference tractor every `period` seconds on a ramp, wheel speeds as often, bins of 0.04 s."""
    rig = rig_of(reference_configuration([f"noise.ground_speed={{absolute={NOISE}, relative=0.0}}"]))
    store = Bins(rig, 0.04, 0.0)
    t = np.setdiff1d(np.arange(round(4.0 / period)), lost) * period + 0.011
    store.add({"ground_speed": (t, 1.0 + 0.1 * t), "speed.FL": (t, 2.0 + 0.1 * t)})
    return t, store.window(0.0, 4.0)


def test_a_slow_ground_speed_lies_on_the_line_between_its_samples_and_is_worth_no_more_than_they_are():
    t, window = stored(0.1)
    known = np.isfinite(window.ground_speed)
    assert known.sum() > 2 * len(t)
    assert window.ground_speed[known] == pytest.approx(1.0 + 0.1 * window.t[known], abs=1e-12)
    worth = np.sum(NOISE**2 / window.variance["ground_speed"][known])
    assert 0.75 * len(t) < worth <= len(t) * (1.0 + 1e-9)


def test_where_a_sample_is_lost_nothing_is_put_in_its_place():
    _, whole = stored(0.1)
    _, window = stored(0.1, lost=[20])
    missing = np.isfinite(whole.ground_speed) & ~np.isfinite(window.ground_speed)
    assert missing.sum() >= 4
    assert np.all(np.abs(window.t[missing] - 2.011) < 0.1)


def test_a_wheel_speed_is_known_only_in_the_bins_in_which_it_was_measured():
    t, window = stored(0.1)
    assert np.isfinite(window.speed[:, 0]).sum() == len(t)


def test_channels_as_fast_as_the_bins_have_their_own_samples():
    t, window = stored(0.02)
    assert np.isfinite(window.ground_speed).all()
    assert window.samples == 2 * len(t)


@pytest.mark.parametrize(
    ("machine", "overrides", "length"),
    [
        ("tractor", [], 0.1),
        ("tractor-2wd", [], 0.04),
        ("tractor-2wd", ["estimator.bin=0.1"], 0.1),
        ("tractor-axles", [], 0.04),
    ],
)
def test_bins_resolve_the_shaking_where_wheels_share_a_torque(machine, overrides, length):
    assert reference_configuration(overrides, REFERENCES[machine]).estimator.bin == length


def test_behind_an_open_differential_shaking_loads_do_not_bias_the_soil():
    """Means of 16 errors, each of one sd; with bins of 0.1 s that of n is -1.16, its rms 1.9, on the same drives."""
    found = [errors(Task("tractor-2wd", "clayey_soil_38", 0.12, seed)) for seed in range(16)]
    off = np.array([one for one in found if one is not None])
    assert len(off) >= 15
    assert np.all(np.abs(off.mean(axis=0)) < 0.75)
    assert np.all(np.sqrt(np.mean(off**2, axis=0)) < 1.6)
