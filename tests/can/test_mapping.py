"""Configuration and DBC -> channels: units, gears, limits, and one clear line for each fault."""

import math
from pathlib import Path
from typing import Any

import pytest
from cantools.database.can import Database

from soilbus.can.admission import Admission
from soilbus.can.checksum import frame_checksum
from soilbus.can.dbc_files import checked_messages, load_databases
from soilbus.can.mapping import channels_of, without_unit
from soilbus.can.units import unit_of
from soilbus.config import file
from soilbus.config.file import parse_config, shipped_dbc
from soilbus.config.model import Config, ConfigError
from soilbus.report.configuration import configuration_report

G = 9.80665
DBC = """VERSION ""
BU_: X
BO_ 256 Motor: 8 X
 SG_ Torque : 0|16@1- (0.1,0) [-3000|3000] "Nm" X
 SG_ Speed : 16|16@1- (0.5,0) [-10000|10000] "rpm" X
 SG_ Limit : 32|16@1+ (0.1,0) [0|3000] "N·m" X
 SG_ State : 48|2@1+ (1,0) [0|3] "" X
BO_ 257 Wheel: 8 X
 SG_ LinearSpeed : 0|16@1+ (0.01,0) [0|100] "km/h" X
 SG_ Load : 16|16@1+ (1,0) [0|60000] "kg" X
 SG_ Grade : 32|16@1- (0.1,0) [-100|100] "%" X
 SG_ Bare : 48|16@1- (0.001,0) [-2|2] "" X
BO_ 258 Other: 8 X
 SG_ Sink : 0|16@1- (1,0) [-30000|30000] "mm" X
 SG_ Pulses : 16|16@1+ (1,0) [0|60000] "Hz" X
 SG_ Acceleration : 32|16@1- (0.001,0) [-20|20] "g" X
 SG_ Odd : 48|8@1+ (1,0) [0|250] "furlong" X
BO_ 259 Air: 8 X
 SG_ P : 0|16@1+ (2,0) [0|2000] "kPa" X
 SG_ F : 16|16@1+ (2,0) [0|2000] "N" X
 SG_ I : 32|16@1+ (1,0) [0|2000] "A" X
"""
PERCENT = {"signal": "Wheel.Grade", "reference_torque": 800.0}
NO_PERCENTAGE = "with reference_torque it must be a percentage"
SPRINGS = {"signal": "Air.P", "effective_area": 0.06}

WHEEL: dict[str, Any] = {"name": "W", "axle": "front", "radius": 0.5, "width": 0.3, "gear_ratio": 20.0}
VEHICLE = {"mass": 2000.0, "wheelbase": 2.0, "cg_ahead_of_rear_axle": 1.0, "cg_height": 0.7}


def config(folder: Path, *files: str, vehicle: bool = True, signals: Any = None, **wheel: Any) -> Config:
    if not files:
        (folder / "a.dbc").write_text(DBC, encoding="utf-8")
    raw: dict[str, Any] = {"dbc": {"input": list(files or ("a.dbc",))}, "wheel": [WHEEL | wheel]}
    raw |= {"signals": signals or {}} | ({"vehicle": VEHICLE} if vehicle else {})
    return parse_config(raw, folder=folder)


def channels(folder: Path, **more: Any) -> dict[str, Any]:
    c = config(folder, **more)
    return {channel.name: channel for channel in channels_of(c, load_databases(c))}


def faults(folder: Path, **more: Any) -> list[str]:
    with pytest.raises(ConfigError) as error:
        channels(folder, **more)
    return error.value.faults


FULL = {"torque": "Motor.Torque", "speed": "Motor.Speed", "load": "Wheel.Load"}


