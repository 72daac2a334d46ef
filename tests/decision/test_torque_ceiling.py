"""A ceiling is found where torque no longer follows the pull, and only there."""

import numpy as np
import pytest

from soilbus.decision.torque_ceiling import TorqueCeiling
from soilbus.estimation.assembly import rig_of
from soilbus.estimation.window import Window, window_of_samples
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.vehicle import GRAVITY

RIG = rig_of(reference_configuration())
MASS, RESISTANCE = 2300.0, 0.2
STEP = 0.1


def draft_over(seconds: list[float], draft: list[float]) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(STEP / 2.0, seconds[-1], STEP)
    return t, np.interp(t, seconds, draft)


def recording(t: np.ndarray, draft: np.ndarray, most: np.ndarray | float, seed: int = 0, rate: float | None = None):
    """All wheels share the thrust that draft and resistance ask, up to a torque `most` [N m] of each.

    What is missing slows the vehicle down; what was lost is regained at 0.2 m/s^2 where the torque allows.  `rate`
    [m/s^2]: the speed falls so much and the thrust allows for it, instead.
    """
    rng = np.random.default_rng(seed)
    radius = float(RIG.radius.mean())
    limit = np.broadcast_to(most, t.shape)
    speed, torques, speeds, rates = 1.5, [], [], []
    for pull, top in zip(draft, limit, strict=True):
        wants = rate if rate is not None else min(0.2, (1.5 - speed) / STEP)
        torque = min((pull + RESISTANCE * MASS * GRAVITY + MASS * wants) * radius / 4.0, top)
        a = (4.0 * torque / radius - pull) / MASS - RESISTANCE * GRAVITY
        torques.append(torque)
        speeds.append(speed)
        rates.append(a)
        speed = max(speed + a * STEP, 0.3)
    columns = {"ground_speed": np.array(speeds) * (1.0 + 0.002 * rng.standard_normal(len(t)))}
    columns |= {"acceleration": np.array(rates) + 0.002 * rng.standard_normal(len(t)), "pitch": 0.0 * t}
    columns["draft"] = draft + 20.0 * rng.standard_normal(len(t))
    for wheel in RIG.wheels:
        columns[f"torque.{wheel}"] = np.array(torques) * (1.0 + 0.005 * rng.standard_normal(len(t)))
        columns[f"load.{wheel}"] = MASS * GRAVITY / 4.0 * (1.0 + 0.005 * rng.standard_normal(len(t)))
        columns[f"speed.{wheel}"] = columns["ground_speed"] / (0.9 * radius)
    return window_of_samples(RIG, t, columns)


def limits(window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Ends [s] of the hops and the limits (hops, W) then in force, by windows of 10 s at most."""
    ceiling, ends, found = TorqueCeiling.unknown(len(RIG.wheels)), [], []
    for end in np.arange(1.0, window.t[-1] + STEP, 1.0):
        rows = np.flatnonzero((window.t > end - 10.0) & (window.t < end))
        ceiling = ceiling.after(window.rows(rows), RIG, 1.0, 3.0)
        ends.append(end)
        found.append(ceiling.limit)
    return np.array(ends), np.array(found)


UP_AND_DOWN = ([0, 4, 10, 13, 20, 26, 30, 40], [1000, 1000, 3500, 1000, 1000, 3500, 1000, 1000])


@pytest.mark.parametrize("seed", range(5))
def test_a_level_that_the_torque_returns_to_is_a_ceiling(seed):
    t, draft = draft_over(*UP_AND_DOWN)
    ends, found = limits(recording(t, draft, 900.0, seed))
    assert np.isnan(found[ends <= 4.0]).all()
    first = (ends >= 9.0) & (ends <= 11.0)
    assert found[first] == pytest.approx(np.full((first.sum(), 4), 900.0), rel=0.01)
    between = (ends >= 18.0) & (ends <= 20.0)
    assert np.isnan(found[between]).all()
    assert found[ends >= 27.0] == pytest.approx(np.full(((ends >= 27.0).sum(), 4), 900.0), rel=0.01)


@pytest.mark.parametrize("seed", range(5))
def test_another_level_is_none_and_more_torque_lifts_one(seed):
    t, draft = draft_over([*UP_AND_DOWN[0], 46, 50], [*UP_AND_DOWN[1], 3500, 3500])
    held = limits(recording(t, draft, np.where(t < 15.0, 900.0, 950.0), seed))[1]
    assert np.isnan(held[30:40]).all()
    ends, lifted = limits(recording(t, draft, np.where(t < 35.0, 900.0, 2400.0), seed))
    assert np.isfinite(lifted[ends == 35.0]).all()
    assert np.isnan(lifted[ends >= 47.0]).all()


@pytest.mark.parametrize("seed", range(5))
def test_torque_that_follows_its_pull_has_no_ceiling(seed):
    t, draft = draft_over(*UP_AND_DOWN)
    assert np.isnan(limits(recording(t, draft, 2400.0, seed))[1]).all()
    periodic = 2000.0 + 1200.0 * np.sin(0.9 * t)
    assert np.isnan(limits(recording(t, periodic, 2400.0, seed))[1]).all()


@pytest.mark.parametrize("seed", range(5))
def test_a_steady_pull_and_a_driver_who_slows_down_show_none(seed):
    t = np.arange(STEP / 2.0, 12.0, STEP)
    steady = np.full_like(t, 2500.0)
    assert np.isnan(limits(recording(t, steady, 2400.0, seed))[1]).all()
    assert np.isnan(limits(recording(t, steady, 2400.0, seed, rate=-0.08))[1]).all()
