"""Wheels of simulated machines turn as their motors, differentials and bearings let them."""

import csv
import math
import re

import numpy as np
import pytest

from adaptive import adaptive_forces
from balances import GRAVITY, assert_loads_carry_the_weight, missing_pull, total
from soilbus.cli.main import main
from soilbus.config.file import MACHINES, load_config, parse_config
from soilbus.simulator.drive import SimulationError, drive
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import WheelModel, state_on

FOLDER = MACHINES
SOILS = ("loam", "sandy_loam_23_michigan", "north_gower_clayey_loam_46")


def machine(name, edit=None):
    config = load_config(FOLDER / f"tractor-{name}.toml")
    raw = config.model_dump(exclude={"folder"}, exclude_none=True, exclude_unset=True)
    if edit is not None:
        edit(raw)
    return parse_config(raw, folder=FOLDER)


def with_rear(**keys):
    def edit(raw):
        raw["axle"][-1] |= keys

    return edit


def one_motor(centre, **rear):
    """One motor of both axles in place of that of each axle."""

    def edit(raw):
        for axle, ratio in zip(raw["axle"], (12.0, 15.0), strict=True):
            for key in ("torque", "torque_limit", "max_torque"):
                axle.pop(key)
            axle["gear_ratio"] = ratio
        raw["axle"][1] |= rear
        torque, speed = "MotorBoth.ShaftTorque", "MotorBoth.ShaftSpeed"
        both = {"gear_ratio": 2.0, "differential": centre, "max_torque": 500.0, "torque": torque, "motor_speed": speed}
        raw["axle"].append({"name": "both", **both})

    return edit


def towing_nothing(raw):
    raw["vehicle"]["towing"] = "never"
    raw["signals"].pop("draft")
    raw["signals"] |= {
        "roll": "Inertial.Roll",
        "pitch": "Attitude.Pitch",
        "steering_angle": "DriverInputs.SteeringAngle",
    }
    raw["vehicle"]["differential_lock"] = "DriverInputs.DifferentialLock"


def on(soil="loam", duration=20.0, **more):
    return Scenario(duration, (Patch(0.0, soil),), **({"slip": Swing(0.05, 0.35)} | more))


def rim_speed(columns, wheels):
    """Mean over the wheels of 1 / (1 - slip), the speed of the rim over that of the ground."""
    return np.mean([1.0 / (1.0 - columns[f"slip.{wheel}"]) for wheel in wheels], axis=0)


MACHINES = {
    "rear drive": machine("2wd"),
    "a motor on each axle": machine("axles"),
    "locked centre": machine("axles", one_motor("locked")),
    "open centre": machine("axles", one_motor("open")),
    "limited slip": machine("axles", with_rear(differential="limited", torque_bias=0.1)),
    "towing nothing": machine("axles", towing_nothing),
}


@pytest.fixture(scope="module", params=MACHINES)
def driven(request):
    config = MACHINES[request.param]
    return config, drive(config, on(), seed=5).columns


def test_pull_and_loads_balance_on_every_machine(driven):
    assert np.abs(missing_pull(*driven)).max() < 1e-9
    assert_loads_carry_the_weight(*driven)


def test_a_free_wheel_skids_without_torque_and_resists(driven):
    config, columns = driven
    free = [wheel for wheel in config.wheel if not wheel.driven]
    for wheel in free:
        grip = columns[f"load.{wheel.name}"] * wheel.radius
        assert np.abs(columns[f"torque.{wheel.name}"] / grip).max() < 1e-9
        assert columns[f"slip.{wheel.name}"].max() < 0.0
        assert columns[f"drawbar_pull.{wheel.name}"].max() < 0.0
        for i in (3, 400, 900):
            angle, slip = columns[f"entry_angle.{wheel.name}"][i], columns[f"slip.{wheel.name}"][i]
            state = state_on(soil_named("loam"), angle, slip, wheel.radius, wheel.width)
            load, pull, torque = adaptive_forces(state, WheelModel())
            assert load == pytest.approx(columns[f"load.{wheel.name}"][i], rel=1e-4)
            assert pull == pytest.approx(columns[f"drawbar_pull.{wheel.name}"][i], abs=1e-4 * load)
            assert torque == pytest.approx(0.0, abs=1e-4 * load)
    assert len(free) in (0, 2)


