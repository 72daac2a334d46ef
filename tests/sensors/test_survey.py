"""`soilbus check` beside data: every mistake of mapping is named, and nothing where there is none."""

from __future__ import annotations

import copy
import math
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from cantools.database.can import Database

import soilbus
from soilbus.can.bus import heard_for
from soilbus.can.candump import Frame, frame_of
from soilbus.can.dbc_files import load_databases
from soilbus.cli.main import main
from soilbus.config.file import load_config, shipped_dbc
from soilbus.config.model import Config
from soilbus.estimation.assembly import with_effects
from soilbus.estimation.window import turning
from soilbus.offline.replay import read_frames
from soilbus.pipeline.intake import Intake
from soilbus.sensors.survey import Survey, survey
from soilbus.simulator.frames import frames
from soilbus.simulator.play import scenario_over
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.reference import AXLE_MOTORS, REAR_DRIVE, TRACTOR, reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing

FIELD = Path(__file__).resolve().parents[1] / "field/field.toml"
WHEELS = ("FL", "FR", "RL", "RR")
LEVEL = (
    "the slope hardly changes: the sign and scale of signals.pitch and the kind of signals.acceleration cannot be"
    " decided: drive up and down a slope"
)
"""What every drive on level ground leaves open."""
RADII = "radius and slip are not separable, 5 % of radius is 0.05 of slip: roll a minute without draft on firm ground"
"""What every drive that pulls leaves open."""


@pytest.fixture(scope="module")
def field_frames(field_recording) -> Callable[[str], list[Frame]]:
    read: dict[str, list[Frame]] = {}

    def of(name: str) -> list[Frame]:
        if name not in read:
            read[name] = list(read_frames(field_recording(f"{name}.log.gz")))
        return read[name]

    return of


def heard_of(recording: Recording, config: Config) -> list[Frame]:
    """Its frames."""
    return [frame_of(message) for message in frames(recording, config)]


def driven(soils: Sequence[str], seed: int, duration: float = 40.0, effects: Sequence[str] = ()) -> list[Frame]:
    config = with_effects(reference_configuration(), effects)
    return heard_of(simulate(config, scenario_over(soils, duration), seed), config)


@pytest.fixture(scope="module")
def clay_drive() -> list[Frame]:
    return driven(["wet_clay"], 7)


def beside(config: Config, heard: list[Frame]) -> Survey:
    return survey(config, load_databases(config), heard)


@pytest.fixture(scope="module")
def rear_drive() -> list[Frame]:
    """20 s of the machine with one motor, free front wheels and a load cell of the rear axle."""
    config = reference_configuration(path=REAR_DRIVE)
    return heard_of(simulate(config, scenario_over(["loam"], 20.0), 5), config)


def test_wheel_speeds_slower_than_torques_ask_for_shorter_bins(clay_drive):
    """What is measured at one instant beside means over 0.1 s: the advice, and none where it is followed."""
    config = reference_configuration()
    identifier = load_databases(config).get_message_by_name("WheelSpeeds").frame_id
    speeds = [frame for frame in clay_drive if frame[1] == identifier]
    slow = set(map(id, speeds)) - set(map(id, speeds[::5]))
    heard = [frame for frame in clay_drive if id(frame) not in slow]
    (advice,) = (text for text in beside(config, heard).warnings if "estimator.bin" in text)
    assert "10 values a second beside 50" in advice
    assert advice.endswith("set estimator.bin = 0.04")
    shorter = reference_configuration(["estimator.bin=0.04"])
    assert not any("estimator.bin" in text for text in beside(shorter, heard).warnings)
    assert not any("estimator.bin" in text for text in beside(config, clay_drive).warnings)


# --- nothing where there is nothing ---


@pytest.mark.parametrize("name", ["loam", "clay", "stubble"])
def test_the_field_vehicle_is_configured_without_fault(name, field_frames):
    found = beside(load_config(FIELD), field_frames(name))
    assert found.findings == ()
    asked = [line for line in found.open if "sinkage: not in this recording" not in line]  # fitted in one of them only
    assert asked == [LEVEL, RADII]
    assert all(s.count > 2900 and math.isfinite(s.rate) for s in found.seen if s.channel.quantity != "sinkage")


@pytest.mark.parametrize(
    ("soils", "seed", "effects"),
    [
        (["dry_sand"], 12, []),
        (["loam", "wet_clay"], 14, []),
        (["sandy_loam_11_michigan"], 15, ["slip_sinkage=1", "multipass=0.3"]),
        (["lean_clay_32"], 16, ["grade=0.05", "draft_gain=0.15"]),
        (["loam"], 17, ["rolling_radius=0.03", "wheel_load_offset=300", "draft_offset=400"]),
        (["clayey_soil_38"], 18, ["drivetrain_loss=0.1", "torque_lag=0.2"]),
    ],
)
def test_drives_and_what_models_miss_are_no_mistakes_of_mapping(soils, seed, effects):
    found = beside(reference_configuration(), driven(soils, seed, 30.0, effects))
    assert found.findings == ()
    assert [line for line in found.open if "the draft hardly changes" not in line] == [LEVEL, RADII]


