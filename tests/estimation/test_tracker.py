"""The tracker on simulated drives: over a border, on one soil for minutes, with failures on the way."""

from dataclasses import replace

import numpy as np
import pytest

from driven_windows import B_REF, Z_REF, errors, task_of, tracker_of, windows
from soilbus.decision.traversability import Status
from soilbus.estimation.soil_state import TrackerState
from soilbus.estimation.tracker import TrackerOutput
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing, soil_along
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil

SPEED = 1.5


def off(tracked: TrackerOutput, soil: str) -> float:
    """Error of the bearing pressure in its standard deviations."""
    return errors(tracked.fit.posterior, SOILS[soil])[0]


SLOW_AT_THE_BORDER = {"speed": Swing(1.0, 1.8)}
GRADUAL = {"speed": Swing(SPEED, SPEED + 1e-6), "transition": 5.0}


@pytest.mark.parametrize(
    ("first", "second", "seed", "at", "how"),
    [
        ("loam", "wet_clay", 4, 22.4, SLOW_AT_THE_BORDER),
        ("loam", "dry_sand", 3, 18.0, SLOW_AT_THE_BORDER),
        ("wet_clay", "loam", 1, 18.0, GRADUAL),
    ],
)
def test_a_border_may_be_longer_than_thought(first, second, seed, at, how):
    # All of these were a mismatch until not one sample of the border was in the window any more.
    config = reference_configuration()
    scenario = Scenario(at / SPEED + 12.0, (Patch(0.0, first), Patch(at, second)), slip=Swing(0.05, 0.40), **how)
    recording = simulate(config, scenario, seed)
    # Where the front wheels meet the border and the rear ones leave it.
    border = at + np.array([-1.0, 0.95 + scenario.transition])
    reached, left = np.interp(border, recording.truth["distance"], recording.truth["t"])
    tracker = tracker_of(config)
    for window, end in windows(config, recording):
        result = tracker.estimate(window, end)
        if end < reached:
            assert result.state is TrackerState.STEADY
            assert abs(off(result, first)) < 3.5
        elif end < reached + 3.0:
            assert not result.mismatch
        elif end > left + 2.0:
            assert not result.mismatch
            assert result.state is not TrackerState.SUSPECT
            assert abs(off(result, second)) < 3.5


@pytest.mark.parametrize(
    ("first", "second", "at", "transition", "seed"),
    [
        ("loam", "wet_clay", 17.11, 1.0, 103),  # few data, and a posterior far from Gaussian: 3.4 sd off
        ("wet_clay", "dry_sand", 16.0, 15.0, 100),  # a border that seemed over: 7.7 sd
        ("dry_sand", "wet_clay", 16.0, 15.0, 100),  # 8.2 sd
    ],
)
def test_no_valid_window_near_a_border_is_wrong(first, second, at, transition, seed):
    # All of these had a valid window that far off.  Right is the soil anywhere between the axles.
    config = reference_configuration()
    patches = (Patch(0.0, first), Patch(at, second))
    scenario = Scenario(
        at + transition + 8.0, patches, Swing(1.0, 1.0 + 1e-6), slip=Swing(0.05, 0.40), transition=transition
    )
    recording = simulate(config, scenario, seed)
    estimator, between = WindowEstimator(config), np.linspace(-0.95, 1.0, 9)
    valid_after = 0
    for window, end in windows(config, recording):
        result = estimator.estimate(task_of(window, end, config, index=round(end - 10.0))).result
        place = np.interp(end, recording.truth["t"], recording.truth["distance"])
        if result.status is Status.VALID and place > at - 2.0:
            under = np.transpose(soil_along(patches, place + between, transition))
            away = [np.abs(errors(result.posterior, Soil(*map(float, soil)))).max() for soil in under]
            assert min(away) < 3.0
            valid_after += place > at + transition
    assert valid_after >= 1


def two_visits(first: str, second: str, seed: int):
    """The tracker and its results of a second drive; nothing but a window without speeds lies between the two."""
    config = reference_configuration()
    tracker = tracker_of(config)
    for soil, start in ((first, 0.0), (second, 30.0)):
        scenario = Scenario(13.0, (Patch(0.0, soil),), slip=Swing(0.05, 0.40))
        results = []
        for window, end in windows(config, simulate(config, scenario, seed)):
            results.append(tracker.estimate(replace(window, t=window.t + start), end + start))
        empty = replace(window, t=window.t + start, ground_speed=np.full(len(window.t), np.nan))
        assert tracker.estimate(empty, end + start).fit is None
    return tracker, results


