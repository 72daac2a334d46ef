"""The present demand: what sensors say of draft and slope, and how well they say it."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from soilbus.decision.demand import present_demand
from soilbus.estimation.assembly import rig_of
from soilbus.estimation.instrumentation import completed
from soilbus.estimation.posterior import Estimate
from soilbus.estimation.window import steady
from soilbus.sensors.bins import Bins
from soilbus.simulator.reference import REFERENCES, reference_configuration
from soilbus.terra.vehicle import GRAVITY

RIG = rig_of(reference_configuration())
WEIGHT = RIG.chassis.mass * GRAVITY
T = np.arange(0.0, 10.0, 0.02)


def window_of(draft, pitch):
    store = Bins(RIG, 0.1, 0.0)
    store.add({"draft": (T, draft), **({} if pitch is None else {"pitch": (T, pitch)})})
    return store.window(0.0, 10.0)


def demand_of(draft, pitch):
    return present_demand(window_of(draft, pitch), RIG.chassis, 1.0)


def test_the_std_is_that_of_the_sensors_however_the_draft_swings():
    rng = np.random.default_rng(4)
    swing, slope = 3000.0 + 1500.0 * np.sin(0.7 * T), np.full(len(T), 0.04)
    truth = demand_of(swing, slope)
    noisy = [
        demand_of(swing + 40.0 * rng.standard_normal(len(T)), slope + 0.002 * rng.standard_normal(len(T)))
        for _ in range(200)
    ]
    pulls = np.array([d.pull for d in noisy])
    assert pulls.mean() == pytest.approx(truth.pull, abs=4.0 * pulls.std() / len(pulls) ** 0.5)
    assert np.mean([d.std for d in noisy]) == pytest.approx(pulls.std(), rel=0.2)  # sampling: 5 %
    assert truth.sine == pytest.approx(np.sin(0.04), rel=1e-6)


def test_a_load_cell_that_reads_too_much_asks_for_less_and_less_surely():
    slope = np.full(len(T), 0.04)
    window = window_of(np.full(len(T), 3060.0), slope)
    demand = present_demand(window, RIG.chassis, 1.0, Estimate(0.02, 0.005))
    assert demand.pull == pytest.approx(3000.0 + WEIGHT * np.sin(0.04), rel=1e-6)
    alone = demand_of(np.full(len(T), 3060.0), slope)
    assert demand.std**2 - alone.std**2 == pytest.approx(15.0**2)


def test_the_last_hop_counts_where_it_asks_for_more_and_else_the_whole_window():
    rising = demand_of(1000.0 + 100.0 * T, None)
    assert rising.pull == pytest.approx(1000.0 + 100.0 * T[T >= 9.0].mean(), abs=2.0)
    lifted = demand_of(np.where(T < 9.0, 4000.0, 0.0), None)
    assert lifted.pull == pytest.approx(3600.0, abs=10.0)


def test_an_unknown_slope_counts_as_level_and_an_unknown_draft_as_no_demand():
    level = demand_of(np.full(len(T), 2000.0), None)
    assert (level.pull, level.sine) == (pytest.approx(2000.0), 0.0)
    assert 0.0 < level.std < 20.0
    climbing = demand_of(np.full(len(T), 2000.0), np.full(len(T), 0.1))
    assert climbing.pull == pytest.approx(2000.0 + WEIGHT * np.sin(0.1), rel=1e-6)
    window = window_of(np.full(len(T), 2000.0), None)
    gone = dataclasses.replace(window, draft=np.where(window.t > 8.9, np.nan, window.draft))
    assert present_demand(gone, RIG.chassis, 1.0) is None
    assert present_demand(window, None, 1.0) is None


@pytest.mark.parametrize(
    "has_sample",
    [T % 0.5 < 0.12, (T % 0.5 < 0.12) & (T < 8.0), np.random.default_rng(3).random(len(T)) < 0.1],
    ids=["gaps", "silent for the last 2 s", "one in ten"],
)
def test_a_slope_does_not_end_where_its_sensor_has_no_sample(has_sample):
    slope = np.full(len(T), 0.12)
    store = Bins(RIG, 0.04, 0.0)
    store.add({"draft": (T, np.full(len(T), 2000.0)), "pitch": (T[has_sample], slope[has_sample])})
    demand = present_demand(steady(store.window(0.0, 10.0)), RIG.chassis, 1.0)
    assert demand.pull == pytest.approx(2000.0 + WEIGHT * np.sin(0.12), rel=1e-6)
    assert demand.sine == pytest.approx(np.sin(0.12), rel=1e-6)
    backward = replace(store.window(0.0, 10.0), direction=np.full(250, -1.0))
    assert present_demand(steady(backward), RIG.chassis, 1.0).pull == pytest.approx(demand.pull)


@pytest.mark.parametrize("rate", [0.0, 0.2, -0.2])
def test_a_specific_force_shows_the_slope_whether_the_vehicle_speeds_up_or_not(rate):
    rig = rig_of(reference_configuration(path=REFERENCES["tractor-axles"]))
    rng, slope = np.random.default_rng(6), GRAVITY * np.sin(0.08)
    store = Bins(rig, 0.1, 0.0)
    store.add({
        "draft": (T, np.full(len(T), 2000.0)),
        "acceleration": (T, rate + slope + 0.02 * rng.standard_normal(len(T))),
        "ground_speed": (T, 3.0 + rate * T + 0.01 * rng.standard_normal(len(T))),
    })  # fmt: skip
    demand = present_demand(completed(store.window(0.0, 10.0), rig), rig.chassis, 1.0)
    assert demand.sine == pytest.approx(np.sin(0.08), abs=0.003)
    assert demand.pull == pytest.approx(2000.0 + rig.chassis.mass * slope, abs=4.0 * demand.std)
    assert demand.std < 0.005 * rig.chassis.mass * GRAVITY
