"""Signals matched to roles on DBCs of several naming styles: what is right, what is wrong, what stays open."""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from soilbus.cli.main import main
from soilbus.config.file import load_config, machine, shipped_dbc
from soilbus.config.model import ConfigError

HERE = Path(__file__).resolve().parent
FIELD = HERE.parent / "field"
CORNERS = {"lf": "FL", "rf": "FR", "lr": "RL", "rr": "RR"}
ORCHARD = {
    "axle.?.torque": "INV_Actual.InvTrqAct", "axle.?.motor_speed": "INV_Actual.InvSpdAct",
    "axle.?.torque_limit": "INV_Actual.InvTrqMaxAvl", "axle.front.load": "EBS_AxlLd.AxlLdFrnt",
    "axle.rear.load": "EBS_AxlLd.AxlLdRe", "wheel.FL.speed": "EBS_WhlSpd.WhlSpdFrntLft",
    "wheel.FR.speed": "EBS_WhlSpd.WhlSpdFrntRght", "wheel.RL.speed": "EBS_WhlSpd.WhlSpdReLft",
    "wheel.RR.speed": "EBS_WhlSpd.WhlSpdReRght", "signals.ground_speed": "INS_Motion.GpsSog",
    "signals.draft": "HCU_Hitch.HtchDrft", "signals.pitch": "INS_Angles.ImuPtch", "signals.roll": "INS_Angles.ImuRoll",
    "signals.yaw_rate": "INS_Angles.ImuGz", "signals.acceleration": "INS_Motion.ImuAx",
    "signals.latitude": "INS_Pos.GpsLat", "signals.longitude": "INS_Pos.GpsLon",
}  # fmt: skip
"""One motor of an axle that no name says, axle loads in kg, wheel speeds in km/h; requests and a PTO beside."""
HUBS = {
    "signals.ground_speed": "nav_state.ground_spd", "signals.draft": "implement.pull_force",
    "signals.pitch": "nav_state.slope_long", "signals.roll": "nav_state.slope_lat",
    "signals.acceleration": "nav_imu.acc_lon", "signals.yaw_rate": "nav_imu.yaw_rt",
    "signals.steering_angle": "implement.front_steer_angle",
    **{f"wheel.{w}.torque": f"mcu_{c}_status.tq_fbk" for c, w in CORNERS.items()},
    **{f"wheel.{w}.speed": f"mcu_{c}_status.rpm_fbk" for c, w in CORNERS.items()},
    **{f"wheel.{w}.torque_limit": f"mcu_limits.tq_lim_{c}" for c, w in CORNERS.items()},
    **{f"wheel.{w}.load": f"susp_force.fz_{c}" for c, w in CORNERS.items()},
}  # fmt: skip
"""Four motors whose shafts alone have a speed, vertical forces, an odometer, suspension travel that is no sinkage."""
ISO = {
    "signals.ground_speed": "GroundBasedSpeedAndDistance.GroundBasedMachineSpeed",
    "signals.draft": "RearHitchStatus.RearDraft", "signals.latitude": "VehiclePosition.Latitude",
    "signals.longitude": "VehiclePosition.Longitude",
    "signals.acceleration": "AccelerationSensor.LongitudinalAccelerationExtendedRange",
}  # fmt: skip
"""Of pitch, roll and yaw rate there are two signals each; torque is a percentage."""


def mapped(raw: Mapping[str, Any]) -> dict[str, str]:
    """Signal of each role of a configuration, by dotted key."""
    parts = {"signals": raw.get("signals", {})}
    parts |= {f"{kind}.{item['name']}": item for kind in ("wheel", "axle") for item in raw.get(kind, [])}
    found = {f"{part}.{role}": value for part, table in parts.items() for role, value in table.items()}
    signals = {key: value["signal"] if isinstance(value, Mapping) else value for key, value in found.items()}
    return {key: signal for key, signal in signals.items() if isinstance(signal, str) and "." in signal}


def proposed(capsys: pytest.CaptureFixture[str], *dbcs: Path, log: Path | None = None) -> dict[str, Any]:
    """What `soilbus init` prints for these DBCs."""
    capsys.readouterr()
    words = [word for dbc in dbcs for word in ("--dbc", str(dbc))]
    assert main(["init", *words, *(["--log", str(log)] if log else [])]) == 0
    return tomllib.loads(capsys.readouterr().out)