# --- mistakes in the configuration ---

EACH_GEAR = [f"wheel.{w}.gear_ratio=48" for w in WHEELS]
MISTAKES = {
    "mass 3000": (["vehicle.mass=3000"], ["sum to 22.6 kN", "weight of 2300 kg", "vehicle.mass = 3000 kg"]),
    "mass 5071, in lb": (["vehicle.mass=5071"], ["vehicle.mass = 5071 kg", "lb"]),
    "mass a sixth less": (["vehicle.mass=1900"], ["vehicle.mass = 1900 kg"]),
    "gear ratio of all": (EACH_GEAR, ["wheel.RR.gear_ratio = 48", "RR.ShaftSpeed turns 24"]),
    "gear ratio of one": (["wheel.RL.gear_ratio=12"], ["wheel.RL.gear_ratio = 12", "turns 24 times as fast"]),
    "draft sign": (["signals.draft.sign=-1"], ["signals.draft", "sign of the draft"]),
    "acceleration sign": (["signals.acceleration.sign=-1"], ["signals.acceleration"]),
    "torque sign of one": (["wheel.FR.torque.sign=-1"], ["wheel.FR.torque", "brakes while most wheels drive"]),
    "torque signs of all": ([f"wheel.{w}.torque.sign=-1" for w in WHEELS], ["brake", "sign of the torques"]),
    "speed sign of one": (["wheel.RL.speed.sign=-1"], ["wheel.RL.speed", "turns backward"]),
    "loads swapped": (
        ["wheel.FL.load={load}.FR", "wheel.FR.load={load}.FL"], ["the loads of FL and FR are swapped"],
    ),
    "speeds swapped": (
        ["wheel.FL.speed=WheelSpeeds.FR", "wheel.FR.speed=WheelSpeeds.FL"], ["speeds of FL and FR are swapped"],
    ),
    "torques swapped": (
        ["wheel.RL.torque.signal={motor}RR.ShaftTorque", "wheel.RR.torque.signal={motor}RL.ShaftTorque"],
        ["torques of RL and RR are swapped"],
    ),
    "diameter for radius": (["wheel.FL.radius=1.0"], ["wheel.FL: seems to slip by 0.6", "radius"]),
    "diameters for radii": (
        ["wheel.FL.radius=1.0", "wheel.FR.radius=1.0", "wheel.RL.radius=1.24", "wheel.RR.radius=1.24"],
        ["the wheels seem to slip", "a diameter in the place of a radius"],
    ),
    "torque at the wheel": (
        [f"wheel.{w}.torque.at=wheel" for w in WHEELS], ["thrust changes 0.0", "at the other side of the gear"],
    ),
}  # fmt: skip


def set_for(config: Path, sets: Sequence[str]) -> Config:
    names = {"load": "AxleLoads", "motor": "Mcu"} if config == FIELD else {"load": "WheelLoads", "motor": "Motor"}
    return load_config(config, [text.format(**names) for text in sets])


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_beside_a_recording_of_the_field_vehicle(mistake, field_frames):
    sets, words = MISTAKES[mistake]
    found = beside(set_for(FIELD, sets), field_frames("loam"))
    lines = found.faults + found.warnings
    assert any(all(word in line for word in words) for line in lines), lines
    if mistake != "mass a sixth less":
        assert found.faults


def test_a_gear_ratio_is_told_by_forces_where_no_motor_speed_is_on_the_bus(field_frames, tmp_path):
    dbc = re.sub(r"^ SG_ ShaftSpeed.*\n", "", FIELD.with_name("field.dbc").read_text(), flags=re.M)
    config = configured(FIELD, "field.dbc", dbc, tmp_path)
    for name in ("loam", "stubble"):
        found = beside(load_config(config, EACH_GEAR), field_frames(name))
        assert len(found.faults) == 1
        assert "gear_ratio too large" in found.faults[0]
        assert beside(load_config(config), field_frames(name)).findings == ()


def test_a_draft_that_hardly_changes_still_tells_by_its_size():
    drive = Scenario(30.0, (Patch(0.0, "loam"),), draft=Swing(3500.0, 3500.0))
    heard = heard_of(simulate(reference_configuration(), drive, 3), reference_configuration())
    assert beside(reference_configuration(), heard).findings == ()
    found = beside(set_for(TRACTOR, [f"wheel.{w}.torque.at=wheel" for w in WHEELS]), heard)
    assert len(found.faults) == 1
    assert all(word in found.faults[0] for word in ("the wheels thrust with 0.", "(`at`)"))


