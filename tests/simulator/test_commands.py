"""The simulated tractor is driven: by commands on the bus, by the line, step by step."""

import threading

import can
import cantools
import numpy as np
import pyarrow.csv
import pyarrow.parquet
import pytest

from balances import missing_pull
from fakes import message_of
from soilbus.can.publish import Publisher
from soilbus.cli.main import main
from soilbus.config.file import shipped_dbc
from soilbus.estimation.assembly import with_effects
from soilbus.simulator.commands import Commands
from soilbus.simulator.drive import Command, Drive, drive, joined, steps
from soilbus.simulator.frames import frames
from soilbus.simulator.live import drive_live, driven_frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing, demo
from soilbus.simulator.sensors import Instruments, measure

CONFIG = reference_configuration()
PULLING = Scenario(12.0, (Patch(0.0, "loam"),), Swing(1.4, 1.4), draft=Swing(1000.0, 1000.0), lift_slip=None)


@pytest.fixture
def publisher() -> Publisher:
    return Publisher(cantools.database.load_file(shipped_dbc("tractor.dbc")))


def command_frame(publisher, name="DriveCommand", **values) -> can.Message:
    return message_of(publisher.frame(name, values))


def test_frames_in_steps_are_the_frames_at_once():
    """Up to noise that refers to a mean over a window, whose later half a step does not know."""
    noise = {name: {"of_mean": 0.0, "absolute": 1.0} for name in ("torque", "load", "draft")}
    overrides = [f"noise.{name}.{key}={value}" for name, of in noise.items() for key, value in of.items()]
    config, scenario = reference_configuration(overrides), demo(6.0)
    at_once = list(frames(simulate(config, scenario, 3), config))
    in_steps = [m for _, step in driven_frames(config, scenario, 3, lambda t: Command()) for m in step]
    assert [m.timestamp for m in in_steps] == [m.timestamp for m in at_once]
    different = sum(a.data != b.data for a, b in zip(at_once, in_steps, strict=True))
    assert different < 0.001 * len(at_once)  # a solution that differs by 1e-10 may be rounded the other way


def test_a_lagged_sensor_reads_the_same_in_steps():
    config = with_effects(reference_configuration(["noise.torque={absolute=1.0}"]), ["torque_lag.delay=0.3"])
    parts = list(steps(config, demo(6.0), 3))
    instruments = Instruments(config, 5)
    pieces = [instruments.measure(part)["torque.RL"] for part in parts]
    whole = measure(joined(parts), config, 5)["torque.RL"]
    assert np.concatenate([piece.t for piece in pieces]) == pytest.approx(whole.t)
    assert np.concatenate([piece.value for piece in pieces]) == pytest.approx(whole.value, rel=1e-6)


def test_draft_and_speed_follow_the_commands_and_the_balance_holds():
    def commanded(t: float) -> Command:
        return Command(draft=3000.0, speed=0.4) if 2.0 <= t < 7.0 else Command()

    columns = joined(list(steps(CONFIG, PULLING, 1, commanded=commanded))).columns
    t, draft, speed = columns["t"], columns["draft"], columns["ground_speed"]
    told = (t >= 2.0) & (t < 7.0 - 1e-9)
    assert draft[told] == pytest.approx(3000.0)
    assert draft[~told] == pytest.approx(1000.0)
    assert speed[(t > 4.5) & told] == pytest.approx(0.4)
    assert speed[(t < 2.0) | (t > 9.5)] == pytest.approx(1.4)
    assert np.abs(columns["acceleration"]).max() <= 0.5 + 1e-9
    assert np.diff(columns["distance"]) == pytest.approx((speed[1:] + speed[:-1]) / 2.0 / 50.0, abs=1e-4)
    assert np.abs(missing_pull(CONFIG, columns)).max() < 1e-9


def test_what_the_ground_cannot_give_slows_the_vehicle_down_until_it_is_stuck():
    done = joined(list(steps(CONFIG, PULLING, 1, commanded=lambda t: Command(draft=11000.0 if t > 1.0 else None))))
    columns = done.columns
    assert 1.0 < done.bogged_at < 6.0
    assert columns["ground_speed"][-1] < 0.3
    assert columns["slip.RL"][-1] > 0.9
    assert np.abs(missing_pull(CONFIG, columns)).max() < 1e-9


def test_whoever_eases_the_draft_in_time_gets_going_again():
    def commanded(t: float) -> Command:
        return Command(draft=9000.0 if 1.0 < t < 2.0 else 1000.0)

    done = joined(list(steps(CONFIG, PULLING, 1, commanded=commanded)))
    speed = done.columns["ground_speed"]
    assert done.bogged_at is None
    assert speed.min() < 1.3
    assert speed[-1] == pytest.approx(1.4)


def test_a_torque_limit_bounds_the_wheels_and_is_reported():
    limit = {wheel.name: 700.0 for wheel in CONFIG.wheel}
    scenario = Scenario(3.0, (Patch(0.0, "loam"),), Swing(1.4, 1.4), slip=Swing(0.3, 0.3), slip_spread=0.0)
    free, bound = (
        joined(list(steps(CONFIG, scenario, 1, commanded=lambda t, of=of: Command(torque_limit=of)))).columns
        for of in ({}, limit)
    )
    assert max(free[f"torque.{name}"].max() for name in limit) > 1000.0
    for name in limit:
        assert bound[f"torque.{name}"].max() <= 700.0 * (1.0 + 1e-6)
        assert set(bound[f"torque_limit.{name}"]) == {700.0}
    assert bound["slip.RL"].max() < free["slip.RL"].min()


