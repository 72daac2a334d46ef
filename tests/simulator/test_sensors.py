"""Sensors are as noisy and as wrong as the configuration says."""

import numpy as np
import pytest

from soilbus.config.file import load_config, parse_config
from soilbus.config.model import Noise
from soilbus.simulator.drive import drive
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import TRACTOR
from soilbus.simulator.scenario import Patch, Scenario, Swing, excited
from soilbus.simulator.sensors import measure, noise_sd

CONFIG = load_config(TRACTOR)


@pytest.fixture(scope="module")
def recording():
    return simulate(CONFIG, excited("loam", 120.0), seed=11)


def test_every_mapped_channel_has_a_column_at_its_rate(recording):
    quantities = ("torque", "speed", "load", "sinkage", "torque_limit")
    wheels = {f"{quantity}.{wheel}" for quantity in quantities for wheel in ("FL", "FR", "RL", "RR")}
    slower = {"ground_speed": 0.04, "latitude": 0.1, "longitude": 0.1}
    assert set(recording.channels) == wheels | {"draft", "pitch", "acceleration"} | set(slower)
    for name, column in recording.channels.items():
        period = slower.get(name, 0.02)
        assert np.diff(column.t) == pytest.approx(period)
        assert len(column.t) == len(column.value) == round(120 / period)


@pytest.mark.parametrize(
    ("name", "sd"),
    [
        ("torque.RL", lambda truth: 0.01 * np.abs(truth).mean()),
        ("load.FR", lambda truth: 0.01 * truth),
        ("speed.FL", lambda truth: 0.002 * truth),
        ("ground_speed", lambda truth: 0.008 * truth),
        ("draft", lambda truth: 40.0),
        ("sinkage.RR", lambda truth: 0.004),
        ("pitch", lambda truth: 0.002),
        ("acceleration", lambda truth: 0.005),
    ],
)
def test_noise_is_as_configured(recording, name, sd):
    column = recording.channels[name]
    truth = np.interp(column.t, recording.truth["t"], recording.truth[name])
    gain = column.value @ truth / (truth @ truth) if name != "pitch" else 1.0
    error = (column.value - gain * truth) / sd(truth)
    assert error.std() == pytest.approx(1.0, abs=0.05)
    assert abs(error.mean()) < 4.0 / np.sqrt(len(error))
    assert abs(np.corrcoef(error[1:], error[:-1])[0, 1]) < 4.0 / np.sqrt(len(error))


def test_fixes_are_off_by_two_centimetres_north_and_east(recording):
    metres_per_rad = 6371e3
    for name, scale in (("latitude", 1.0), ("longitude", np.cos(recording.truth["latitude"][0]))):
        column = recording.channels[name]
        off = (column.value - np.interp(column.t, recording.truth["t"], recording.truth[name])) * metres_per_rad * scale
        assert off.std() == pytest.approx(0.02, rel=0.07)
        assert abs(off.mean()) < 4.0 * 0.02 / np.sqrt(len(off))


def test_gain_errors_are_fixed_for_a_drive_and_spread_as_configured():
    noise = CONFIG.noise.model_copy(update={"draft": Noise(absolute=1e-6, gain=0.02)})
    config = CONFIG.model_copy(update={"noise": noise})
    done = drive(config, Scenario(2.0, (Patch(0.0, "loam"),), draft=Swing(1000.0, 1000.0)), 1)
    truth = done.columns["draft"]
    gains = np.array([measure(done, config, seed)["draft"].value / truth for seed in range(600)])
    assert np.ptp(gains, axis=1).max() < 1e-7
    assert gains[:, 0].mean() == pytest.approx(1.0, abs=4 * 0.02 / np.sqrt(600))
    assert gains[:, 0].std() == pytest.approx(0.02, rel=0.12)


def test_noise_of_the_mean_follows_the_window_not_the_sample():
    truth = np.concatenate([np.full(4000, 100.0), np.full(4000, 900.0)])
    sd = noise_sd(truth, Noise(of_mean=0.01), 10.0)
    assert sd[:3000] == pytest.approx(1.0)
    assert sd[5000:] == pytest.approx(9.0)
    assert sd[4000] == pytest.approx(5.0)


def test_a_channel_does_not_change_when_another_is_not_fitted(recording):
    raw = CONFIG.model_dump(exclude={"folder"}, exclude_none=True)
    for wheel in raw["wheel"]:
        del wheel["sinkage"]
    without = simulate(parse_config(raw), excited("loam", 120.0), seed=11)
    assert not any(name.startswith("sinkage") for name in without.channels)
    for name, column in without.channels.items():
        assert np.array_equal(column.value, recording.channels[name].value), name
    other = simulate(CONFIG, excited("loam", 10.0), seed=12)
    assert not np.array_equal(other.channels["draft"].value[:100], recording.channels["draft"].value[:100])