def checked(found: Mapping[str, str], truth: Mapping[str, str]) -> float:
    """Share of the true roles that are mapped; none may be wrong, nor one mapped that is not there."""
    spare = {key: signal for key, signal in found.items() if key.endswith("motor_speed")}  # only compared with speeds
    wrong = {key: signal for key, signal in found.items() if truth.get(key) != signal and key not in spare}
    assert wrong == {}
    return len(truth.keys() & found.keys()) / len(truth)


@pytest.mark.parametrize(
    ("dbc", "truth"),
    [
        (HERE / "orchard.dbc", ORCHARD),
        (HERE / "hubs.dbc", HUBS),
        (shipped_dbc("iso11783.dbc"), ISO),
        (shipped_dbc("tractor.dbc"), mapped(tomllib.loads(machine("tractor").read_text()))),
        (FIELD / "field.dbc", mapped(tomllib.loads((FIELD / "field.toml").read_text()))),
    ],
    ids=["orchard", "hubs", "iso11783", "tractor", "field"],
)
def test_names_units_and_ranges_alone_find_every_role(dbc, truth, capsys):
    assert checked(mapped(proposed(capsys, dbc)), truth) == 1.0


def test_motors_of_wheels_and_of_axles_in_one_dbc_are_a_question(capsys):
    assert main(["init", "--dbc", "tractor.dbc", "--dbc", "axles.dbc"]) == 0
    text = capsys.readouterr().out
    found = mapped(tomllib.loads(text))
    assert "#   acceleration: Attitude.LongAccel (m/s^2)" in text  # there is another accelerometer
    assert [key for key in found if key.endswith("torque")] == []
    assert "wheel.FL.speed" in found


def test_two_signals_of_a_kind_and_a_percentage_are_questions(capsys):
    assert main(["init", "--dbc", "iso11783.dbc"]) == 0
    text = capsys.readouterr().out
    assert "#   pitch: SlopeSensorInformation.PitchAngle (deg), SlopeSensorInformation2.PitchAngleExtended" in text
    assert "# ElectronicEngineController1.ActualEnginePercentTorque (%, with reference_torque)\n" in text


@pytest.mark.parametrize(
    ("table", "written"),
    [
        ('0 "Valid" 1 "Invalid" 3 "SNA"', {"valid_values": [0]}),
        ('0 "Gut" 1 "Schlecht"', {"valid_values": "?"}),
        ("", {}),
    ],
)
def test_codes_that_vouch_come_from_the_value_table_or_stay_open(table, written, tmp_path, capsys):
    text = (FIELD / "field.dbc").read_text()
    pin = int(text.partition(" DrawbarPin:")[0].rpartition("BO_ ")[2])
    text = re.sub(rf"^VAL_ {pin} Valid .*\n", "", text, flags=re.MULTILINE)
    path = tmp_path / "pin.dbc"
    path.write_text(text + (f"VAL_ {pin} Valid {table} ;\n" if table else ""))
    draft = proposed(capsys, path)["signals"]["draft"]
    assert draft == {"signal": "DrawbarPin.Draft", "valid": "Valid"} | written


def test_each_open_value_counts_also_two_of_a_line(tmp_path, capsys):
    valid = ' SG_ Valid : 56|2@1+ (1,0) [0|3] "" CHS\n'
    dbc = f'VERSION ""\nBU_: CHS\nBO_ 100 Imu: 8 CHS\n SG_ LongAccel : 0|16@1- (0.001,0) [-20|20] "m/s^2" CHS\n{valid}'
    path, out = tmp_path / "imu.dbc", tmp_path / "out.toml"
    path.write_text(f'{dbc}VAL_ 100 Valid 0 "Gut" 1 "Schlecht" ;\n')
    assert main(["init", "--dbc", str(path), "-o", str(out)]) == 0
    said = capsys.readouterr()
    count = int(re.search(r"(\d+) values open", said.out + said.err)[1])
    acceleration = tomllib.loads(out.read_text())["signals"]["acceleration"]
    assert (acceleration["kind"], acceleration["valid_values"]) == ("?", "?")
    with pytest.raises(ConfigError) as error:
        load_config(out)
    assert len(error.value.faults) == count


def test_a_comment_on_the_direction_sets_the_sign(capsys):
    signals = proposed(capsys, shipped_dbc("nmea2000.dbc"))["signals"]
    assert signals["yaw_rate"] == {"signal": "RateOfTurn.Rate", "sign": -1}  # "positive to the right"
    assert [signals["pitch"], signals["roll"]] == ["Attitude.Pitch", "Attitude.Roll"]
    assert "sign" not in proposed(capsys, HERE / "hubs.dbc")["signals"]["draft"]  # "positive backward" is the role's


