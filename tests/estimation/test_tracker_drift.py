"""Soil and gains drift while nothing measures them: an hour at the road leaves little of their posterior."""

from __future__ import annotations

from dataclasses import replace

import pytest

from soilbus.estimation.assembly import rig_of
from soilbus.estimation.measurements import gain_names
from soilbus.estimation.multistart import Fit
from soilbus.estimation.window import Window
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing, excited
from tests.lab.driven_windows import B_REF, Z_REF, tracker_of, windows

CONFIG = reference_configuration(["estimator.hop=10.0"])
LENGTH = CONFIG.estimator.window
N_GAINS = len(gain_names(rig_of(CONFIG)))


@pytest.fixture(scope="module")
def rich() -> list[tuple[Window, float]]:
    """Four windows that determine the soil well."""
    return list(windows(CONFIG, simulate(CONFIG, excited("loam", 40.0), 1)))


@pytest.fixture(scope="module")
def little() -> Window:
    """A second and a half of steady pulling, which tells friction to 8 % only."""
    scenario = Scenario(LENGTH, (Patch(0.0, "loam"),), Swing(1.3, 1.3), draft=Swing(2500.0, 2500.0))
    window = next(windows(CONFIG, simulate(CONFIG, scenario, 2)))[0]
    return window.rows((window.t > LENGTH - 1.5).nonzero()[0])


def after(pause: float, rich, little: Window) -> Fit:
    """Fit of the little window, `pause` seconds after the informative ones."""
    tracker, end = tracker_of(CONFIG), 0.0
    for window, end in rich:
        tracker.estimate(window, end)
    end += pause + LENGTH
    tracked = tracker.estimate(replace(little, t=little.t + (end - LENGTH)), end)
    assert not tracked.mismatch
    return tracked.fit


def spreads(fit: Fit) -> tuple[float, float]:
    """Relative std of bearing pressure and tan phi."""
    found = fit.reported.posterior.bearing_pressure(Z_REF, B_REF), fit.reported.posterior.tan_phi()
    return found[0].std / found[0].value, found[1].std / found[1].value


def gain_stds(fit: Fit) -> list[float]:
    return [fit.reported.gain(i).std for i in range(N_GAINS)]


def test_the_soil_of_an_hour_ago_is_no_more_than_another_soil(rich, little):
    alone, soon, late = (spreads(after(*given, little)) for given in ((0.0, []), (60.0, rich), (3600.0, rich)))
    assert soon[1] < 0.5 * alone[1]
    assert late[1] > 0.6 * alone[1]
    assert late[0] > 0.85 * alone[0]


def test_gains_are_known_for_minutes_and_not_for_ever(rich, little):
    alone, soon, late = (gain_stds(after(*given, little)) for given in ((0.0, []), (60.0, rich), (900.0, rich)))
    assert sum(soon) < 0.8 * sum(alone)
    assert sum(late) > 0.9 * sum(alone)