@pytest.mark.parametrize("soil", SOILS)
def test_an_open_differential_gives_equal_torques_at_the_mean_speed(soil):
    slip = Swing(0.05, 0.35)
    for name, axles in (("2wd", (("RL", "RR"),)), ("axles", (("FL", "FR"), ("RL", "RR")))):
        columns = drive(machine(name), on(soil, slip=slip, slip_spread=0.0), seed=6).columns
        for left, right in axles:
            torque = columns[f"torque.{left}"], columns[f"torque.{right}"]
            assert torque[0] == pytest.approx(torque[1], rel=1e-6)
            assert np.abs(columns[f"slip.{left}"] - columns[f"slip.{right}"]).max() > 0.02  # loads differ
            common = 1.0 - 1.0 / rim_speed(columns, (left, right))
            assert common.min() > slip.low - 1e-9
            assert common.max() < slip.high + 1e-9
        if len(axles) == 2:
            assert rim_speed(columns, axles[0]) == pytest.approx(rim_speed(columns, axles[1]), rel=1e-9)


def test_the_lighter_wheel_of_an_open_differential_spins_and_of_a_locked_one_does_not():
    to_the_left = on(side_shift=Swing(0.2, 0.2))
    open_one = drive(machine("2wd"), to_the_left, seed=1).columns
    locked = drive(machine("2wd", with_rear(differential="locked")), to_the_left, seed=1).columns
    assert np.all(open_one["speed.RR"] > open_one["speed.RL"])
    assert locked["speed.RR"] == pytest.approx(locked["speed.RL"], rel=1e-12)
    assert np.all(locked["torque.RL"] > locked["torque.RR"])
    assert locked["draft"].max() > open_one["draft"].max()


@pytest.mark.parametrize("bias", [0.03, 0.1, 0.3])
def test_limited_slip_holds_speeds_together_up_to_its_bias(bias):
    config = machine("axles", with_rear(differential="limited", torque_bias=bias))
    columns = drive(config, on(duration=40.0), seed=2).columns
    left, right = columns["torque.RL"], columns["torque.RR"]
    share = np.abs(left - right) / (left + right)
    together = np.isclose(columns["speed.RL"], columns["speed.RR"], rtol=1e-8)
    assert len(share) == 2000
    assert share.max() <= bias * (1.0 + 1e-6)
    assert np.all(together | (share > bias * (1.0 - 1e-6)))
    faster = np.sign(columns["speed.RL"] - columns["speed.RR"])
    assert np.all((faster * (left - right) <= 0.0) | together)  # the slower wheel gets more
    assert together.mean() > 0.02


def test_between_the_axles_a_locked_shaft_holds_speeds_and_an_open_one_torques():
    for name, locked in (("locked centre", True), ("open centre", False)):
        columns = drive(MACHINES[name], on(slip_spread=0.01), seed=3).columns
        shaft = [ratio * (columns[f"speed.{a}"] + columns[f"speed.{b}"]) / 2.0
                 for ratio, a, b in ((12.0, "FL", "FR"), (15.0, "RL", "RR"))]  # fmt: skip
        torque = [total(columns, "torque", ("FL", "FR")) / 12.0, total(columns, "torque", ("RL", "RR")) / 15.0]
        assert bool(np.abs(shaft[0] / shaft[1] - 1.0).max() < 1e-8) is locked
        assert bool(np.abs(torque[0] - torque[1]).max() < 1e-6 * torque[1].max()) is not locked


def test_the_limit_of_an_axle_and_of_both_axles_limits_the_draft():
    hard = on("heavy_clay_25", slip=None, draft=Swing(2000.0, 30000.0), lift_slip=Swing(0.4, 0.4))
    rear = drive(machine("2wd", with_rear(max_torque=7000.0)), hard, seed=4).columns
    limited = rear["draft"] < rear["demand"] - 1.0
    assert limited.any()
    assert not limited.all()
    assert total(rear, "torque", ("RL", "RR"))[limited] == pytest.approx(7000.0, rel=1e-8)
    both = drive(MACHINES["locked centre"], hard, seed=4).columns
    shaft = total(both, "torque", ("FL", "FR")) / 12.0 + total(both, "torque", ("RL", "RR")) / 15.0
    assert shaft.max() == pytest.approx(500.0, rel=1e-8)