def test_what_a_log_does_not_hold_is_not_mapped(field_recording, capsys):
    truth = mapped(tomllib.loads((FIELD / "field.toml").read_text()))
    found = proposed(capsys, FIELD / "field.dbc", log=field_recording("clay.log.gz"))  # without RideHeight
    assert checked(mapped(found), {k: s for k, s in truth.items() if not k.endswith("sinkage")}) == 1.0
    assert [wheel["gear_ratio"] for wheel in found["wheel"]] == [24.0] * 4


def renamed(tmp_path: Path, *swaps: tuple[str, str]) -> Path:
    text = (HERE / "hubs.dbc").read_text()
    for old, new in swaps:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "renamed.dbc"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("swaps", "open_keys"),
    [
        ([("ground_spd", "v_a"), ("odo_spd", "v_b"), ("Doppler radar", ""), ("Odometer from the wheels", "")],
         ["signals.ground_speed"]),
        ([("mcu_lf", "mcu_1"), ("mcu_rf", "mcu_2"), ("mcu_lr", "mcu_3"), ("mcu_rr", "mcu_4"), ("MCU_LF", "M1"),
          ("MCU_RF", "M2"), ("MCU_LR", "M3"), ("MCU_RR", "M4")], ["wheel.FL.torque", "wheel.RR.torque"]),
        ([('"rad/s" CHS', '"furlong" CHS')], ["signals.yaw_rate"]),
        ([("acc_lon", "acc_1"), ("acc_lat", "acc_2"), ("acc_vert", "acc_3")], ["signals.acceleration"]),
    ],
    ids=["two unnamed speeds", "numbered motors", "unknown unit", "numbered axes"],
)  # fmt: skip
def test_what_no_name_says_stays_open(swaps, open_keys, tmp_path, capsys):
    found = mapped(proposed(capsys, renamed(tmp_path, *swaps)))
    assert [key for key in open_keys if key in found] == []
    assert {key: signal for key, signal in found.items() if HUBS.get(key) not in (signal, None)} == {}


def test_a_shaft_without_a_torque_still_asks_for_its_gear(tmp_path, capsys):
    units = [('"N*m" CHS', '"furlong" CHS')]  # every actual torque and limit
    for wheel in proposed(capsys, renamed(tmp_path, *units))["wheel"]:
        assert wheel["speed"]["at"] == "shaft"
        assert [wheel["torque"], wheel["gear_ratio"]] == ["?", "?"]


GERMAN = [
    (385, "ASM_VL_01", {"ASM_VL_Mom_Ist": "Nm", "ASM_VL_Mom_Soll": "Nm", "ASM_VL_Drehz": "1/min"}),
    (386, "ASM_VR_01", {"ASM_VR_Mom_Ist": "Nm", "ASM_VR_Mom_Soll": "Nm", "ASM_VR_Drehz": "1/min"}),
    (432, "Radlast", {"Radlast_HL": "kN", "Radlast_HR": "kN"}),
    (448, "Fahrdyn", {"Laengsbeschl": "m/s^2", "Nickwinkel": "deg", "Zugkraft": "daN", "Radar_Geschw": "km/h"}),
]
PLURALS = [
    (256, "Antrieb_VL", {"Drehmoment": "Nm", "Drehzahl": "1/min"}),
    (257, "Antrieb_VR", {"Drehmoment": "Nm", "Drehzahl": "1/min"}),
    (272, "Raddrehzahlen", {"Rad_VL": "U/min", "Rad_VR": "U/min"}),
    (288, "Radlasten", {"VL": "N", "VR": "N"}),
    (304, "Achslasten", {"Hinten": "N"}),
]
"""Without a word of motor or wheel in a signal's own name."""
LETTERS = [
    (529, "MCU_F_Tq", {"MCU_F_TqEst": "Nm", "MCU_F_TqReq": "Nm", "MCU_F_TqMaxAvl": "Nm"}),
    (530, "MCU_R_Tq", {"MCU_R_TqEst": "Nm", "MCU_R_TqReq": "Nm", "MCU_R_TqMaxAvl": "Nm"}),
    (656, "Scale", {"FrontKg": "kg", "RearKg": "kg"}),
]
UNNAMED = [
    (769, "LDC", {"LDC1": "daN", "LDC2": "daN"}),
    (770, "EBC2", {"FrontAxleSpeed": "km/h", "RelSpdFrtAxlLftWhl": "km/h"}),
    (771, "EMC1", {"MtrActTrqPct": "%", "MtrSpd": "rpm"}),
]