def test_turns_tell_the_sign_of_the_yaw_rate(tmp_path):
    imu = (
        'BO_ 2566862537 Imu: 8 CHASSIS\n SG_ YawRate : 0|16@1+ (0.0005,-16) [-16|16] "rad/s" SOILBUS\n\n'
        "BO_ 2566861770 DrawbarPin"
    )
    dbc = shipped_dbc("tractor.dbc").read_text().replace("BO_ 2566861770 DrawbarPin", imu, 1)
    path = configured(TRACTOR, "tractor.dbc", dbc, tmp_path)
    sets = ["signals.yaw_rate=Imu.YawRate", "vehicle.track=1.2"]
    config = load_config(path, sets)
    recording = simulate(config, scenario_over(["loam"], 60.0), 9)
    columns = recording.channels
    yaw = columns["yaw_rate"]
    yaw.value += np.where((yaw.t > 20.0) & (yaw.t < 30.0), 0.4, 0.0)  # a left turn, the right wheels go faster
    for wheel, side in (("FL", -1.0), ("FR", 1.0), ("RL", -1.0), ("RR", 1.0)):
        radius = next(w.radius for w in config.wheel if w.name == wheel)
        speed = columns[f"speed.{wheel}"]
        speed.value += np.where((speed.t > 20.0) & (speed.t < 30.0), side * 0.4 * 1.2 / 2.0 / radius, 0.0)
    heard = heard_of(recording, config)
    assert beside(config, heard).findings == ()
    wrong = beside(load_config(path, [*sets, "signals.yaw_rate.sign=-1"]), heard)
    assert len(wrong.faults) == 1
    assert wrong.faults[0].startswith("signals.yaw_rate: to the left while the left wheels go faster")
    # in the service: the turn is left out, and a yaw rate that is lost costs nothing but itself
    for kept in (True, False):
        intake = Intake(config, load_databases(config))
        for t, identifier, extended, data, remote, _ in heard:
            if kept or identifier != 2566862537 & 0x1FFFFFFF:
                intake.admission.feed(t, identifier, extended, data, remote)
        tasks = intake.due(heard[-1][0])
        assert all(task.poor == task.missing == task.implausible == () for task in tasks)
        turns = {round(task.end - heard[0][0]): turning(task.window, intake.rig, 0.15).sum() for task in tasks}
        assert turns[18] == turns[42] == 0
        assert turns[30] == pytest.approx(98, abs=3)


def test_a_speed_beside_the_torque_that_is_the_wheels_own_is_no_wrong_gear(field_frames, tmp_path):
    dbc = re.sub(
        r"(ShaftSpeed .*)\(0.125,0\)(.*)", rf"\1({0.125 / 24.0!r},0)\2", FIELD.with_name("field.dbc").read_text()
    )
    config = configured(FIELD, "field.dbc", dbc, tmp_path)
    assert beside(load_config(config), field_frames("loam")).findings == ()
    mapped = load_config(config, ["wheel.FL.motor_speed=McuFL.ShaftSpeed"])
    assert any("McuFL.ShaftSpeed turns 1 times" in line for line in beside(mapped, field_frames("loam")).faults)


def test_a_whole_axle_in_a_mirror_is_the_same_vehicle(field_frames):
    sets = []
    for one, other in (("FL", "FR"), ("FR", "FL")):
        sets += [f"wheel.{one}.load=AxleLoads.{other}", f"wheel.{one}.speed=WheelSpeeds.{other}"]
        sets += [f"wheel.{one}.sinkage=RideHeight.Sink{other}", f"wheel.{one}.torque.signal=Mcu{other}.ShaftTorque"]
    assert beside(load_config(FIELD, sets), field_frames("loam")).findings == ()


# --- mistakes in the DBC ---


def configured(base: Path, dbc_name: str, dbc: str, folder: Path) -> Path:
    (folder / "x.dbc").write_text(dbc)
    (folder / "x.toml").write_text(base.read_text().replace(dbc_name, "x.dbc"))
    return folder / "x.toml"


def other_byte_order(dbc: str, message: str, signals: Sequence[str]) -> str:
    """The DBC with 16-bit signals of messages of that name (a part of it) read the other way round."""

    def turned(match: re.Match[str]) -> str:
        name, start, order = match[1], int(match[2]), match[3]
        if name not in signals:
            return match[0]
        return f" SG_ {name} : {start + 7 if order == '1' else start - 7}|16@{'0' if order == '1' else '1'}"

    blocks = re.split(r"(?=^BO_ )", dbc, flags=re.M)
    return "".join(
        re.sub(r" SG_ (\w+) : (\d+)\|16@([01])", turned, block) if message in block.split(":")[0] else block
        for block in blocks
    )


