"""Bins against sums made sample by sample."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soilbus.estimation.window import Rig, SensorNoise, window_of_samples
from soilbus.sensors.bins import Bins

NOISE = {
    "torque": SensorNoise(of_mean=0.02, gain=0.01),
    "load": SensorNoise(relative=0.03),
    "speed": SensorNoise(absolute=0.2, relative=0.05),
    "sinkage": SensorNoise(absolute=0.004),
    "ground_speed": SensorNoise(relative=0.01),
    "draft": SensorNoise(absolute=40.0, of_mean=0.1),
    "pitch": SensorNoise(absolute=0.002),
    "acceleration": SensorNoise(absolute=0.02),
    "yaw_rate": SensorNoise(absolute=0.01),
    "roll": SensorNoise(absolute=0.004),
    "steering_angle": SensorNoise(absolute=0.02),
    "differential_lock": SensorNoise(absolute=1.0),
}
RIG = Rig(("L", "R"), np.array([0.5, 0.6]), np.array([0.3, 0.4]), np.array([True, False]), None, NOISE)
EPOCH = 1_700_000_000.0
SEED = st.integers(0, 2**32 - 1)


def filled(columns, origin=0.0, pieces=1, rng=None):
    """A store that got the columns in several batches, in random order where there is an rng."""
    store = Bins(RIG, 0.1, origin)
    for i in range(pieces) if rng is None else rng.permutation(pieces):
        batch = {}
        for name, (t, value) in columns.items():
            mine = np.arange(len(t)) if rng is None else np.random.default_rng(9).permutation(len(t))
            part = np.array_split(mine, pieces)[i]
            batch[name] = (t[part], value[part])
        store.add(batch)
    return store


def channel(window, name):
    """Mean and variance columns of one channel."""
    quantity, _, wheel = name.partition(".")
    column = (slice(None), RIG.wheels.index(wheel)) if wheel else slice(None)
    return getattr(window, quantity)[column], window.variance[quantity][column]


@given(seed=SEED, name=st.sampled_from(RIG.channels), origin=st.sampled_from([0.0, -3.7, EPOCH]))
def test_means_variances_and_counts_are_those_of_the_samples(seed, name, origin):
    rng = np.random.default_rng(seed)
    # Samples mirrored about their bins' centres: there is nothing to move to the centre.
    half = rng.integers(0, 20, 40)
    off = rng.uniform(0.001, 0.049, 40)
    since = np.concatenate([0.1 * half + 0.05 + off, 0.1 * half + 0.05 - off])
    value = rng.normal(5.0, 2.0, 80)
    window = filled({name: (origin + since, value)}, origin, 5, rng).window(origin, origin + 2.0)
    mean, variance = channel(window, name)
    noise = NOISE[name.partition(".")[0]]
    members = [value[np.concatenate([half, half]) == k] for k in range(20)]
    means = np.array([m.mean() if len(m) else math.nan for m in members])
    assert mean == pytest.approx(means, rel=1e-4 if origin == EPOCH else 1e-9, nan_ok=True)
    level = np.nanmean(np.abs(means))
    for k, m in enumerate(members):
        one = noise.absolute**2 + (noise.relative * means[k]) ** 2 + (noise.of_mean * level) ** 2
        assert (variance[k] == pytest.approx(one / len(m), rel=1e-3)) if len(m) else not np.isfinite(variance[k])
    assert window.samples == 80
    assert window.t == pytest.approx(origin + 0.05 + 0.1 * np.arange(20), abs=1e-6)
    for other in set(RIG.channels) - {name}:
        assert np.isnan(channel(window, other)[0]).all()


@given(seed=SEED, rate=st.floats(12.0, 200.0), slope=st.floats(-5.0, 5.0))
def test_a_linear_signal_is_exact_at_the_centres_whatever_the_phase(seed, rate, slope):
    rng = np.random.default_rng(seed)
    columns = {}
    for name in RIG.channels:
        t = np.arange(0.0, 3.0, 1.0 / rate) + rng.uniform(0.0, 1.0 / rate)
        t += rng.uniform(0.0, 0.1 / rate, len(t))
        t = t[t < 3.0]
        columns[name] = (t, 2.0 + slope * t)
    window = filled(columns).window(0.0, 3.0)
    for name in RIG.channels:
        mean = channel(window, name)[0]
        known = np.isfinite(mean)  # the first or last bin may be empty
        assert known[1:-1].all()
        assert mean[known] == pytest.approx(2.0 + slope * window.t[known], abs=1e-9)


def test_linear_beside_a_gap_and_plain_mean_of_a_lonely_bin():
    t = np.array([0.01, 0.11, 0.24, 0.71, 0.83, 1.18])  # bins 0 1 2, 7 8, 11
    window = filled({"draft": (t, 10.0 * t)}).window(0.0, 1.2)
    expected = np.full(12, np.nan)
    expected[[0, 1, 2, 7, 8]] = [0.5, 1.5, 2.5, 7.5, 8.5]
    expected[11] = 11.8  # no neighbour tells a slope
    assert window.draft == pytest.approx(expected, nan_ok=True)


@given(seed=SEED, origin=st.sampled_from([0.0, 0.37, EPOCH, EPOCH + 0.123456]), on_border=st.booleans())
def test_every_sample_is_in_exactly_one_of_disjoint_windows(seed, origin, on_border):
    rng = np.random.default_rng(seed)
    t = origin + (rng.integers(0, 50, 300) * 0.1 if on_border else rng.uniform(0.0, 4.99999, 300))
    store = filled({"draft": (t, rng.normal(size=300)), "load.R": (t, np.ones(300))}, origin, 7, rng)
    windows = [store.window(origin + a, origin + b) for a, b in ((0, 1), (1, 2.5), (2.5, 2.6), (2.6, 5))]
    assert sum(w.samples for w in windows) == 600
    assert [len(w.t) for w in windows] == [10, 15, 1, 24]
    # load.R reads 1 with an sd of 3 %: its variances tell how many samples a bin has got.
    counts = np.bincount(np.floor((t - origin) / 0.1 + 1e-9).astype(int), minlength=50)
    whole = store.window(origin, origin + 5.0)
    for parts in ([w.variance["load"][:, 1] for w in windows], [whole.variance["load"][:, 1]]):
        share = np.nan_to_num(9e-4 / np.concatenate(parts)) / np.maximum(counts, 1)
        assert np.all(share[counts > 0] <= 1.0 + 1e-9)
        assert np.all(share[counts > 0] >= 1.0 / 1.125 - 1e-9)  # moved by half a bin at most
        assert not share[counts == 0].any()


def test_drop_before_forgets_whole_bins_only_and_later_windows_stay_the_same():
    rng = np.random.default_rng(5)
    columns = {n: (np.sort(rng.uniform(0.0, 6.0, 400)), rng.normal(size=400)) for n in RIG.channels}
    kept, dropped = filled(columns), filled(columns)
    dropped.drop_before(2.05)  # in the middle of a bin, which stays
    dropped.drop_before(1.0)  # back in time: nothing to forget
    a, b = kept.window(2.0, 6.0), dropped.window(2.0, 6.0)
    assert a.samples == b.samples
    for name in RIG.channels:
        assert np.array_equal(channel(a, name)[0], channel(b, name)[0], equal_nan=True)
    cut = dropped.window(1.0, 6.0)  # what is forgotten is not in the window, not even as zeros
    assert len(cut.t) == 40
    assert cut.t[0] == pytest.approx(2.05)
    dropped.add({"draft": (np.array([0.5, 1.99]), np.array([9e9, 9e9]))})  # too late
    assert dropped.window(2.0, 6.0).samples == b.samples
    dropped.add({"draft": (np.array([0.5, 7.5]), np.array([9e9, 1.0]))})
    assert dropped.window(2.0, 8.0).samples == b.samples + 1


def test_a_window_beyond_the_data_is_all_missing():
    store = filled({"draft": (np.array([0.05]), np.array([7.0]))})
    window = store.window(1.0, 3.0)
    assert window.samples == 0
    assert len(window.t) == 20
    for name in RIG.channels:
        mean, variance = channel(window, name)
        assert np.isnan(mean).all()
        assert not np.isfinite(variance).any()


def test_a_window_of_samples_counts_each_row_as_one():
    t = np.arange(5.0)
    samples = {"load.L": np.array([1e3, 2e3, np.nan, 4e3, 5e3]), "draft": np.full(5, 300.0), "unknown": t}
    window = window_of_samples(RIG, t, samples)
    assert np.array_equal(window.load[:, 0], samples["load.L"], equal_nan=True)
    assert window.variance["load"][[0, 1], 0] == pytest.approx([900.0, 3600.0])
    assert window.variance["draft"] == pytest.approx(np.full(5, 40.0**2 + 30.0**2))
    assert window.samples == 9
    assert np.isnan(window.torque).all()
    only = window_of_samples(RIG, t, {"draft": samples["draft"]})
    assert np.isnan(only.load).all()
