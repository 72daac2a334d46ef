"""The truth of a drive obeys mechanics, soil and driver at every instant."""

import math

import numpy as np
import pytest

from adaptive import adaptive_forces
from balances import assert_loads_carry_the_weight, missing_pull
from soilbus.config.file import load_config
from soilbus.simulator.drive import SimulationError, drive
from soilbus.simulator.reference import TRACTOR
from soilbus.simulator.scenario import Patch, Scenario, Swing, demo, excited
from soilbus.terra.soils import SOILS, soil_named
from soilbus.terra.wheel import Soil, WheelModel, state_on

WHEELS = {"FL": (0.50, 0.26), "FR": (0.50, 0.26), "RL": (0.62, 0.38), "RR": (0.62, 0.38)}
HILLS = ((0.0, 0.0), (10.0, 0.08), (25.0, -0.05), (60.0, 0.02))


MIRE = Soil(4e3, 130e3, 0.5, math.radians(8.0), 4e3, 0.02)
"""Too soft for the tractor to move at all."""


def config(*overrides):
    return load_config(TRACTOR, overrides)


def on(soil, duration=20.0, **more):
    return Scenario(duration, (Patch(0.0, soil),), **more)


SCENARIOS = {
    "excited": excited("loam", 20.0),
    "demo": demo(20.0),
    "hills": on("sandy_loam_15", draft=Swing(500.0, 9000.0), lift_slip=Swing(0.3, 0.6), slope=HILLS),
    "skid": on("clayey_soil_38", slip=Swing(-0.1, 0.3)),
}


@pytest.fixture(scope="module", params=SCENARIOS)
def columns(request):
    return drive(config(), SCENARIOS[request.param], seed=7).columns


def test_pull_of_the_wheels_is_draft_slope_and_inertia_and_loads_balance(columns):
    assert np.abs(missing_pull(config(), columns)).max() < 4e-8
    assert_loads_carry_the_weight(config(), columns)


def test_slip_is_that_of_wheel_and_ground_speed(columns):
    for wheel, (radius, _) in WHEELS.items():
        slip = 1.0 - columns["ground_speed"] / (radius * columns[f"speed.{wheel}"])
        assert slip == pytest.approx(columns[f"slip.{wheel}"], abs=1e-12)


def test_distance_speed_and_acceleration_belong_together(columns):
    t, v = columns["t"], columns["ground_speed"]
    middle = slice(1, -1)
    assert np.gradient(v, t)[middle] == pytest.approx(columns["acceleration"][middle], abs=1e-3)
    assert np.gradient(columns["distance"], t)[middle] == pytest.approx(v[middle], abs=1e-3)
    assert columns["distance"][0] == 0.0


@pytest.mark.parametrize(("name", "soil"), [("excited", "loam"), ("hills", "sandy_loam_15")])
def test_load_pull_and_torque_are_the_integrals_over_the_rim(name, soil):
    columns = drive(config(), SCENARIOS[name], seed=7).columns
    for i in np.random.default_rng(1).integers(0, len(columns["t"]), 6):
        for wheel, (radius, width) in WHEELS.items():
            at = {q: columns[f"{q}.{wheel}"][i] for q in ("entry_angle", "slip", "load", "drawbar_pull", "torque")}
            load, pull, torque = adaptive_forces(
                state_on(soil_named(soil), at["entry_angle"], at["slip"], radius, width), WheelModel()
            )
            assert load == pytest.approx(at["load"], rel=1e-6)
            assert pull == pytest.approx(at["drawbar_pull"], abs=1e-6 * load)
            assert torque == pytest.approx(at["torque"], rel=1e-6)
            assert columns[f"sinkage.{wheel}"][i] == pytest.approx(radius * (1.0 - math.cos(at["entry_angle"])))


@pytest.mark.parametrize("soil", sorted(set(SOILS) - {"sandy_loam_32_hanamoto", "snow_us", "snow_sweden"}))
def test_prescribed_slip_is_kept_on_every_soil_up_to_the_torque_limit(soil):
    columns = drive(config(), on(soil, 10.0, slip=Swing(0.05, 0.4), slip_spread=0.0), seed=2).columns
    assert len(columns["t"]) == 500
    torque = np.max([columns[f"torque.{wheel}"] for wheel in WHEELS], axis=0)
    free = torque < 2400.0 * (1.0 - 1e-9)
    slip = columns["slip.FL"]
    assert np.all(torque <= 2400.0 * (1.0 + 1e-9))
    assert np.all((slip[free] >= 0.05) & (slip[free] <= 0.4))
    assert np.all(slip <= 0.4)
    if free.any():
        assert np.isnan(columns["demand"]).all()
        assert slip[free] == pytest.approx(columns["slip.RR"][free], abs=1e-12)


def test_driver_meets_the_demand_or_is_at_the_slip_limit():
    scenario = on("loam", 30.0, draft=Swing(3000.0, 7000.0), lift_slip=Swing(0.3, 0.3), slip_spread=0.0)
    columns = drive(config(), scenario, seed=4).columns
    met = np.isclose(columns["draft"], columns["demand"], rtol=1e-9)
    assert 0.1 < met.mean() < 0.9
    assert np.all(columns["slip.FL"][met] <= 0.3 + 1e-9)
    assert columns["slip.FL"][~met] == pytest.approx(0.3, abs=1e-9)
    assert np.all(columns["draft"][~met] < columns["demand"][~met])


def test_implement_is_up_before_the_driver_gives_in_to_slip():
    climb = on("loam", 30.0, draft=Swing(500.0, 600.0), slope=((0.0, 0.0), (5.0, 0.28)), lift_slip=Swing(0.3, 0.3))
    columns = drive(config(), climb, seed=1).columns
    beyond = columns["slip.FL"] > 0.35
    assert beyond.any()
    assert columns["draft"][beyond] == pytest.approx(0.0, abs=1e-6)
    assert columns["draft"].min() > -1e-6


def test_rear_wheels_reach_the_next_soil_a_wheelbase_later():
    soils = (Patch(0.0, "loam"), Patch(15.0, "clayey_soil_38"))
    flat = {"speed": Swing(1.5, 1.5), "side_shift": Swing(0.0, 0.0), "slip_spread": 0.0, "transition": 0.01}
    columns = drive(config(), Scenario(20.0, soils, slip=Swing(0.2, 0.2), **flat), seed=0).columns
    steps = [np.argmax(np.abs(np.diff(columns[f"torque.{wheel}"]))) for wheel in ("FL", "RL")]
    assert columns["distance"][steps[0]] == pytest.approx(15.0 - 1.0, abs=0.05)
    assert columns["distance"][steps[1]] == pytest.approx(15.0 + 0.95, abs=0.05)


def test_a_tractor_that_bogs_down_ends_the_drive_there():
    soils = (Patch(0.0, "loam"), Patch(15.0, "mire", MIRE))
    done = drive(config(), Scenario(30.0, soils, draft=Swing(1000.0, 2000.0)), seed=1)
    assert done.bogged_at == pytest.approx(done.columns["t"][-1] + 0.02)
    assert 13.0 < done.columns["distance"][-1] < 18.0
    assert all(np.isfinite(done.columns[f"{q}.RL"]).all() for q in ("slip", "torque", "load", "sinkage"))


def test_what_cannot_be_driven_says_so():
    with pytest.raises(SimulationError, match="cannot drive on mire"):
        drive(config(), Scenario(5.0, (Patch(0.0, "mire", MIRE),), draft=Swing(0.0, 100.0)), seed=1)