BYTE_ORDERS = {
    "loads": ("Loads", WHEELS, "wheel.FL.load"),
    "speeds": ("WheelSpeeds", WHEELS, "wheel.FL"),
    "torques": ("M", ("ShaftTorque",), "wheel.FL.torque"),
    "draft": ("DrawbarPin", ("Draft",), "signals.draft"),
    "ground speed": ("GroundBased", ("GroundBasedMachineSpeed",), "signals.ground_speed"),
}


@pytest.mark.parametrize("what", list(BYTE_ORDERS))
def test_a_wrong_byte_order_is_named(what, field_frames, tmp_path):
    text = FIELD.with_name("field.dbc").read_text()
    message, signals, key = BYTE_ORDERS[what]
    wrong = other_byte_order(text, message, signals)
    assert wrong != text
    found = beside(load_config(configured(FIELD, "field.dbc", wrong, tmp_path)), field_frames("loam"))
    assert any(line.startswith(key) and "byte order" in line for line in found.faults), found.faults


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (r'(GroundBasedMachineSpeed .*)"m/s"', r'\1"km/h"', ["is the ground speed in m/s where the DBC says km/h"]),
        (r'(ShaftTorque .*)"N.m"', r'\1"kNm"', ["wheel.FL.torque", "beyond what this vehicle can do", "unit"]),
        (r'( (?:FL|FR|RL|RR) : .*)"N"', r'\1"kg"', ["the wheel loads sum to", "are the loads taken for kg"]),
        (r'( (?:FL|FR|RL|RR) : .*)"rad/s"', r'\1"rpm"', ["are the wheel speeds in rad/s where the DBC says rpm"]),
        (r'(Draft .*)\(1,0\)', r'\1(0.3,0)', ["times as much as the draft", "scale of the draft"]),
    ],
)  # fmt: skip
def test_a_wrong_unit_is_named(old, new, words, field_frames, tmp_path):
    text = FIELD.with_name("field.dbc").read_text()
    wrong = re.sub(old, new, text)
    assert wrong != text
    # without the motors' speeds, which would give the wheels' away
    wrong = re.sub(r"^ SG_ ShaftSpeed.*\n", "", wrong, flags=re.M)
    found = beside(load_config(configured(FIELD, "field.dbc", wrong, tmp_path)), field_frames("loam"))
    assert any(all(word in line for word in words) for line in found.faults), found.faults


# --- what is on the bus ---


def test_messages_that_never_come_are_named_once_each_with_their_keys(clay_drive):
    config = reference_configuration()
    frame_id = load_databases(config).get_message_by_name("WheelLoads").frame_id
    found = beside(config, [f for f in clay_drive if f[1] != frame_id])
    assert len(found.faults) == 1
    assert all(f"wheel.{w}.load" in found.faults[0] for w in WHEELS)
    assert f"{frame_id:#x}" in found.faults[0]


@pytest.mark.parametrize("change", [0x04000000, 0x0000000F], ids=["priority", "source"])
def test_a_message_from_another_sender_than_in_the_dbc_is_named_with_its_identifier(change, clay_drive):
    config = reference_configuration()
    frame_id = load_databases(config).get_message_by_name("WheelLoads").frame_id
    found = beside(config, [(f[0], f[1] ^ change * (f[1] == frame_id), *f[2:]) for f in clay_drive])
    (fault,) = found.faults
    assert f"{frame_id:#x}" in fault
    assert f"{frame_id ^ change:#x}" in fault


def paged(database: Database, pages: dict[str, list[int]]) -> Database:
    """The tractor's messages; these signals of MotorFL are there where its Counter is one of `pages`."""
    found = copy.deepcopy(database)
    motor = found.get_message_by_name("MotorFL")
    motor.get_signal_by_name("Counter").is_multiplexer = True
    for name, ids in pages.items():
        signal = motor.get_signal_by_name(name)
        signal.multiplexer_signal, signal.multiplexer_ids = "Counter", ids
    return found


def test_a_page_that_comes_in_turns_is_not_called_slow_and_one_that_never_comes_is_named(clay_drive):
    config = reference_configuration()
    found = survey(config, paged(load_databases(config), {"ShaftTorque": [0, 2, 4, 6, 8, 10, 12, 14]}), clay_drive)
    assert not [text for text in (*found.faults, *found.warnings) if "wheel.FL.torque:" in text]
    found = survey(config, paged(load_databases(config), {"ShaftTorque": [99]}), clay_drive)
    (fault,) = [text for text in found.faults if "wheel.FL.torque" in text]
    assert "MotorFL was heard, but never the page of its multiplexer that holds ShaftTorque" in fault