def test_commands_hold_for_a_second_and_then_the_line_does(publisher):
    commands = Commands(CONFIG)
    assert commands.at(0.0) == Command()
    assert commands.take(command_frame(publisher, Draft=2500.0, Speed=1.2), 10.0)
    assert commands.at(10.9) == Command(draft=2500.0, speed=1.2)
    assert commands.at(11.1) == Command()
    assert commands.take(command_frame(publisher, Draft=2600.0), 12.0)  # speed not available: not commanded
    assert commands.at(12.0) == Command(draft=2600.0)
    assert commands.take(command_frame(publisher, "TorqueLimitCommand", LimitRL=50.0), 12.5)
    gear = next(wheel.gear_ratio for wheel in CONFIG.wheel if wheel.name == "RL")
    assert commands.at(12.9) == Command(draft=2600.0, torque_limit={"RL": 50.0 * gear})


def test_a_command_with_a_wrong_checksum_or_a_halted_counter_is_none(publisher):
    commands, good = Commands(CONFIG), command_frame(publisher, Draft=2500.0)
    broken = command_frame(publisher, Draft=2600.0)
    broken.data[0] ^= 1
    assert not commands.take(broken, 0.0)
    assert commands.take(good, 0.0)
    assert not commands.take(good, 0.9)
    assert commands.at(1.5) == Command()
    short = can.Message(arbitration_id=good.arbitration_id, data=good.data[:7])
    other = can.Message(arbitration_id=good.arbitration_id + 0x100000, data=good.data)
    assert not any(commands.take(frame, 2.0) for frame in (short, other))


def test_on_a_busy_bus_in_real_time_the_commands_are_heard(publisher):
    config = reference_configuration(["bus.interface=virtual", "bus.channel=commanded"])
    scenario = Scenario(2.4, (Patch(0.0, "loam"),), Swing(1.4, 1.4), draft=Swing(500.0, 500.0), lift_slip=None)
    driven: list[Drive] = []
    with can.Bus(interface="virtual", channel="commanded") as control:
        tractor = threading.Thread(target=drive_live, args=(config, scenario, 1, driven))
        tractor.start()
        heard = 0
        while tractor.is_alive():
            heard += control.recv(0.02) is not None
            for identifier in range(0x100, 0x110):  # more than one frame between two commands
                control.send(can.Message(arbitration_id=identifier, is_extended_id=False))
            if heard > 200 and heard % 20 == 0:
                control.send(command_frame(publisher, Draft=1500.0))
        tractor.join()
    draft = joined(driven).columns["draft"]
    assert draft[0] == pytest.approx(500.0)
    assert draft[-1] == pytest.approx(1500.0)
    assert heard > 500


def test_the_same_vehicle_has_the_same_gains_in_other_drives():
    noise = ["noise.draft.gain=0.05", "noise.draft.absolute=1e-6", "noise.draft.relative=0", "noise.draft.of_mean=0"]
    config = reference_configuration([*noise, "vehicle.mass={value=2300.0,std=100.0}"])

    def gain_and_mass(seed: int, vehicle: int) -> tuple[float, float]:
        scenario = Scenario(2.0, (Patch(0.0, "loam"),), draft=Swing(2e3, 2e3), drawn_mass=True, vehicle_seed=vehicle)
        done, measured = drive(config, scenario, seed), simulate(config, scenario, seed)
        return float(measured.channels["draft"].value[0] / done.columns["draft"][0]), done.chassis.mass

    one, again, other = gain_and_mass(1, 7), gain_and_mass(2, 7), gain_and_mass(1, 8)
    assert one == pytest.approx(again, rel=1e-6)
    assert abs(one[0] - other[0]) > 1e-4
    assert abs(one[1] - other[1]) > 1.0


def test_the_true_values_are_a_table_that_others_read(tmp_path):
    arguments = ["simulate", "--draft", "1500", "--slope", "5", "--speed", "1.2", "--duration", "3", "--log"]
    for name in ("truth.csv", "truth.parquet"):
        assert main([*arguments, str(tmp_path / "drive.log"), "--truth", str(tmp_path / name)]) == 0
    table = pyarrow.csv.read_csv(tmp_path / "truth.csv")
    assert table.column_names == pyarrow.parquet.read_table(tmp_path / "truth.parquet").column_names
    columns = {name: np.array(table[name]) for name in table.column_names}
    assert len(columns["t"]) == 150
    assert np.diff(columns["t"]) == pytest.approx(0.02, abs=1e-6)
    assert columns["t"][0] == pytest.approx(next(iter(can.LogReader(tmp_path / "drive.log"))).timestamp, abs=0.02)
    assert np.tan(columns["pitch"]) == pytest.approx(0.05)
    assert columns["ground_speed"] == pytest.approx(1.2)
    assert columns["draft"] == pytest.approx(1500.0)
    assert set(columns["soil"]) == {"loam"}
    assert columns["speed.RL"] * 0.62 * (1.0 - columns["slip.RL"]) == pytest.approx(1.2)