def test_a_machine_that_tows_nothing_climbs_what_its_slip_takes_or_drives_the_slopes_given():
    config = MACHINES["towing nothing"]
    columns = drive(config, on(slip=Swing(0.1, 0.3), slip_spread=0.0), seed=5).columns
    assert np.all(columns["draft"] == 0.0)
    assert np.ptp(columns["pitch"]) > 0.02
    hills = on(slip=None, slope=((0.0, 0.0), (8.0, 0.12), (20.0, -0.1)), speed=Swing(0.8, 2.0))
    columns = drive(config, hills, seed=5).columns
    assert np.abs(columns["draft"]).max() < 1e-5
    assert columns["pitch"].max() == pytest.approx(0.12, abs=2e-3)
    assert np.ptp(columns["slip.RL"]) > 0.03


def test_towing_what_is_never_towed_is_refused_in_one_line():
    for more in ({"draft": Swing(0.0, 100.0), "slip": None}, {"slope": ((0.0, 0.0), (9.0, 0.1))}):
        with pytest.raises(SimulationError, match=r"^vehicle.towing = never[^\n]+$"):
            drive(MACHINES["towing nothing"], on(**more), seed=1)


@pytest.fixture
def never_towing(tmp_path):
    """The configuration of the machine with axle motors, which tows nothing."""
    text = re.sub(r"\[signals\.draft\]\n(?:.+\n)+", "", (FOLDER / "tractor-axles.toml").read_text())
    (tmp_path / "c.toml").write_text(text.replace("[vehicle]", '[vehicle]\ntowing = "never"'))
    return str(tmp_path / "c.toml")


def test_decisions_about_drafts_are_not_tried_where_nothing_is_towed(never_towing, capsys):
    assert main(["decisions", "--config", never_towing]) == 2
    assert "this vehicle never has" in capsys.readouterr().err