@pytest.mark.parametrize(("first", "second", "is_told"), [(0x11, 0x22, True), (0x11, None, False), (None, 0x22, False)])
def test_a_standard_message_of_several_senders_of_which_none_is_the_dbcs_is_told(first, second, is_told, clay_drive):
    """None in place of an address: that of the DBC."""
    config = reference_configuration()
    name, _, _ = config.signals.ground_speed.signal.partition(".")
    frame_id = load_databases(config).get_message_by_name(name).frame_id
    senders = [frame_id if address is None else frame_id & ~0xFF | address for address in (first, second)]
    both = [(f[0], i, *f[2:]) for f in clay_drive for i in (senders if f[1] == frame_id else [f[1]])]
    found = beside(config, both)
    told = [text for text in found.warnings if "0x11 and 0x22" in text]
    assert len(told) == is_told
    assert all("signals.ground_speed" in text for text in told)
    assert found.faults == []


def test_a_log_of_another_bus_is_one_line(clay_drive):
    found = beside(load_config(FIELD), [f for f in clay_drive if f[1] & 0xFFFF00 != 0xFE4900])
    assert len(found.faults) == 1
    assert "another bus" in found.faults[0]


def test_stuck_and_slow_signals_are_warned_of(clay_drive):
    config = reference_configuration()
    database = load_databases(config)
    radar = database.get_message_by_name("GroundBasedSpeedAndDistance")
    slow = [f for i, f in enumerate(clay_drive) if f[1] & 0xFFFF00 != radar.frame_id & 0xFFFF00 or i % 3 == 0]
    found = beside(config, slow)
    assert any(line.startswith("signals.ground_speed") and "25" in line for line in found.warnings), found.warnings
    assert found.faults == []
    loads = database.get_message_by_name("WheelLoads").frame_id
    first = next(f for f in clay_drive if f[1] == loads)
    stuck = [(f[0], f[1], f[2], first[3], f[4], f[5]) if f[1] == loads else f for f in clay_drive]
    lines = beside(config, stuck).warnings
    assert all(any(line.startswith(f"wheel.{w}.load: reads") for line in lines) for w in WHEELS), lines


def test_a_recording_at_rest_says_what_it_cannot_show(clay_drive):
    found = beside(reference_configuration(), clay_drive[:2000])
    assert found.faults == []
    assert any("straight on for less than 10 s" in line for line in found.open)


def test_a_clock_that_jumps_makes_no_endless_table(clay_drive):
    late = [(f[0] + 1e6 if i > len(clay_drive) // 4 else f[0], *f[1:]) for i, f in enumerate(clay_drive)]
    found = beside(reference_configuration(), late)
    assert found.faults == []
    assert all(math.isfinite(s.rate) for s in found.seen)


def test_the_command_prints_the_table_and_exits_with_2_on_faults(field_recording, capsys):
    log = str(field_recording("loam.log.gz"))
    assert main(["check", "--config", str(FIELD), "--log", log]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert re.search(r"^ground_speed +3000 +40 ms +0\.", out, re.M)
    assert main(["check", "--config", str(FIELD), "--log", log, "--set", "vehicle.mass=3000"]) == 2
    out, err = capsys.readouterr()
    assert re.search(r"^load.FL .*fault, see below$", out, re.M)
    assert err.startswith("soilbus: the wheel loads sum to")
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("command", ["check", "replay"])
def test_a_log_of_another_channel_is_told(command, field_recording, tmp_path, capsys):
    log = str(field_recording("deere-5055e-start.log.gz"))
    arguments = ["--log", log] if command == "check" else [log]
    main([command, "--config", str(FIELD.with_name("deere.toml")), "--set", "bus.channel=can1", *arguments])
    err = capsys.readouterr().err
    assert "frames of can0, where bus.channel = can1" in err
    main([command, "--config", str(FIELD.with_name("deere.toml")), *arguments])
    assert "bus.channel" not in capsys.readouterr().err


def test_the_configured_bus_is_heard_for_some_time(clay_drive):
    settings = {"interface": "virtual", "channel": "survey"}
    sender = can.Bus(**settings)
    sent = [can.Message(arbitration_id=f[1], is_extended_id=f[2], data=f[3]) for f in clay_drive[:200]]

    def send() -> None:
        for message in sent:
            sender.send(message)

    heard = heard_for(settings, 1.0)
    try:
        later = threading.Timer(0.2, send)
        later.start()
        frames_heard = list(heard)
        later.join()
    finally:
        sender.shutdown()
    assert [(f[1], bytes(f[3])) for f in frames_heard] == [(m.arbitration_id, bytes(m.data)) for m in sent]


# --- an axle's motor, free wheels, one axle's load cell ---


def test_the_machine_with_one_motor_is_configured_without_fault(rear_drive):
    assert beside(reference_configuration(path=REAR_DRIVE), rear_drive).findings == ()


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("axle.rear.gear_ratio=12.0", "MotorRear.ShaftSpeed turns 24"),
        ("axle.rear.motor_speed.sign=-1", "axle.rear.motor_speed: turns backward"),
        ("wheel.FL.radius=0.9", "wheel.FL: rolls freely, but its rim goes 1.8"),
        ("vehicle.mass=2000.0", "the rear axle alone carries 2"),
        ("axle.rear.differential=locked", 'axle.rear.differential = "locked", but the speeds of RL and RR differ by'),
    ],
)
def test_a_mistake_about_an_axle_or_a_free_wheel_is_named(override, says, rear_drive):
    found = beside(reference_configuration([override], path=REAR_DRIVE), rear_drive)
    assert [fault for fault in found.faults if says in fault] == found.faults[:1]
    assert len(found.faults) >= 1


@pytest.mark.parametrize(
    ("path", "names"),
    [(TRACTOR, ("load.FL", "load.FR", "load.RL", "load.RR")), (REAR_DRIVE, ("motor_speed.rear", "speed.rear"))],
)
def test_sensors_that_read_zero_are_named(path, names):
    """As those do that are not connected."""
    config = reference_configuration(path=path)
    recording = simulate(config, Scenario(30.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.3)), 5)
    channels = {n: replace(c, value=0.0 * c.value) if n in names else c for n, c in recording.channels.items()}
    assert any(n in names for n in channels)
    assert beside(config, heard_of(replace(recording, channels=channels), config)).faults