@pytest.mark.parametrize(
    ("quantity", "mapped", "factor"),
    [
        ("torque", "Motor.Torque", 20.0),
        ("torque", {"signal": "Motor.Torque", "at": "wheel"}, 1.0),
        ("torque", {"signal": "Motor.Torque", "sign": -1}, -20.0),
        ("torque_limit", "Motor.Limit", 20.0),
        ("speed", "Motor.Speed", math.pi / 30.0),
        ("speed", {"signal": "Motor.Speed", "at": "shaft"}, math.pi / 30.0 / 20.0),
        ("speed", {"signal": "Wheel.LinearSpeed", "sign": -1}, -1.0 / 3.6 / 0.5),
        ("load", "Wheel.Load", G),
        ("sinkage", "Other.Sink", 1e-3),
    ],
)
def test_factor_to_si_at_the_wheel(tmp_path: Path, quantity: str, mapped: Any, factor: float) -> None:
    found = channels(tmp_path, **(FULL | {quantity: mapped}))[f"{quantity}.W"]
    assert found.factor == pytest.approx(factor, rel=1e-15)
    assert found.offset == 0.0


def test_limits_come_from_the_vehicle(tmp_path: Path) -> None:
    found = channels(tmp_path, sinkage="Other.Sink", signals={"acceleration": "Other.Acceleration"}, **FULL)
    weight = 2000.0 * G
    limits = {name: (c.low, c.high) for name, c in found.items()}
    assert limits == {
        "torque.W": (-weight, weight),
        "speed.W": (-50.0, 50.0),
        "load.W": (-0.02 * weight, 5.0 * weight),
        "sinkage.W": (-0.05, 0.5),
        "acceleration": (-20.0, 20.0),
    }
    alone = channels(tmp_path, vehicle=False, **FULL)
    assert alone["load.W"].high > limits["load.W"][1]


def test_signal_without_unit_is_taken_as_si_and_told(tmp_path: Path) -> None:
    c = config(tmp_path, signals={"pitch": "Wheel.Bare"}, **FULL)
    database = load_databases(c)
    found = channels_of(c, database)
    assert [channel.name for channel in without_unit(found, database)] == ["pitch"]
    assert next(channel for channel in found if channel.name == "pitch").factor == 1.0


@pytest.mark.parametrize("valid", ["State", "Motor.State"])
def test_validity_signal(tmp_path: Path, valid: str) -> None:
    torque = {"signal": "Motor.Torque", "valid": valid, "valid_values": [1, 2]}
    found = channels(tmp_path, **(FULL | {"torque": torque}))
    assert (found["torque.W"].valid_signal, found["torque.W"].valid_values) == ("State", (1, 2))
    assert (found["speed.W"].valid_signal, found["speed.W"].valid_values) == (None, ())


def with_states(folder: Path, table: str, **more: Any) -> Any:
    """The channel of a torque that State vouches for, whose codes have the names of a value table."""
    (folder / "v.dbc").write_text(f"{DBC}VAL_ 256 State {table} ;\n" if table else DBC, encoding="utf-8")
    c = config(folder, "v.dbc", torque={"signal": "Motor.Torque", "valid": "State"} | more, speed="Motor.Speed")
    return channels_of(c, load_databases(c))[0]


@pytest.mark.parametrize(
    ("table", "codes"),
    [
        ('0 "Valid" 1 "Invalid" 2 "Init" 3 "SNA"', (0,)),
        ('0 "No fault" 1 "Fault" 2 "NotOk"', (0,)),
        ('0 "NOK" 1 "Not ok" 2 "SignalOK" 3 "Normal operation"', (2, 3)),
        ('0 "Last valid value" 1 "Good"', (1,)),
        ('0 "No" 1 "Yes" 2 "Error" 3 "Not available"', (1,)),
        ('0 "off" 1 "ready" 3 "run"', (1,)),
        ('2 "Error" 3 "Not available"', (1,)),
        ("", (1,)),
    ],
)
def test_codes_vouch_by_their_names_in_the_value_table(tmp_path: Path, table: str, codes: tuple[int, ...]) -> None:
    assert with_states(tmp_path, table).valid_values == codes