def a_dbc(path: Path, messages: list[tuple[int, str, dict[str, str]]]) -> Path:
    """A file with signals of 16 bits, by message and unit."""
    lines = ['VERSION ""', "BU_: A"]
    for number, name, signals in messages:
        lines.append(f"BO_ {number} {name}: 8 A")
        lines += [
            f' SG_ {signal} : {16 * i}|16@1- (0.01,0) [-300|300] "{unit}" A'
            for i, (signal, unit) in enumerate(signals.items())
        ]
        lines.append("")
    path.write_text("\n".join(lines))
    return path


IN_GERMAN = [
    (GERMAN, {
        "wheel.FL.torque": "ASM_VL_01.ASM_VL_Mom_Ist", "wheel.FR.torque": "ASM_VR_01.ASM_VR_Mom_Ist",
        "wheel.FL.speed": "ASM_VL_01.ASM_VL_Drehz", "wheel.FR.speed": "ASM_VR_01.ASM_VR_Drehz",
        "wheel.RL.load": "Radlast.Radlast_HL", "wheel.RR.load": "Radlast.Radlast_HR",
        "signals.acceleration": "Fahrdyn.Laengsbeschl", "signals.pitch": "Fahrdyn.Nickwinkel",
        "signals.draft": "Fahrdyn.Zugkraft", "signals.ground_speed": "Fahrdyn.Radar_Geschw",
    }),
    (PLURALS, {
        "wheel.FL.torque": "Antrieb_VL.Drehmoment", "wheel.FR.torque": "Antrieb_VR.Drehmoment",
        "wheel.FL.speed": "Raddrehzahlen.Rad_VL", "wheel.FR.speed": "Raddrehzahlen.Rad_VR",
        "wheel.FL.motor_speed": "Antrieb_VL.Drehzahl", "wheel.FR.motor_speed": "Antrieb_VR.Drehzahl",
        "wheel.FL.load": "Radlasten.VL", "wheel.FR.load": "Radlasten.VR", "axle.rear.load": "Achslasten.Hinten",
    }),
]  # fmt: skip


@pytest.mark.parametrize(("messages", "expected"), IN_GERMAN, ids=["names", "messages in the plural"])
def test_names_in_german_are_found(messages, expected, tmp_path, capsys):
    assert mapped(proposed(capsys, a_dbc(tmp_path / "german.dbc", messages))) == expected


def test_a_letter_names_an_axle_where_the_other_axle_has_the_same_name(tmp_path, capsys):
    both = mapped(proposed(capsys, a_dbc(tmp_path / "letters.dbc", LETTERS)))
    assert both == {
        "axle.front.torque": "MCU_F_Tq.MCU_F_TqEst", "axle.rear.torque": "MCU_R_Tq.MCU_R_TqEst",
        "axle.front.torque_limit": "MCU_F_Tq.MCU_F_TqMaxAvl", "axle.rear.torque_limit": "MCU_R_Tq.MCU_R_TqMaxAvl",
        "axle.front.load": "Scale.FrontKg", "axle.rear.load": "Scale.RearKg",
    }  # fmt: skip
    alone = mapped(proposed(capsys, a_dbc(tmp_path / "one.dbc", LETTERS[1:2])))
    assert alone["axle.?.torque"] == "MCU_R_Tq.MCU_R_TqEst"  # R may be the right one, or a revision


SIX = ("FL", "FR", "ML", "MR", "RL", "RR")
NUMBERED = ("1L", "1R", "2L", "2R", "3L", "3R")
SPELT = {
    "corners": [f"WhlSpd{w}" for w in SIX],
    "numbers": [f"Whl_{w}_Speed" for w in NUMBERED],
    "letters first": [f"W{w}Spd" for w in NUMBERED],
    "sides first": [f"WheelSpeed_{w[::-1]}" for w in NUMBERED],
    "words": [f"WheelSpeed{a}{s}" for a in ("Front", "Mid", "Rear") for s in ("Left", "Right")],
    "axles": [f"Axle{a}{s}WheelSpeed" for a in "123" for s in ("Left", "Right")],
}
"""Six wheel speeds in the spellings of several makers, from the front left to the rear right one."""