def test_where_nothing_moves_load_its_cells_are_not_judged_by_it():
    """A machine that tows nothing, with cells, without pitch and acceleration."""
    config = reference_configuration()
    signals = config.signals.model_copy(update={"draft": None, "pitch": None, "acceleration": None})
    vehicle = config.vehicle.model_copy(update={"towing": "never"})
    config = config.model_copy(update={"signals": signals, "vehicle": vehicle})
    found = beside(config, heard_of(simulate(config, Scenario(40.0, (Patch(0.0, "loam"),), bounce=0.05), 5), config))
    assert not [fault for fault in found.faults if "load moves" in fault]


def on_hills(path: Path, slope: Sequence[tuple[float, float]]) -> list[Frame]:
    """30 s of a machine on loam, with its slope by distance."""
    config = reference_configuration(path=path)
    scenario = Scenario(30.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.3), slope=slope)
    return heard_of(simulate(config, scenario, 5), config)


def with_changed(
    change: Callable[[Recording], dict[str, Any]], slope: Sequence[tuple[float, float]] = (), path: Path = TRACTOR
) -> list[Frame]:
    """60 s of a machine on loam whose channels of these names read these values instead."""
    config = reference_configuration(path=path)
    drive = Scenario(60.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.3), slope=slope or ((0.0, 0.0),))
    recording = simulate(config, drive, 5)
    channels = recording.channels | {n: replace(recording.channels[n], value=v) for n, v in change(recording).items()}
    return heard_of(replace(recording, channels=channels), config)


HILLS = tuple((4.0 * i, 0.08 * (-1.0) ** i) for i in range(30))


def of_wheels(recording: Recording, wheels: Sequence[str] = WHEELS, late: float = 0.0) -> dict[str, Any]:
    """The ground speed that a controller computes from these wheels, late by so many seconds."""
    ground = recording.channels["ground_speed"]
    rims = [
        np.interp(ground.t - late, own.t, own.value) * radius
        for own, radius in ((recording.channels[f"speed.{w}"], 0.5 if w[0] == "F" else 0.62) for w in wheels)
    ]
    return {"ground_speed": np.mean(rims, axis=0)}


def scaled(name: str, factor: float) -> Callable[[Recording], dict[str, Any]]:
    return lambda recording: {name: factor * recording.channels[name].value}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (of_wheels, "signals.ground_speed: goes with the "),
        (lambda r: of_wheels(r, ("RL", "RR")), "signals.ground_speed: goes with the rear wheels"),
        (lambda r: of_wheels(r, ("RL", "RR"), late=0.15), "signals.ground_speed: goes with the rear wheels"),
        (scaled("draft", 1.0 / 9.80665), "kgf or daN where the DBC says N"),
        (scaled("acceleration", 10.0), "signals.acceleration: changes"),
        (scaled("acceleration", 0.1), "signals.acceleration: changes 0.1 times"),
    ],
)
def test_a_scale_that_other_sensors_contradict_is_named(change, says):
    found = beside(reference_configuration(), with_changed(change))
    assert [fault for fault in found.faults if says in fault], (found.faults, found.open)


