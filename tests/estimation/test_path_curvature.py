"""On a curve the wheels of the two sides have ground speeds of their own: one more unknown of a window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soilbus.estimation.assembly import rig_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.path_curvature import curvature_of, rim_difference, sides, with_curvature
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS
from tests.lab.curved_drives import TRACK, curved, driven
from tests.lab.driven_windows import errors, tracker_of, windows


@pytest.mark.parametrize("radius", [75.0, 25.0, -40.0])
def test_a_curve_changes_neither_the_soil_nor_how_sure_of_it_a_window_is(radius):
    config = reference_configuration()
    rig, scenario = rig_of(config), Scenario(14.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.40))
    straight, bent = tracker_of(config), tracker_of(config)
    for window, end in windows(config, simulate(config, scenario, 1)):
        expected, output = straight.estimate(window, end), bent.estimate(curved(window, rig, 1.0 / radius), end)
        assert not output.mismatch
        of_curve, of_line = (errors(r.fit.posterior, SOILS["loam"]) for r in (output, expected))
        assert of_curve == pytest.approx(of_line, abs=0.3)
        std = [r.fit.posterior.tan_phi().std for r in (output, expected)]
        assert std[0] == pytest.approx(std[1], rel=0.1)
        gains = output.fit.gains[[i for i, name in enumerate(_names(bent, window)) if name.startswith("speed")]]
        assert gains @ sides(rig) / 4.0 == pytest.approx(TRACK / (2.0 * radius), abs=0.004)


def _names(tracker, window):
    return tracker._problem(window).gain_names


def test_without_that_unknown_a_curve_is_a_mismatch(monkeypatch):
    monkeypatch.setattr("soilbus.estimation.tracker.with_curvature", lambda gaussian, curve: gaussian)
    monkeypatch.setattr("soilbus.estimation.tracker.detected_curvature", lambda objective, fit: None)
    config = reference_configuration()
    scenario = Scenario(11.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.40))
    window, end = next(windows(config, simulate(config, scenario, 1)))
    assert tracker_of(config).estimate(curved(window, rig_of(config), 1.0 / 25.0), end).mismatch


@pytest.mark.parametrize("seed", [100])
def test_a_curve_that_begins_within_a_window_is_no_soil(seed, monkeypatch):
    config = reference_configuration([f"model.form.{name}=0" for name in ("peak", "peak_by_slip", "exit", "shear")])

    def away() -> np.ndarray:
        output = [w for w in driven(config, "loam", 75.0, seed, duration=19.0) if w.t > 0.0]
        assert all(w.valid for w in output)
        return np.array([w.away for w in output])

    assert np.abs(away()).max() < 3.0
    monkeypatch.setattr("soilbus.estimation.tracker.detected_curvature", lambda objective, fit: None)
    assert np.abs(away()[:, 1]).max() > 3.0


def test_straight_ahead_no_curve_is_seen():
    config = reference_configuration()
    tracker, scenario = tracker_of(config), Scenario(16.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.40))
    for window, end in windows(config, simulate(config, scenario, 2)):
        assert not tracker.estimate(window, end).fit.curved_path


def test_only_differences_between_the_sides_are_freed_and_by_as_much_as_the_rims_differ(simulated):
    case = simulated(SOILS["loam"], 3)
    problem = case.problem(curved(case.window, case.rig, 1.0 / 50.0))
    assert rim_difference(problem) == pytest.approx(TRACK / 100.0, abs=0.007)
    before = Gaussian.of(case.prior, problem.gain_std)
    added = with_curvature(before, curvature_of(problem)).covariance - before.covariance
    speeds = [6 + problem.gain_names.index(f"speed.{wheel}") for wheel in case.rig.wheels]
    assert np.flatnonzero(added.any(axis=0)).tolist() == speeds
    of_speeds = added[np.ix_(speeds, speeds)]
    assert np.linalg.matrix_rank(of_speeds) == 1
    assert of_speeds @ np.ones(4) == pytest.approx(np.zeros(4), abs=1e-18)


def test_an_axle_with_one_wheel_has_no_sides(simulated):
    rig = simulated(SOILS["loam"], 3).rig
    assert sides(rig).tolist() == [-1.0, 1.0, -1.0, 1.0]
    tricycle = replace(rig, wheels=rig.wheels[1:], radius=rig.radius[1:], width=rig.width[1:], front=rig.front[1:])
    assert sides(tricycle).tolist() == [0.0, -1.0, 1.0]
