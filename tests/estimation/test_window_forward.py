"""Reversing is driving forward seen in a mirror."""

import dataclasses

import numpy as np
import pytest

from soilbus.estimation.local_cubics import curve_of
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.window import Window, forward
from soilbus.terra.soils import SOILS

ALONG = ("speed", "torque", "ground_speed", "draft", "pitch", "acceleration")
ACROSS = ("load", "sinkage")


def backwards(window: Window, part=slice(None), signed_ground: bool = True) -> Window:
    """The window as its sensors would read, were the same drive done in reverse during a part of it."""
    mirrored = {name: getattr(window, name).copy() for name in ALONG}
    for name in ALONG:
        if name != "ground_speed" or signed_ground:
            mirrored[name][part] *= -1.0
    return dataclasses.replace(window, **mirrored)


def equal(a: Window, b: Window) -> bool:
    return all(np.array_equal(getattr(a, q), getattr(b, q), equal_nan=True) for q in ALONG + ACROSS) and all(
        np.array_equal(v, b.variance[q], equal_nan=True) for q, v in a.variance.items()
    )


@pytest.fixture(scope="module")
def loam(simulated):
    case = simulated(SOILS["loam"], 21)
    case.window.pitch[:] += 0.05  # uphill, so that its sign matters
    case.window.draft[:] -= case.rig.chassis.mass * 9.80665 * np.sin(0.05)
    return case


@pytest.mark.parametrize("signed_ground", [True, False], ids=["signed", "radar"])
@pytest.mark.parametrize("part", [slice(None), slice(30, 70)], ids=["all", "part"])
def test_a_drive_in_reverse_gives_the_very_same_estimate(part, signed_ground, loam):
    reverse = backwards(loam.window, part, signed_ground)
    assert equal(forward(reverse), loam.window)
    ahead, back = (fit_window(loam.problem(w), loam.prior) for w in (loam.window, forward(reverse)))
    assert back.posterior.soil == ahead.posterior.soil
    assert np.array_equal(back.posterior.log_covariance, ahead.posterior.log_covariance)
    assert back.chi2 == ahead.chi2 < 1.2


def test_forward_driving_is_left_alone(loam):
    assert forward(loam.window) is loam.window
    assert equal(forward(forward(backwards(loam.window))), loam.window)


def test_curves_of_samples_are_mirrored_and_kept_where_the_vehicle_stood(loam):
    t = loam.window.t
    way = np.where(t < t[30], -1.0, 1.0)
    sampled = {
        "torque.FL": curve_of(t, way * loam.window.torque[:, 0], np.ones(len(t))),
        "ground_speed": curve_of(t, way * loam.window.ground_speed, np.ones(len(t))),
        "load.FL": curve_of(t, loam.window.load[:, 0], np.ones(len(t))),
    }
    found = forward(dataclasses.replace(backwards(loam.window, slice(0, 30)), curves=sampled)).curves
    for name, curve in sampled.items():
        sign = np.ones(len(t)) if name == "load.FL" else way
        assert np.array_equal(found[name].value, sign * curve.value), name
        assert np.array_equal(found[name].slope, sign * curve.slope), name


def few(speeds, **columns) -> Window:
    """Instants with these wheel speeds (N, 4); everything else is 1."""
    speed = np.array(speeds, float)
    n = len(speed)
    values = {q: np.ones((n, 4)) for q in ("torque", "load", "sinkage")}
    values |= {q: np.ones(n) for q in ("ground_speed", "draft", "pitch", "acceleration")}
    values |= {q: np.array(v, float) for q, v in columns.items()}
    variance = {q: np.ones_like(v) for q, v in values.items()} | {"speed": np.ones_like(speed)}
    return Window(t=np.arange(n) * 0.1, speed=speed, variance=variance, samples=9 * n, **values)


def test_wheels_against_the_majority_are_unknown():
    nan = np.nan
    window = few([
        [1, 2, 3, 4], [-1, -2, -3, -4], [-1, nan, nan, -4], [nan] * 4, [0, 0, 0, 0], [0, -1, -1, 0],
        [1, 2, 3, -4], [-1, -2, 3, -4], [1, -2, 3, -4], [1, -2, nan, 0], [0, 0, 0, -1],
    ])  # fmt: skip
    mirrored = forward(window)
    expected = [
        [1, 2, 3, 4], [1, 2, 3, 4], [1, nan, nan, 4], [nan] * 4, [0, 0, 0, 0], [0, 1, 1, 0],
        [1, 2, 3, nan], [1, 2, nan, 4], [nan] * 4, [nan] * 4, [0, 0, 0, 1],
    ]  # fmt: skip
    assert np.array_equal(mirrored.speed, np.array(expected, float), equal_nan=True)
    way = np.array([1, -1, -1, 1, 1, -1, 1, -1, 1, 1, -1.0])
    for name in ("torque", "draft", "pitch", "acceleration"):
        value = getattr(mirrored, name)
        assert np.array_equal(value, way if value.ndim == 1 else np.repeat(way[:, None], 4, axis=1)), name
    assert (mirrored.load == 1.0).all()
    assert (mirrored.sinkage == 1.0).all()
    assert (mirrored.ground_speed == 1.0).all()


def test_ground_speed_keeps_its_sign_where_the_wheels_drive_forward():
    # Rolling back downhill while the wheels spin forward is no slip of this model; the standstill gate has it.
    mirrored = forward(few([[1, 1, 1, 1], [-1, -1, -1, -1]], ground_speed=[-0.5, -0.5]))
    assert mirrored.ground_speed.tolist() == [-0.5, 0.5]