def of_gravity(factor: float) -> Callable[[Recording], dict[str, Any]]:
    """An accelerometer that feels the slope, and a pitch sensor of this scale."""

    def change(recording: Recording) -> dict[str, Any]:
        pitch, own = recording.channels["pitch"], recording.channels["acceleration"]
        gravity = 9.80665 * np.sin(np.interp(own.t, pitch.t, pitch.value))
        return {"acceleration": own.value + gravity, "pitch": factor * pitch.value}

    return change


@pytest.mark.parametrize(
    ("factor", "kind", "says"),
    [
        (1.0, "kinematic", 'which dv/dt does not: kind = "specific_force"?'),
        (3.0, "specific_force", "signals.pitch: the accelerometer feels 0.3"),
        (0.2, "specific_force", "signals.pitch: the accelerometer feels 5 times"),
        (-1.0, "specific_force", "signals.pitch: the accelerometer feels it the other way"),
    ],
)
def test_an_accelerometer_that_feels_the_slope_tells_kind_and_pitch(factor, kind, says):
    config = reference_configuration([f"signals.acceleration.kind={kind}"])
    found = beside(config, with_changed(of_gravity(factor), HILLS))
    assert [fault for fault in found.faults if says in fault], (found.faults, found.open)


def test_sensors_of_the_right_scale_contradict_nothing():
    assert beside(reference_configuration(), with_changed(lambda recording: {})).findings == ()
    force = reference_configuration(["signals.acceleration.kind=specific_force"])
    assert beside(force, with_changed(of_gravity(1.0), HILLS)).findings == ()


def test_an_accelerometer_without_gravity_said_to_feel_it_is_named():
    config = reference_configuration(["signals.acceleration.kind=specific_force"])
    heard = with_changed(lambda recording: {}, HILLS)
    assert beside(reference_configuration(), heard).findings == ()
    assert any('kind = "kinematic"' in fault for fault in beside(config, heard).faults)


@pytest.mark.parametrize(("factor", "is_told"), [(1.0, False), (0.9, False), (1.1, True)])
def test_a_wheel_that_rolls_freely_may_skid_and_does_not_drive(factor, is_told):
    config = reference_configuration(path=REAR_DRIVE)
    wheels = [w if w.driven else w.model_copy(update={"radius": factor * w.radius}) for w in config.wheel]
    found = beside(config.model_copy(update={"wheel": wheels}), with_changed(lambda recording: {}, (), REAR_DRIVE))
    assert any("rolls freely, but its rim goes 1.0" in warning for warning in found.warnings) == is_told
    assert not any("rolls freely" in fault for fault in found.faults)


@pytest.mark.parametrize("factor", [1.0, 1.0 / 9.80665])
def test_loads_in_kg_are_named_where_one_axle_alone_is_weighed(factor):
    heard = with_changed(scaled("load.rear", factor), (), REAR_DRIVE)
    faults = beside(reference_configuration(path=REAR_DRIVE), heard).faults
    named = [fault for fault in faults if "axle.rear.load" in fault and "are the loads in kg, not in N?" in fault]
    assert bool(named) == (factor < 1.0), faults


def test_wheels_that_roll_without_thrust_tell_their_radii():
    road = soilbus.Soil(k_c=0.0, k_phi=3e8, n=1.0, phi=0.9, c=5e4, K=0.002)
    config = reference_configuration()
    drive = Scenario(40.0, (Patch(0.0, "road", road),), draft=Swing(0.0, 0.0))
    rolls = heard_of(simulate(config, drive, 5), config)
    right = beside(config, rolls)
    assert right.findings == ()
    assert RADII not in right.open
    (finding,) = beside(reference_configuration(["wheel.RL.radius=0.66"]), rolls).findings
    assert finding.text == "wheel.RL: slips by 0.06 where nothing is pulled: its radius?"


def test_a_slope_that_only_a_specific_force_shows_contradicts_nothing():
    found = beside(reference_configuration(path=AXLE_MOTORS), on_hills(AXLE_MOTORS, ((0.0, 0.10),)))
    assert found.findings == ()
    assert any("no load is measured: vehicle.mass" in line for line in found.open)


def test_hills_show_the_sign_of_the_pitch_and_level_ground_says_that_it_does_not(clay_drive):
    hills = on_hills(TRACTOR, [(4.0 * i, 0.08 * (-1.0) ** i) for i in range(20)])
    assert beside(reference_configuration(), hills).findings == ()
    assert beside(reference_configuration(), hills).open == (RADII,)
    turned = reference_configuration(["signals.pitch.sign=-1"])
    assert any(line.startswith("signals.pitch: ") for line in beside(turned, hills).faults)
    level = beside(turned, clay_drive)
    assert level.findings == ()
    assert level.open == (LEVEL, RADII)