@pytest.mark.parametrize("style", SPELT)
def test_six_wheels_are_found_however_their_axles_are_called(style, tmp_path, capsys):
    names = SPELT[style]
    first, others = dict.fromkeys(names[:4], "rad/s"), dict.fromkeys(names[4:], "rad/s")
    raw = proposed(capsys, a_dbc(tmp_path / "six.dbc", [(1, "Ebs1", first), (2, "Ebs2", others)]))
    assert [axle["name"] for axle in raw["axle"]] == ["front", "middle", "rear"]
    assert [(wheel["name"], wheel["axle"]) for wheel in raw["wheel"]] == list(
        zip(SIX, ("front", "front", "middle", "middle", "rear", "rear"), strict=True)
    )
    found = [wheel["speed"].partition(".")[2] for wheel in raw["wheel"]]
    assert found == names


def test_four_axles_keep_their_numbers(tmp_path, capsys):
    messages = [(n, f"Axle{n}", {f"WhlSpd{n}{side}": "rad/s" for side in "LR"}) for n in range(1, 5)]
    raw = proposed(capsys, a_dbc(tmp_path / "eight.dbc", messages))
    assert [axle["name"] for axle in raw["axle"]] == ["1", "2", "3", "4"]
    assert [wheel["name"] for wheel in raw["wheel"]] == ["1L", "1R", "2L", "2R", "3L", "3R", "4L", "4R"]
    assert raw["wheel"][5]["speed"] == "Axle3.WhlSpd3R"


def test_a_load_pin_is_a_load_by_its_comment_and_an_axle_by_its_number(tmp_path, capsys):
    messages = [(1, "LdPins", {f"Pin{w}": "N" for w in SIX[:4]}), (2, "LdPins2", {f"Pin{w}": "N" for w in SIX[4:]})]
    pins = a_dbc(tmp_path / "pins.dbc", messages)
    comments = [f'CM_ SG_ {1 + (w[0] == "R")} Pin{w} "Vertical load of wheel {w}";' for w in SIX]
    pins.write_text("\n".join([pins.read_text(), *comments, ""]))
    found = mapped(proposed(capsys, pins))
    assert found == {f"wheel.{w}.load": f"LdPins{'2' * (w[0] == 'R')}.Pin{w}" for w in SIX}
    scale = [(1, "Scale", {f"Axle{n}Load": "kN" for n in (1, 2, 3)})]
    found = mapped(proposed(capsys, a_dbc(tmp_path / "scale.dbc", scale)))
    assert found == {f"axle.{name}.load": f"Scale.Axle{n}Load" for n, name in enumerate(("front", "middle", "rear"), 1)}


def test_a_middle_or_a_number_alone_makes_no_third_axle(tmp_path, capsys):
    speeds = {f"WhlSpd{w}": "rad/s" for w in ("FL", "FR", "RL", "RR")}
    messages = [(1, "Ebs", speeds), (2, "Motor_ML", {"Axle1Load": "N"})]
    raw = proposed(capsys, a_dbc(tmp_path / "four.dbc", messages))
    assert [wheel["name"] for wheel in raw["wheel"]] == ["FL", "FR", "RL", "RR"]
    assert "axle" not in raw


def test_what_only_a_unit_fits_is_listed_and_one_open_torque_of_no_wheel_is_that_of_an_axle(tmp_path, capsys):
    assert main(["init", "--dbc", str(a_dbc(tmp_path / "unnamed.dbc", UNNAMED))]) == 0
    text = capsys.readouterr().out
    assert "#   force: LDC.LDC1 (daN), LDC.LDC2 (daN)" in text
    assert "#   speed: EBC2.RelSpdFrtAxlLftWhl (km/h, relative to another)" in text
    found = tomllib.loads(text)
    assert not any("RelSpd" in signal for signal in mapped(found).values())  # a difference of speeds is no speed
    (axle,) = found["axle"]
    assert [axle["name"], axle["torque"], axle["motor_speed"]] == ["?", "?", "EMC1.MtrSpd"]
    assert "# EMC1.MtrActTrqPct (%, with reference_torque)" in text
    assert [wheel["driven"] for wheel in found["wheel"]] == ["?"] * 4


def test_the_remains_of_a_dbc_without_any_role_are_all_open(tmp_path, capsys):
    path = tmp_path / "doors.dbc"
    path.write_text('VERSION ""\nBU_: A\nBO_ 1 Doors: 8 A\n SG_ LeftOpen : 0|1@1+ (1,0) [0|1] "" A\n')
    found = proposed(capsys, path)
    assert mapped(found) == {}
    assert found["signals"]["ground_speed"] == "?"
    assert [wheel["speed"] for wheel in found["wheel"]] == ["?"] * 4