def test_a_machine_that_tows_nothing_drives_up_a_slope_that_is_given(never_towing, tmp_path):
    command = ["simulate", "--config", never_towing, "--slope", "12", "--duration", "3"]
    assert main([*command, "--log", str(tmp_path / "x.log"), "--truth", str(tmp_path / "x.csv")]) == 0
    with (tmp_path / "x.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["pitch"]) for row in rows] == pytest.approx([math.atan(0.12)] * len(rows))
    assert min(float(row["slip.RL"]) for row in rows) > 0.05


def test_mass_and_centre_of_gravity_are_as_configured_or_drawn_about_that():
    config = machine("2wd")
    exact = drive(config, on(duration=1.0), seed=1).columns
    assert total(exact, "load")[0] == pytest.approx(4000.0 * GRAVITY, rel=1e-9)
    drawn = [drive(config, on(duration=0.1, drawn_mass=True), seed).columns for seed in range(60)]
    mass = np.array([total(columns, "load")[0] / GRAVITY for columns in drawn])
    assert mass.mean() == pytest.approx(4000.0, abs=4 * 80.0 / math.sqrt(60))
    assert mass.std() == pytest.approx(80.0, rel=0.4)
    known = machine("2wd", lambda raw: raw["vehicle"].update(mass=4000.0, mass_std=0.0, cg_std=0.0))
    same = drive(known, on(duration=1.0, drawn_mass=True), seed=1).columns
    assert np.array_equal(same["load.RL"], exact["load.RL"])


def close_to(column, truth, scale, samples=6.0):
    """Whether a column is the truth but for a gain error and noise of a few per cent of the scale."""
    return np.abs(column.value - truth[:: round(len(truth) / len(column.value))]).max() < samples * 0.01 * scale


@pytest.mark.parametrize("name", ["2wd", "axles"])
def test_sensors_of_an_axle_read_sums_of_torque_and_load_and_means_of_speed(name):
    config = machine(name)
    recording = simulate(config, on(), seed=8)
    truth, channels = recording.truth, recording.channels
    for axle in config.axle:
        wheels = [wheel.name for wheel in config.wheel if wheel.axle == axle.name]
        torque = total(truth, "torque", wheels)
        assert close_to(channels[f"torque.{axle.name}"], torque, np.abs(torque).mean())
        assert np.all(channels[f"torque_limit.{axle.name}"].value == axle.max_torque)
        if axle.motor_speed is not None:
            speed = total(truth, "speed", wheels) / 2.0
            assert close_to(channels[f"speed.{axle.name}"], speed, speed.mean(), 2.0)
        if axle.load is not None:
            assert close_to(channels[f"load.{axle.name}"], total(truth, "load", wheels), 20000.0)
    assert sum(1 for _ in frames(recording, config)) > 20 * 50 * 5


def test_a_motor_of_both_axles_reads_the_torque_and_speed_of_its_shaft():
    recording = simulate(MACHINES["locked centre"], on(), seed=8)
    truth, channels = recording.truth, recording.channels
    torque = total(truth, "torque", ("FL", "FR")) / 12.0 + total(truth, "torque", ("RL", "RR")) / 15.0
    assert close_to(channels["torque.both"], torque, torque.mean())
    speed = 15.0 * (truth["speed.RL"] + truth["speed.RR"]) / 2.0
    assert close_to(channels["speed.both"], speed, speed.mean(), 2.0)


def test_one_signal_of_several_wheels_is_one_channel_and_their_mean():
    def in_pairs(raw):
        for wheel in raw["wheel"][:2]:
            wheel |= {"load": "AxleLoads.Front", "speed": "WheelSpeeds.FL"}

    config = machine("axles", in_pairs)
    recording = simulate(config, on(), seed=8)
    truth, channels = recording.truth, recording.channels
    assert {"load.FL", "speed.FL"} <= set(channels)
    assert not {"load.FR", "speed.FR"} & set(channels)
    assert truth["speed.FL"] == pytest.approx(truth["speed.FR"], rel=1e-12)  # one signal of speed: one shaft
    load = (truth["load.FL"] + truth["load.FR"]) / 2.0
    assert close_to(channels["load.FL"], load, load.mean(), 12.0)


def test_inertial_sensors_feel_the_slope_and_the_side_slope():
    config = MACHINES["towing nothing"]
    recording = simulate(config, on(slip=Swing(0.1, 0.3)), seed=8)
    truth, channels = recording.truth, recording.channels
    felt = truth["acceleration"] + GRAVITY * np.sin(truth["pitch"])
    assert np.abs(channels["acceleration"].value - felt).max() < 6.0 * config.noise.acceleration.absolute
    vehicle = config.vehicle
    across = vehicle.track / (2.0 * vehicle.cg_height)
    left_less_right = (truth["load.RL"] - truth["load.RR"]) / (truth["load.RL"] + truth["load.RR"])
    assert np.sin(truth["roll"]) == pytest.approx(-left_less_right * across, rel=1e-9)
    assert np.abs(channels["roll"].value - truth["roll"]).max() < 6.0 * config.noise.roll.absolute
    assert np.all(channels["differential_lock"].value == 0.0)
    assert np.abs(channels["steering_angle"].value).max() < 6.0 * config.noise.steering_angle.absolute


def test_a_current_carries_its_torque(tmp_path):
    dbc = 'VERSION ""\nBU_: A\nBO_ 256 Inverter: 8 A\n SG_ Current : 7|16@0- (0.02,0) [-655|655] "A" A\n'
    (tmp_path / "inverter.dbc").write_text(dbc, encoding="utf-8")
    raw = load_config(FOLDER / "tractor-2wd.toml").model_dump(exclude={"folder"}, exclude_none=True, exclude_unset=True)
    raw["dbc"]["input"].append("inverter.dbc")
    raw["axle"][0]["torque"] = {"signal": "Inverter.Current", "torque_constant": 1.5}
    config = parse_config(raw, folder=tmp_path)
    recording = simulate(config, on(duration=2.0), seed=1)
    sent = [m for m in frames(recording, config) if m.arbitration_id == 256]
    current = np.array([int.from_bytes(m.data[:2], "big", signed=True) for m in sent]) * 0.02
    assert current * 1.5 * 24.0 == pytest.approx(
        recording.channels["torque.rear"].value, abs=0.5 * 0.02 * 1.5 * 24.0 + 1e-6
    )