@pytest.mark.parametrize(
    ("table", "more", "line"),
    [
        ('0 "Gut" 1 "Error"', {}, 'State: 1 is "Error" in the DBC\'s value table; give valid_values'),
        (
            '0 "Valid" 1 "Invalid"', {"valid_values": [0, 1]},
            'State: 1 is "Invalid" in the DBC\'s value table; valid_values cannot hold it',
        ),
    ],
)  # fmt: skip
def test_a_code_that_the_value_table_calls_invalid_cannot_vouch(
    tmp_path: Path, table: str, more: dict[str, Any], line: str
) -> None:
    with pytest.raises(ConfigError) as error:
        with_states(tmp_path, table, **more)
    assert error.value.faults == [f"wheel.W.torque: {line}"]


@pytest.mark.parametrize(
    ("role", "mapped", "line"),
    [
        ("load", "Wheell.Load", "wheel.W.load: no message Wheell in the DBC; did you mean Wheel?"),
        ("load", "Wheel.load", "wheel.W.load: no signal load in message Wheel; did you mean Load?"),
        ("load", "Zzz.Xyz", "wheel.W.load: no message Zzz in the DBC"),
        ("load", "Motor.Limit", "wheel.W.load: Limit is in N·m, a torque; load needs N or kg"),
        ("sinkage", "Other.Odd", "wheel.W.sinkage: Odd: unit 'furlong' is not known (sinkage needs m)"),
        ("torque_limit", "Motor.Torque", "wheel.W.torque_limit: Motor.Torque is already mapped to wheel.W.torque"),
        (
            "speed",
            {"signal": "Wheel.LinearSpeed", "at": "shaft"},
            "wheel.W.speed: Wheel.LinearSpeed is in km/h: a shaft has no speed along the ground",
        ),
        ("load", {"signal": "Wheel.Load", "at": "shaft"}, "wheel.W.load: at = shaft has no meaning for load"),
        ("load", {"signal": "Wheel.Load", "valid": "Stat"}, "wheel.W.load: no signal Stat in message Wheel"),
        (
            "load",
            {"signal": "Wheel.Load", "valid": "Motor.State"},
            "wheel.W.load: valid = Motor.State is not in message Wheel, where it must be",
        ),
        (
            "torque",
            {"signal": "Motor.Torque", "valid": "State", "valid_values": [4]},
            "wheel.W.torque: valid_values [4] never occur in State, which has 0..3",
        ),
        # a percentage, a pressure or a current needs its factor, which is for nothing else
        ("torque", "Wheel.Grade", "wheel.W.torque: Grade is in %, a percentage: give its reference_torque [N m]"),
        ("torque", PERCENT | {"signal": "Motor.Torque"}, f"wheel.W.torque: Torque is in Nm; {NO_PERCENTAGE}"),
        ("torque", PERCENT | {"signal": "Wheel.Bare"}, f"wheel.W.torque: Bare is in no unit; {NO_PERCENTAGE}"),
        ("speed", PERCENT, "wheel.W.speed: reference_torque has no meaning for speed"),
        ("load", "Air.P", "wheel.W.load: P is in kPa, a pressure: give its effective_area [m^2]"),
        ("torque", SPRINGS, "wheel.W.torque: effective_area has no meaning for torque"),
        ("load", SPRINGS | {"signal": "Air.F"}, "wheel.W.load: F is in N; with effective_area it must be a pressure"),
        ("torque", "Air.I", "wheel.W.torque: I is in A, a current: give its torque_constant [N m/A]"),
        (
            "load",
            {"signal": "Wheel.Load", "unsprung_mass": 300.0},
            "configuration: wheel.W.load: unsprung_mass is for the pressure of air springs:"
            " give their effective_area, too",
        ),
        (
            "torque",
            PERCENT | {"torque_constant": 0.6},
            "configuration: wheel.W.torque: torque_constant is for a current, reference_torque for a percentage:"
            " leave out one of the two",
        ),
    ],
)
def test_a_fault_is_one_clear_line(tmp_path: Path, role: str, mapped: Any, line: str) -> None:
    assert faults(tmp_path, **(FULL | {role: mapped})) == [line]