@pytest.mark.parametrize("seed", [1, 2])
def test_a_soil_found_afresh_is_another_one_from_where_its_data_begin(seed):
    # No border was seen; by the prior of the loam residuals are twice, and not several times, what they were.
    tracker, results = two_visits("loam", "wet_clay", seed)
    assert [r.state for r in results] == [TrackerState.NEW_SOIL] + [TrackerState.STEADY] * (len(results) - 1)
    assert all(abs(off(r, "wet_clay")) < 3.5 for r in results)
    assert tracker.state.transition.end == pytest.approx(30.0, abs=0.2)


def test_the_same_soil_after_a_pause_is_the_same_soil():
    tracker, results = two_visits("loam", "loam", 1)
    assert {r.state for r in results} == {TrackerState.STEADY}
    assert tracker.state.transition is None
    assert all(abs(off(r, "loam")) < 3.5 for r in results)


def test_what_no_soil_explains_is_a_mismatch_and_no_new_soil():
    # From 13 s on the right rear wheel seems to pull with no torque: the other three are as they were.
    config = reference_configuration(["estimator.hop=2.0"])
    scenario = Scenario(24.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.40))
    tracker = tracker_of(config)
    for window, end in windows(config, simulate(config, scenario, 6)):
        torque = np.where((window.t > 13.0)[:, None] & (np.arange(4) == 3), 0.0, window.torque)
        result = tracker.estimate(replace(window, torque=torque), end)
        if end > 16.5:
            assert result.mismatch


def test_one_soil_for_minutes_stays_one_soil_and_the_errors_as_said():
    config = reference_configuration(["estimator.hop=2.0", "estimator.soil_drift=0.0005"])  # drift soon ends wide
    scenario = Scenario(200.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.40))
    tracker = tracker_of(config)
    results = [tracker.estimate(w, end) for w, end in windows(config, simulate(config, scenario, 1))]
    assert {r.state for r in results} == {TrackerState.STEADY}
    assert not any(r.mismatch for r in results)
    away = np.array([off(r, "loam") for r in results])
    # Gains are fixed over the drive and windows overlap: this is not many independent errors.
    assert np.sqrt(np.mean(away**2)) < 1.6
    assert np.abs(away).max() < 3.5
    # The windows before add information: the last estimates have smaller sd than the first.
    std = [r.fit.posterior.bearing_pressure(Z_REF, B_REF).std for r in results]
    assert np.median(std[-20:]) < 0.8 * np.median(std[:5])


def test_a_window_that_fails_leaves_what_is_known_alone():
    config = reference_configuration()
    scenario = Scenario(16.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.40))
    drive = list(windows(config, simulate(config, scenario, 3)))
    undisturbed, disturbed = tracker_of(config), tracker_of(config)
    nonsense = np.random.default_rng(0)
    for i, (window, end) in enumerate(drive):
        undisturbed.estimate(window, end)
        if i == 3:
            outliers = window.torque * nonsense.choice([-3.0, 3.0], window.torque.shape)
            bad = disturbed.estimate(replace(window, torque=outliers), end)
            assert bad.mismatch
            assert all(at != end for at, _ in disturbed._posteriors)
        else:
            last = disturbed.estimate(window, end)
    expected = undisturbed.estimate(*drive[-1])
    assert not last.mismatch
    assert off(last, "loam") == pytest.approx(off(expected, "loam"), abs=0.3)
    empty = replace(drive[-1][0], ground_speed=np.full(len(drive[-1][0].t), np.nan))
    assert disturbed.estimate(empty, drive[-1][1]).fit is None


def test_a_wheel_that_dies_drops_out():
    config = reference_configuration()
    scenario = Scenario(24.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.40))
    tracker = tracker_of(config)
    for window, end in windows(config, simulate(config, scenario, 4)):
        dead = window.t > 14.0
        torque = np.where(dead[:, None] & (np.arange(4) == 2), np.nan, window.torque)
        result = tracker.estimate(replace(window, torque=torque), end)
        assert not result.mismatch
        assert abs(off(result, "loam")) < 3.5
