"""Gains of the last run as prior after a pause, on the same or another soil."""

import math
from dataclasses import replace

import numpy as np
import pytest

from driven_windows import errors, tracker_of, windows
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.tracker import gain_errors
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS

GAIN_CORRELATION_TIME = 86400.0
"""A gain error forgets all but 1/e in a day [s]."""

CONFIG = reference_configuration()
PRIOR = prior_of(CONFIG)
_, GAIN_STD = gain_errors(rig_of(CONFIG), model_of(CONFIG), ())
BORDER, SPEED = 25.0, 1.5
NIGHT = 12.0 * 3600.0


def drive(first: str, second: str, seed: int):
    """Windows of one recording, so of one set of sensors: those before the border, and the first one after it."""
    patches = (Patch(0.0, first), Patch(BORDER * SPEED, second))
    scenario = Scenario(BORDER + 13.0, patches, speed=Swing(SPEED, SPEED + 1e-6), slip=Swing(0.05, 0.40))
    known = list(windows(CONFIG, simulate(CONFIG, scenario, seed)))
    return [w for w in known if w[1] < BORDER], next(w for w in known if w[1] > BORDER + 2.0 + CONFIG.estimator.window)


def learned(before) -> Gaussian:
    """What a run leaves behind."""
    tracker = tracker_of(CONFIG)
    for window, end in before:
        tracker.estimate(window, end)
    assert tracker.newest_posterior is not None
    return tracker.newest_posterior


def first_fit(window, gaussian: Gaussian | None, elapsed: float = NIGHT):
    """Of a run that knew this beforehand."""
    tracker = tracker_of(CONFIG)
    if gaussian is not None:
        tracker.start_from_last_run(gaussian, elapsed)
    tracker.reset()  # as the first window of every run asks
    tracked = tracker.estimate(*window)
    assert not tracked.mismatch
    return tracked.fit


def width_of_tan_phi(fit) -> float:
    """Its relative standard deviation."""
    tan_phi = fit.posterior.tan_phi()
    return tan_phi.std / tan_phi.value


def gain_widths(fit) -> np.ndarray:
    """Standard deviations of the gains in those of their prior."""
    return np.array([fit.mode.gain(i).std for i in range(len(GAIN_STD))]) / GAIN_STD


@pytest.fixture(scope="module")
def onto_clay():
    before, after = drive("loam", "wet_clay", 5)
    return learned(before), after


def test_gains_wander_about_their_prior_as_long_as_nobody_looks():
    rng = np.random.default_rng(1)
    root = 0.1 * rng.standard_normal((6 + len(GAIN_STD),) * 2) * np.concatenate([np.ones(6), GAIN_STD])[:, None]
    gaussian = Gaussian(PRIOR.median * 2.0, GAIN_STD * rng.standard_normal(len(GAIN_STD)), root @ root.T)
    for elapsed in (0.0, 60.0, GAIN_CORRELATION_TIME, 30 * GAIN_CORRELATION_TIME):
        left = gaussian.with_prior_soil(PRIOR).wandered(math.exp(-elapsed / GAIN_CORRELATION_TIME), GAIN_STD)
        # simulated: dg = -g dt / T + sqrt(2 / T) std dW, whose steps over any time are known exactly
        still = math.exp(-elapsed / GAIN_CORRELATION_TIME)
        at_first = rng.multivariate_normal(gaussian.gains, gaussian.covariance[6:, 6:], 200_000, method="cholesky")
        wandered = still * at_first + math.sqrt(1 - still**2) * GAIN_STD * rng.standard_normal(at_first.shape)
        assert left.gains == pytest.approx(wandered.mean(0), abs=0.02 * GAIN_STD.max())
        scale = np.outer(GAIN_STD, GAIN_STD)
        assert left.covariance[6:, 6:] / scale == pytest.approx(np.cov(wandered.T) / scale, abs=0.02)
        assert np.array_equal(left.soil, PRIOR.median)
        assert np.array_equal(
            left.covariance[:6], np.diag(np.concatenate([PRIOR.log_std**2, np.zeros(len(GAIN_STD))]))[:6]
        )
    prior = Gaussian.of(PRIOR, GAIN_STD)
    assert left.covariance == pytest.approx(prior.covariance)
    assert np.abs(left.gains / GAIN_STD).max() < 1e-12


def test_a_gain_that_is_held_stays_held():
    std = np.where(np.arange(len(GAIN_STD)) % 2, GAIN_STD, 0.0)
    gaussian = Gaussian.of(PRIOR, GAIN_STD)
    left = replace(gaussian, gains=GAIN_STD).wandered(1.0, std)
    assert (left.gains == std).all()
    assert (np.diag(left.covariance)[6:] == std**2).all()


@pytest.mark.parametrize(("first", "second", "seed"), [("wet_clay", "loam", 2), ("loam", "dry_sand", 3)])
def test_a_tractor_that_was_moved_meanwhile_is_not_drawn_to_the_old_soil(first, second, seed):
    before, after = drive(first, second, seed)
    fit, alone = first_fit(after, learned(before)), first_fit(after, None)
    off, off_alone = errors(fit.posterior, SOILS[second]), errors(alone.posterior, SOILS[second])
    assert np.abs(off).max() < 3.0
    assert np.abs(off - off_alone).max() < 1.0
    assert width_of_tan_phi(fit) < width_of_tan_phi(alone)
    assert (gain_widths(fit) < gain_widths(alone)).all()


def test_known_gains_make_the_first_window_surer():
    narrower = []
    for seed in (5, 6, 8):
        before, after = drive("loam", "wet_clay", seed)
        fit, alone = first_fit(after, learned(before), 600.0), first_fit(after, None)
        assert np.abs(errors(fit.posterior, SOILS["wet_clay"])).max() < 3.0
        assert gain_widths(fit).sum() < 0.85 * gain_widths(alone).sum()
        assert not np.array_equal(fit.gains, alone.gains)
        narrower.append(width_of_tan_phi(fit) / width_of_tan_phi(alone))
    assert max(narrower) < 1.0
    assert np.mean(narrower) < 0.97


def test_gains_that_the_data_speak_against_are_forgotten(onto_clay):
    gaussian, _ = onto_clay
    for seed in (6, 7):  # the simulator draws other gains for each recording: the sensors were all exchanged
        _, of_other_sensors = drive("loam", "dry_sand", seed)
        fit, alone = first_fit(of_other_sensors, gaussian, 600.0), first_fit(of_other_sensors, None)
        assert np.array_equal(fit.mode.soil, alone.mode.soil)
        assert np.array_equal(fit.mode.covariance, alone.mode.covariance)


def test_after_years_nothing_is_left(onto_clay):
    gaussian, after = onto_clay
    fit, alone = first_fit(after, gaussian, 1e9), first_fit(after, None)
    assert fit.mode.soil == pytest.approx(alone.mode.soil, rel=1e-6)