def test_percent_and_hertz_say_why_not(tmp_path: Path) -> None:
    lines = faults(tmp_path, signals={"pitch": "Wheel.Grade"}, **(FULL | {"speed": "Other.Pulses"}))
    assert len(lines) == 2
    assert "sensor pulses" in lines[0]
    assert "speed needs rad/s or m/s" in lines[0]
    assert lines[1].startswith("signals.pitch: Grade: a percentage")


def test_every_fault_is_told_at_once(tmp_path: Path) -> None:
    assert len(faults(tmp_path, torque="No.A", speed="No.B", load="No.C", signals={"draft": "No.D"})) == 4


def test_one_limit_may_serve_several_wheels(tmp_path: Path) -> None:
    (tmp_path / "a.dbc").write_text(DBC, encoding="utf-8")
    wheels = [WHEEL | {"name": n, "torque_limit": "Motor.Limit"} for n in ("A", "B")]
    c = parse_config({"dbc": {"input": ["a.dbc"]}, "vehicle": VEHICLE, "wheel": wheels}, folder=tmp_path)
    assert [channel.name for channel in channels_of(c, load_databases(c))] == ["torque_limit.A", "torque_limit.B"]


def test_unreadable_files_are_told_one_by_one(tmp_path: Path) -> None:
    (tmp_path / "text.dbc").write_text("this is no DBC", encoding="utf-8")
    (tmp_path / "empty.dbc").write_text("", encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_databases(config(tmp_path, "missing.dbc", "text.dbc", "empty.dbc", "."))
    lines = error.value.faults
    assert [line.split(":")[1].strip() for line in lines] == ["missing.dbc", "text.dbc", "empty.dbc", "."]
    assert "No such file" in lines[0]
    assert "not a DBC" in lines[1]
    assert "not a DBC" in lines[2]
    assert not any("\n" in line for line in lines)


def test_no_dbc_at_all(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no DBC file"):
        load_databases(parse_config({}, folder=tmp_path))


def test_several_files_are_one_database(tmp_path: Path) -> None:
    (tmp_path / "b.dbc").write_text(DBC.split("BO_ 257")[0], encoding="utf-8")
    (tmp_path / "c.dbc").write_text("BO_ 257" + DBC.split("BO_ 257")[1], encoding="cp1252")
    database = load_databases(config(tmp_path, "b.dbc", "c.dbc"))
    assert sorted(m.name for m in database.messages) == ["Air", "Motor", "Other", "Wheel"]
    again = load_databases(config(tmp_path, "b.dbc", "b.dbc"))
    assert [m.name for m in again.messages] == ["Motor"]
    (tmp_path / "d.dbc").write_text(DBC.replace("(0.1,0)", "(0.2,0)"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"b.dbc and d.dbc define message Motor differently"):
        load_databases(config(tmp_path, "b.dbc", "d.dbc"))


def test_units_of_a_latin_1_file(tmp_path: Path) -> None:
    (tmp_path / "old.dbc").write_bytes(DBC.encode("cp1252"))
    c = config(tmp_path, "old.dbc", torque_limit="Motor.Limit", **FULL)
    assert any(channel.name == "torque_limit.W" for channel in channels_of(c, load_databases(c)))


def test_overlap_in_a_message_that_nobody_maps_does_no_harm(tmp_path: Path) -> None:
    overlap = 'BO_ 300 Odd: 1 X\n SG_ A : 0|8@1+ (1,0) [0|1] "" X\n SG_ B : 4|8@1+ (1,0) [0|1] "" X\n'
    (tmp_path / "o.dbc").write_text(DBC + overlap, encoding="utf-8")
    c = config(tmp_path, "o.dbc", **FULL)
    assert len(channels_of(c, load_databases(c))) == 3
    bad = config(tmp_path, "o.dbc", **(FULL | {"sinkage": "Odd.B"}))
    with pytest.raises(ConfigError, match="do not lie within 1 bytes"):
        channels_of(bad, load_databases(bad))


def test_shipped_files_are_found_by_name_and_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "site" / "soilbus"
    (package / "dbc").mkdir(parents=True)
    guard = ' SG_ Counter : 8|4@1+ (1,0) [0|15] "" X\n SG_ Checksum : 16|8@1+ (1,0) [0|255] "" X\n'
    text = f'BO_ 300 Ours: 3 X\n SG_ A : 0|8@1+ (1,0) [0|1] "" X\n{guard}'
    (package / "dbc" / "ours.dbc").write_text(text, encoding="utf-8")
    monkeypatch.setattr(file, "DBC_FOLDERS", (package / "dbc",))
    assert shipped_dbc("ours.dbc") == package / "dbc" / "ours.dbc"
    for name in ("theirs.dbc", "../soilbus/dbc/ours.dbc", ""):
        with pytest.raises(FileNotFoundError):
            shipped_dbc(name)
    work = tmp_path / "work"
    work.mkdir()
    assert checked_messages(config(work, "ours.dbc"), Database()) == {"Ours"}
    (work / "ours.dbc").write_text(text, encoding="utf-8")  # the integrator's own file comes first
    assert checked_messages(config(work, "ours.dbc"), Database()) == frozenset()


@pytest.mark.parametrize(
    ("spelling", "dimension", "factor"),
    [
        *((s, "torque", 1.0) for s in ("N.m", "Nm", "N*m", "N·m", "NM", " N m ", "N-m", "[Nm]")),
        ("kNm", "torque", 1e3),
        *((s, "torque", 1e-3) for s in ("mNm", "mN.m", "mN·m", "mN*m", "mN-m", "m N m", "mnm")),
        *((s, "torque", 1e6) for s in ("MNm", "MN.m", "MN·m", "MN*m", "MN-m", "[MN m]")),
        ("MN", "force", 1e6),
        ("mN", "force", 1e-3),
        *((s, "rotation", 1.0) for s in ("rad/s", "Rad/s", "rad·s⁻¹", "rad s^-1")),
        *(
            (s, "rotation", math.pi / 30.0)
            for s in ("rpm", "1/min", "r/min", "min⁻¹", "min-1", "RPM", "U/min", "tr/min")
        ),
        *((s, "rotation", math.pi / 180.0) for s in ("deg/s", "°/s")),
        ("N", "force", 1.0),
        ("kN", "force", 1e3),
        ("daN", "force", 10.0),
        ("kgf", "force", G),
        ("kg", "mass", 1.0),
        ("m/s", "speed", 1.0),
        *((s, "speed", 1.0 / 3.6) for s in ("km/h", "kph", "KMH")),
        ("mph", "speed", 0.44704),
        ("m", "length", 1.0),
        ("cm", "length", 0.01),
        ("mm", "length", 0.001),
        ("rad", "angle", 1.0),
        ("mrad", "angle", 1e-3),
        *((s, "angle", math.pi / 180.0) for s in ("deg", "°", "Deg")),
        *((s, "acceleration", 1.0) for s in ("m/s^2", "m/s²", "m/s2", "m/s**2", "m/(s^2)")),
        ("g", "acceleration", G),
    ],
)
def test_spellings(spelling: str, dimension: str, factor: float) -> None:
    unit = unit_of(spelling)
    assert (unit.dimension, unit.factor) == (dimension, pytest.approx(factor, rel=1e-15))


@pytest.mark.parametrize("text", [None, "", " ", "-"])
def test_no_unit(text: str | None) -> None:
    assert unit_of(text) is None


@pytest.mark.parametrize("text", ["%", "Hz", "furlong", "N/m", "Pa", "bit", "MNM", "MN.M"])
def test_units_that_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        unit_of(text)


GUARDED = """VERSION ""
BU_: X
BO_ 256 Wheel: 8 X
 SG_ Load : 0|16@1+ (1,0) [0|60000] "N" X
 SG_ Counter : 52|4@1+ (1,0) [0|15] "" X
 SG_ Checksum : 56|8@1+ (1,0) [0|255] "" X
"""


def guarded(folder: Path, checked: list[str]) -> Config:
    (folder / "own.dbc").write_text(GUARDED, encoding="utf-8")
    (folder / "a.dbc").write_text(DBC.replace(" 256 ", " 260 ").replace(" 257 Wheel", " 261 Wheels"), encoding="utf-8")
    wheel = WHEEL | {"load": "Wheel.Load"}
    raw = {"dbc": {"input": ["own.dbc", "a.dbc"], "checked": checked}, "wheel": [wheel], "vehicle": VEHICLE}
    return parse_config(raw, folder=folder)


def test_a_makers_own_message_can_be_required_to_carry_counter_and_checksum(tmp_path: Path) -> None:
    good = bytes((0x10, 0x27, 0, 0, 0, 0, 0x00))
    frames = [
        (1.0, good + bytes((frame_checksum(256, good + b"\0", 7),))),
        (1.1, good + b"\x00"),
        (1.2, good + b"\x01"),
    ]
    for checked, admitted in (([], [1.0, 1.1, 1.2]), (["Wheel"], [1.0])):
        c = guarded(tmp_path, checked)
        database = load_databases(c)
        admission = Admission(channels_of(c, database), database, checked_messages(c, database))
        for t, data in frames:
            admission.feed(t, 256, False, data)
        assert admission.take().columns["load.W"].t.tolist() == admitted
        assert ("counter and CRC required" in configuration_report(c)) == bool(checked)


def test_what_cannot_be_checked_is_a_fault(tmp_path: Path) -> None:
    c = guarded(tmp_path, ["Wheel", "Motor", "Moto"])
    with pytest.raises(ConfigError) as error:
        checked_messages(c, load_databases(c))
    assert error.value.faults == [
        "dbc.checked: Motor has no Counter and byte-aligned 8-bit Checksum",
        "dbc.checked: no message Moto in the DBC; did you mean Motor?",
    ]


def test_a_percentage_times_its_reference_is_a_torque_at_the_shaft(tmp_path):
    c = config(tmp_path, torque=PERCENT)
    (channel,) = channels_of(c, load_databases(c))
    assert channel.factor == pytest.approx(800.0 / 100.0 * 20.0)  # N m at the wheel for one per cent
    assert without_unit([channel], load_databases(c)) == []


def test_the_pressure_of_air_springs_carries_the_load(tmp_path):
    c = config(tmp_path, load=SPRINGS | {"unsprung_mass": 300.0})
    admission = Admission(channels_of(c, load_databases(c)), load_databases(c))
    admission.feed(1.0, 259, False, (200).to_bytes(2, "little") + bytes(6))
    assert admission.take().columns["load.W"].value == pytest.approx([400e3 * 0.06 + 300.0 * G])


def test_the_state_of_a_differential_lock_has_no_unit(tmp_path):
    def with_lock(signal: str) -> Config:
        (tmp_path / "a.dbc").write_text(DBC, encoding="utf-8")
        vehicle = VEHICLE | {"differential_lock": signal}
        return parse_config({"dbc": {"input": ["a.dbc"]}, "wheel": [WHEEL], "vehicle": vehicle}, folder=tmp_path)

    c = with_lock("Motor.Speed")
    with pytest.raises(ConfigError, match="Speed is in rpm; differential_lock is a state"):
        channels_of(c, load_databases(c))
    c = with_lock("Motor.State")
    assert without_unit(channels_of(c, load_databases(c)), load_databases(c)) == []
