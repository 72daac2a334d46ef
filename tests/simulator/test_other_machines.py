"""The second generator obeys its own mechanics, shakes as it says, and agrees with the first where both coincide."""

import math

import numpy as np
import pytest

import other_machines
from other_machines import STEP, WHEELS, Bekker, Cone, Rim, largest_draft, machine
from soilbus.can.channels import Column
from soilbus.estimation.assembly import chassis_of
from soilbus.estimation.window import Rig, SensorNoise
from soilbus.simulator.drivetrain import drivetrain_of
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import Recording
from soilbus.simulator.reference import AXLE_MOTORS, REAR_DRIVE, TRACTOR, reference_configuration
from soilbus.simulator.sensors import fitted
from soilbus.terra.wheel import Soil, WheelModel
from soilbus.trials.draft_trials import true_largest_draft

GRAVITY = 9.80665
MACHINES = {"four motors": TRACTOR, "rear drive": REAR_DRIVE, "axle motors": AXLE_MOTORS}
LAWS = {"bekker": Bekker(), "cone": Cone()}


@pytest.fixture(scope="module", params=[(m, law) for m in MACHINES for law in LAWS], ids="-".join)
def recording(request):
    name, law = request.param
    return other_machines.drive(machine(MACHINES[name]), LAWS[law], seed=3, duration=40.0)


def later(recording, name):
    """A column of the truth after the start."""
    return recording.truth[name][round(5.0 / STEP) :]


def test_force_moves_the_vehicle_and_weight_rests_on_the_wheels(recording):
    made = recording.machine
    pull = sum(later(recording, f"drawbar_pull.{w}") for w in WHEELS) - later(recording, "draft")
    along = made.mass * (later(recording, "acceleration") + GRAVITY * np.sin(later(recording, "pitch")))
    assert np.sqrt(np.mean((pull - along) ** 2)) < 0.005 * made.mass * GRAVITY
    speed = later(recording, "ground_speed")
    assert np.gradient(speed, STEP)[1:-1] == pytest.approx(later(recording, "acceleration")[1:-1], abs=0.5)
    weight = sum(later(recording, f"load.{w}") for w in WHEELS)
    assert weight.mean() == pytest.approx(made.mass * GRAVITY, rel=0.02)


def test_loads_shake_by_five_to_fifteen_per_cent_at_the_frequencies_of_tyres(recording):
    for wheel in WHEELS:
        load = later(recording, f"load.{wheel}")
        spectrum = np.abs(np.fft.rfft((load - load.mean()) * np.hanning(len(load)))) ** 2
        frequency = np.fft.rfftfreq(len(load), STEP)
        bounce = (frequency > 1.0) & (frequency < 4.0)
        rms = math.sqrt(spectrum[bounce].sum() / spectrum.sum()) * load.std()
        assert 0.05 < rms / load.mean() < 0.15


def test_a_free_wheel_rolls_without_torque_and_a_differential_splits_up_to_its_friction(recording):
    made = recording.machine
    for i in made.free:
        wheel = WHEELS[i]
        grip = later(recording, f"load.{wheel}") * made.radius[i]
        assert abs(np.mean(later(recording, f"torque.{wheel}") / grip)) < 0.01
        assert later(recording, f"drawbar_pull.{wheel}").mean() < 0.0
    for motor in made.motors:
        if len(motor) == 2:
            left, right = (later(recording, f"torque.{WHEELS[i]}") for i in motor)
            apart = np.sqrt(np.mean((left - right) ** 2))
            assert 0.005 < apart / np.mean(left + right) < 0.12
            speeds = [later(recording, f"speed.{WHEELS[i]}") for i in motor]
            assert np.abs(speeds[0] - speeds[1]).max() > 0.02


@pytest.mark.parametrize("name", MACHINES)
def test_a_steady_draft_beyond_the_largest_one_stops_the_machine_and_one_below_does_not(name):
    made = machine(MACHINES[name])
    most = largest_draft(made, Bekker())
    slow = {}
    for share in (0.85, 1.3):
        steady = other_machines.drive(made, Bekker(), 1, 30.0, shake=0.0, work=(share, 0.0), steepest=0.0)
        slow[share] = steady.truth["ground_speed"][-1]
        assert later(steady, "draft") == pytest.approx(share * most)
    assert slow[0.85] > 0.4
    assert slow[1.3] < 0.1


@pytest.mark.parametrize("name", ["rear drive", "axle motors"])
def test_largest_draft_is_that_of_the_first_generator_where_the_wheel_is_the_same(name):
    soil = Bekker()
    config = reference_configuration((), MACHINES[name])
    rig = Rig(
        wheels=WHEELS,
        radius=np.array([w.radius for w in config.wheel]),
        width=np.array([w.width for w in config.wheel]),
        ahead=np.array([1.0 if w.axle == "front" else 0.0 for w in config.wheel]),
        chassis=chassis_of(config),
        noise={quantity: SensorNoise() for quantity in ("torque", "load", "speed")},
    )
    first = true_largest_draft(
        Soil(*soil), rig, np.full(4, np.nan), 0.6, WheelModel("exponential"), np.inf, drivetrain_of(config)
    )
    assert largest_draft(machine(MACHINES[name]), Rim(soil)) == pytest.approx(first, rel=0.01)


@pytest.mark.parametrize("name", MACHINES)
def test_channels_are_those_of_the_configuration_and_become_its_frames(name):
    config = reference_configuration((), MACHINES[name])
    made = other_machines.drive(machine(MACHINES[name]), Bekker(), seed=4, duration=12.0)
    mapped = [f"{quantity}.{part}" if part else quantity for quantity, part in fitted(config)]
    absent = {n for n in mapped if n not in made.channels}
    assert all(n.startswith(("torque_limit", "latitude", "longitude")) for n in absent)
    unknown = Column(np.arange(0.0, 11.9, 0.02), np.full(595, np.nan))
    channels = {n: Column(*made.channels[n]) if n in made.channels else unknown for n in mapped}
    sent = list(frames(Recording(made.truth, channels, 4), config))
    assert len(sent) > 11 * 50 * 5


def test_samples_are_late_by_20_to_60_ms_and_noisy():
    made = other_machines.drive(machine(AXLE_MOTORS), Bekker(), seed=5, duration=60.0)
    t = made.truth["t"]
    for name in ("speed.RL", "draft", "torque.rear"):
        stamps, value = made.channels[name]
        truth = made.truth["motor_torque.rear" if name == "torque.rear" else name]
        delays = np.arange(0.0, 0.1, 0.005)
        miss = [np.var(value - np.interp(stamps - delay, t, truth)) for delay in delays]
        assert 0.01 < delays[int(np.argmin(miss))] < 0.07
        assert min(miss) > 0.0


def test_same_seed_same_drive():
    first, again, other = (
        other_machines.drive(machine(REAR_DRIVE), Cone(), seed, 5.0).channels["speed.RL"][1] for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