def test_a_torque_of_an_axle_that_brakes_is_named_by_its_key():
    config = reference_configuration(["axle.front.torque.sign=-1"], path=AXLE_MOTORS)
    (fault,) = beside(config, on_hills(AXLE_MOTORS, ((0.0, 0.0),))).faults
    assert fault == "axle.front.torque: brakes while the other axle drives: sign = -1?"


def test_loads_of_a_front_and_a_rear_wheel_are_told_apart_by_the_draft(field_frames, clay_drive):
    swaps = ["wheel.FL.load={load}.RL", "wheel.RL.load={load}.FL"]
    (fault,) = beside(set_for(FIELD, swaps), field_frames("stubble")).faults
    assert re.match(r"load moves between front and rear wheels -?0\.[0-3]\d times", fault)
    faults = beside(set_for(TRACTOR, swaps), clay_drive).faults
    assert any(fault.startswith("load moves between front and rear") for fault in faults), faults


def test_two_wheels_unlike_the_other_two_are_named_in_one_line(field_frames):
    (fault,) = beside(set_for(FIELD, ["wheel.FL.radius=1.0", "wheel.FR.radius=1.0"]), field_frames("loam")).faults
    assert re.search(r"wheels seem to slip unlike: FL and FR by 0\.[56]\d, RL and RR by 0\.[012]\d: radius", fault)


def test_a_channel_that_contradicts_the_others_is_named_by_its_key(rear_drive, tmp_path):
    """A lock that reads the code of no state all the time."""
    (tmp_path / "lock.dbc").write_text('VERSION ""\nBU_: X\nBO_ 100 Lock: 1 X\n SG_ State : 0|2@1+ (1,0) [0|3] "" X\n')
    text = REAR_DRIVE.read_text().replace('"axles.dbc"', '"axles.dbc", "lock.dbc"')
    config = tmp_path / "lock.toml"
    config.write_text(text.replace("[vehicle]", '[vehicle]\ndifferential_lock = "Lock.State"'))
    state = (frame_of(can.Message(frame[0], 100, False, data=[3])) for frame in rear_drive[::20])
    found = beside(load_config(config), sorted([*rear_drive, *state], key=lambda frame: frame[0]))
    assert [f.text for f in found.findings] == [
        "vehicle.differential_lock: contradicts the other sensors in 2 of 2 windows"
    ]


def test_a_locked_differential_turns_both_wheels_alike():
    config = reference_configuration(["axle.rear.differential=locked"], path=REAR_DRIVE)
    assert beside(config, heard_of(simulate(config, scenario_over(["loam"], 20.0), 5), config)).findings == ()


def test_a_draft_that_is_known_to_be_none_is_no_frozen_sensor(tmp_path):
    text = re.sub(r"\[signals\.draft\][^\[]*", "", TRACTOR.read_text()).replace(
        "[vehicle]", '[vehicle]\ntowing = "never"'
    )
    (tmp_path / "rover.toml").write_text(text)
    config = load_config(tmp_path / "rover.toml")
    scenario = Scenario(20.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.3))
    found = beside(config, heard_of(simulate(config, scenario, 5), config))
    assert not [finding for finding in found.findings if "draft" in finding.text]


def with_a_radar(least: float, scenario: Scenario) -> list[Frame]:
    """A drive whose ground speed reads zero below a speed [m/s]."""
    config = reference_configuration()
    recording = simulate(config, scenario, 11)
    ground = recording.channels["ground_speed"]
    read = replace(ground, value=np.where(ground.value < least, 0.0, ground.value))
    return heard_of(replace(recording, channels=recording.channels | {"ground_speed": read}), config)


def with_min_speed(limit: float) -> Config:
    config = reference_configuration()
    return config.model_copy(update={"estimator": config.estimator.model_copy(update={"min_speed": limit})})


def test_a_radar_that_measures_no_slow_speed_is_named_with_the_limit_that_mends_it():
    creeping = replace(scenario_over(["loam"], 40.0), speed=Swing(0.2, 0.8))
    config = reference_configuration()
    named = [w for w in beside(config, with_a_radar(0.4, creeping)).warnings if "reads 0 for up to" in w]
    assert len(named) == 1
    assert named[0].startswith("signals.ground_speed: ")
    limit = float(named[0].rpartition("estimator.min_speed = ")[2])
    assert 0.4 <= limit <= 0.7
    for heard, settings in (
        (with_a_radar(0.0, creeping), config),
        (with_a_radar(0.4, replace(creeping, speed=Swing(0.6, 1.5))), config),
        (with_a_radar(0.4, creeping), with_min_speed(limit)),
    ):
        assert not [w for w in beside(settings, heard).warnings if "reads 0 for up to" in w]
