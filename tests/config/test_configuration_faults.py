"""Mistakes in a configuration are told in the words of its file, to someone who knows vehicles and not programs."""

import json
import re
import shutil
import tomllib
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from soilbus.can.dbc_files import load_databases
from soilbus.can.mapping import channels_of
from soilbus.cli.main import main
from soilbus.config.file import load_config, machine, overridden, parse_config
from soilbus.config.model import Config, ConfigError

FIELD = Path(__file__).resolve().parents[1] / "field/field.toml"
JARGON = re.compile(
    r"Input should|instance of|valid (?:dict|number|string|list|integer|boolean)|validat|pydantic|Extra inputs|"
    r"unable to parse|NoneType|type=|List should|<class|Traceback|wheel\.\d"
)


def faults(*sets: str) -> list[str]:
    with pytest.raises(ConfigError) as error:
        load_config(FIELD, sets)
    return [fault.removeprefix(f"{FIELD}: ") for fault in error.value.faults]


SIX = {"front": "F", "middle": "M", "rear": "R"}


def of_six(*axles: dict[str, Any], **changed: str) -> dict[str, Any]:
    """Three axles as `parse_config` takes them; changed: axles of wheels by name."""
    size = {"radius": 0.5, "width": 0.3}
    wheels = [{"name": letter + side, "axle": axle, **size} for axle, letter in SIX.items() for side in "LR"]
    vehicle = {"mass": 3600.0, "wheelbase": 2.4, "cg_ahead_of_rear_axle": 1.2, "cg_height": 0.8}
    wheels = [wheel | ({"axle": changed[wheel["name"]]} if wheel["name"] in changed else {}) for wheel in wheels]
    return {"vehicle": vehicle, "axle": list(axles), "wheel": wheels}


@pytest.mark.parametrize(
    ("raw", "line"),
    [
        (of_six(ML="midle"), 'wheel.ML.axle: "midle" is not one of front, middle, rear; did you mean middle?'),
        (of_six(ML="bogie"), 'wheel.ML.axle: "bogie" is not one of front, middle, rear; an axle of another name needs'),
        (of_six(FL="both"), 'wheel.FL.axle: "both" is not one of front, middle, rear'),
        (of_six({"name": "middle", "load": "A.B"}, {"name": "middle", "load": "A.C"}), "two axles are named middle"),
        (of_six({"name": "second"}), "axle second has no [[wheel]]"),
        (of_six({"name": "middle", "ahead_of_rear_axle": 2.5}), "the axles front, middle, rear must stand from the"),
        (of_six({"name": "rear", "ahead_of_rear_axle": 1.0}), "axle rear: ahead_of_rear_axle is for axles between"),
        (of_six({"name": "middle", "ahead_of_rear_axle": 1200.0}), "axle.middle.ahead_of_rear_axle: 1200 m is not"),
        (
            of_six({"name": "first"}, {"name": "middle", "ahead_of_rear_axle": 1.2}, FR="first"),
            "axle first: ahead_of_rear_axle: missing",
        ),
        (
            of_six(
                {"name": "a", "ahead_of_rear_axle": 0.6}, {"name": "b", "ahead_of_rear_axle": 1.2},
                FR="a", ML="b", MR="b",
            ),
            "the axles front, a, b, rear must stand from the front to the rear",
        ),
        (of_six() | {"wheel": [*of_six()["wheel"], of_six()["wheel"][2]]}, "two wheels are named ML"),
    ],
)  # fmt: skip
def test_a_mistake_of_axles_is_one_line(raw, line):
    with pytest.raises(ConfigError) as error:
        parse_config(raw)
    (fault,) = error.value.faults
    assert fault.removeprefix("configuration: ").startswith(line)


def test_axles_of_own_names_stand_in_the_order_of_their_tables():
    names = dict(zip(("FL", "FR", "ML", "MR", "RL", "RR"), "aabbcc", strict=True))
    config = parse_config(of_six(*({"name": name} for name in "cab"), **names))
    assert config.axles == {"c": 1.0, "a": 0.5, "b": 0.0}


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("wheel.FL.radius=500", "wheel.FL.radius: 500 m is not from 0.05 to 1.5 m; is it in mm? 500 mm are 0.5 m"),
        ("wheel.RR.radius=62", "wheel.RR.radius: 62 m is not from 0.05 to 1.5 m; is it in cm? 62 cm are 0.62 m"),
        ("vehicle.mass=2.3", "vehicle.mass: 2.3 kg is not from 20 to 60000 kg; is it in t? 2.3 t are 2300 kg"),
        (
            "soil.phi.value=23",
            "soil.phi: value: 23 rad is not from 0 to 1.05 rad; is it in degrees? 23 degrees are 0.4014 rad",
        ),
        (
            "soil.k_phi.value=1515",
            "soil.k_phi: value: 1515 N/m^(n+2) is not from 6000 to 1e+09 N/m^(n+2); is it in kN/m^(n+2)?"
            " 1515 kN/m^(n+2) are 1.515e+06 N/m^(n+2)",
        ),
        ("noise.load.relative=2", "noise.load.relative: 2 is not from 0 to 1; is it in %? 2 % are 0.02"),
        (
            "estimator.window=10000",
            "estimator.window: 10000 s is not from 0.5 to 600 s; is it in ms? 10000 ms are 10 s",
        ),
        ("noise.load=0.01", "noise.load: 0.01 is a single value; write it as a table with any of absolute, relative,"),
        ("wheel.FL.radus=0.5", "wheel.FL.radus: unknown key; did you mean radius?"),
        ("signals.ground_sped=A.B", "signals.ground_sped: unknown key; did you mean ground_speed?"),
        (
            "estimator.max_chi2=2.0",
            "estimator.max_chi2: is gone: chi-square judges no window any more: remove it;"
            " max_prediction_error, a share of torque and pull, judges now",
        ),
        (
            "estimator.min_track_load_change=0.1",
            "estimator.min_track_load_change: is gone: windows at a constant load are judged by their widths: remove"
            " it",
        ),
        ("estimatr.hop=1", "estimatr: unknown key; did you mean estimator?"),
        ("bus.chanel=can1", "bus: chanel: unknown key; did you mean channel?"),
        ("model.shear_law=rationl", 'model.shear_law: "rationl" is not one of exponential, rational; did you mean'),
        ("wheel.FL.axle=fornt", 'wheel.FL.axle: "fornt" is not one of front, middle, rear; did you mean front?'),
        ("wheel.FL.gear_ratio=24:1", 'wheel.FL.gear_ratio: "24:1" is not a number'),
        ("wheel.FL.torque=7", 'wheel.FL.torque: 7 is not "Message.Signal", nor a table with signal, sign, at,'),
        ("wheel.FL.speed=Speed", 'wheel.FL.speed.signal: "Speed" is not "Message.Signal", the names of a message and'),
        ('dbc.input="field.dbc"', 'dbc.input: "field.dbc" is not a list, such as input = ["field.dbc"]'),
        ('wheel={name="FL"}', "wheel: write [[wheel]], in two brackets, once for each wheel"),
        ("traversability.hold=1.5", "traversability.hold: 1.5 is not a whole number"),
        ("wheel.FX.radius=0.5", "--set wheel.FX.radius=0.5: no wheel.FX; there are FL, FR, RL, RR"),
        ("wheel.FL.radius=true", "wheel.FL.radius: true is not a number"),
        ('vehicle.mass="2300"', 'vehicle.mass: "2300" is not a number; write 2300, without quotes'),
        ("vehicle.cg_height=.6", 'vehicle.cg_height: ".6" is not a number; write 0.6, without quotes'),
        ("wheel.FL.driven=0", "wheel.FL.driven: 0 is neither true nor false"),
        ("signals.towing=never", "signals.towing: unknown key here; it belongs in [vehicle]"),
        ("wheel.FL.differential=open", "wheel.FL.differential: unknown key here; it belongs in [[axle]]"),
        ('axle={name="rear"}', "axle: write [[axle]], in two brackets, once for each axle"),
    ],
)
def test_a_mistake_is_told_in_words_of_the_file(override, line):
    (found,) = faults(override)
    assert found.startswith(line)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ('model.effects=[{name="slip_sinkge"}]', ["slip_sinkge; did you mean slip_sinkage?"]),
        ('model.effects=[{name="grade", slop_0=0.1}]', ["no parameter slop_0; did you mean slope_0?"]),
        ('dbc.input=["feld.dbc"]', ["feld.dbc", "did you mean field.dbc?"]),
        ('dbc.input=["tracktor.dbc"]', ["did you mean tractor.dbc?"]),
        ('dbc.checked=["WheelSpeds"]', ["no message WheelSpeds", "did you mean WheelSpeeds?"]),
        ("signals.draft.signal=DrawbarPin.Draught", ["did you mean Draft?"]),
    ],
)
def test_a_name_that_is_nearly_right_is_asked_for(override, words, capsys):
    assert main(["check", "--config", str(FIELD), "--set", override]) == 2
    err = capsys.readouterr().err
    assert all(word in err for word in words), err


@pytest.mark.parametrize("key", ["mass", "cg_ahead_of_rear_axle"])
def test_a_deviation_that_is_given_twice_is_refused(key):
    with pytest.raises(ConfigError, match=rf"{key} = {{ value, std }} and \w+_std are the same"):
        load_config(machine("tractor-2wd"), [f"vehicle.{'cg' if key.startswith('cg') else key}_std=0.01"])


def test_a_list_of_numbers_may_hold_whole_ones():
    assert load_config(FIELD, ["output.compaction=[50000, 100000, 2e5]"]).output.compaction == (5e4, 1e5, 2e5)


@pytest.mark.parametrize("key", ["max_torque=5000.0", 'motor_speed="MotorFront.ShaftSpeed"'])
def test_an_axle_of_free_wheels_has_no_motor(key):
    raw = tomllib.loads(machine("tractor-2wd").read_text())
    raw["axle"].append({"name": "front"} | tomllib.loads(key))
    with pytest.raises(ConfigError, match=f"axle front has a {key.split('=')[0]}, but each of its wheels has driven"):
        parse_config(raw)


TRACK = {"contact_length": 2.6, "width": 0.45, "sprocket_radius": 0.35}


@pytest.mark.parametrize(
    ("left", "line"),
    [
        ({"contact_length": "2.6 m"}, 'track.L.contact_length: "2.6 m" is not a number'),
        ({"contact_length": None}, "track.L.contact_length: missing"),
        ({"driven": False, "torque": "A.B"}, "track.L: track L has driven = false and a torque: leave out one of"),
    ],
)
def test_a_mistake_in_a_track_is_one_line_of_that_track(left, line):
    tracks = [{"name": "L"} | TRACK | left, {"name": "R"} | TRACK]
    tracks[0] = {key: value for key, value in tracks[0].items() if value is not None}
    with pytest.raises(ConfigError) as error:
        parse_config({"vehicle": {"mass": 6000.0, "cg_height": 0.9}, "track": tracks}, source="f")
    (only,) = error.value.faults
    assert only.startswith(f"f: {line}")


# --- wheels that are not measured ---


def without(lines: str, tmp_path: Path) -> Path:
    """The field vehicle's configuration without the lines of this pattern in the first wheel."""
    shutil.copy(FIELD.with_name("field.dbc"), tmp_path)
    first, rest = FIELD.read_text().split('name = "FR"', 1)
    (tmp_path / "c.toml").write_text(re.sub(rf"^(?:{lines}) = .*\n", "", first, flags=re.M) + 'name = "FR"' + rest)
    return tmp_path / "c.toml"


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ("torque", "wheel FL has no torque: map wheel.FL.torque"),
        ("torque|load", "wheel FL has no torque: map wheel.FL.torque or axle.front.torque, or say driven = false"),
        ("torque|load|speed", "wheel FL has no speed: map wheel.FL.speed or axle.front.motor_speed"),
    ],
)
@pytest.mark.parametrize("command", ["check", "replay"])
def test_a_wheel_that_is_not_measured_is_refused(command, lines, says, tmp_path, field_recording, capsys):
    log = [str(field_recording("clay.log.gz"))] if command == "replay" else []
    assert main([command, "--config", str(without(lines, tmp_path)), *log]) == 2
    out, err = capsys.readouterr()
    assert says in err
    assert "rolling resistance" in err
    assert out == ""


def test_an_axle_without_wheels_is_refused(capsys):
    wheels = tomllib.loads(FIELD.read_text())["wheel"][2:]
    text = "[" + ", ".join(_inline(wheel) for wheel in wheels) + "]"
    assert main(["check", "--config", str(FIELD), "--set", f"wheel={text}"]) == 2
    assert "no [[wheel]] is on the front axle" in capsys.readouterr().err


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {_inline(v)}" for k, v in value.items()) + "}"
    return json.dumps(value)


# --- what is taken for granted is said ---


def warnings(path: Path, capsys, *sets: str) -> list[str]:
    assert main(["check", "--config", str(path), *(word for text in sets for word in ("--set", text))]) == 0
    return capsys.readouterr().err.splitlines()


def two_wheel_drive(tmp_path: Path, *left_out: str) -> Path:
    """The configuration of the rear-driven machine without some of its text."""
    text = machine("tractor-2wd").read_text()
    for part in left_out:
        assert part in text
        text = text.replace(part, "")
    (tmp_path / "c.toml").write_text(text)
    return tmp_path / "c.toml"


def test_a_right_configuration_gives_no_warning(capsys):
    assert warnings(FIELD, capsys) == []


def test_noise_that_is_not_given_is_told(tmp_path, capsys):
    shutil.copy(FIELD.with_name("field.dbc"), tmp_path)
    text = FIELD.read_text()
    path = tmp_path / "c.toml"
    path.write_text(re.sub(r"\[noise\]\n(?:.+\n)+", "", text))
    (line,) = warnings(path, capsys)
    assert "warning: no [noise]" in line
    path.write_text(re.sub(r"^(?:load = \{ relative|draft = \{ absolute).*\n", "", text, flags=re.M))
    (line,) = warnings(path, capsys)
    assert "[noise] does not give load, draft" in line


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("vehicle.towing=unknown", "signals.draft is not used, so there is no GO"),
        ("vehicle.steering=skid", "with neither vehicle.track nor signals.yaw_rate"),
        ("wheel.FL.gear_ratio=24", "wheel.FL.gear_ratio = 24 concerns no signal of it"),
    ],
)
def test_what_contradicts_the_mapped_signals_or_concerns_none_is_said(override, says, capsys, tmp_path):
    config = two_wheel_drive(tmp_path, 'speed = "WheelSpeeds.FL"\n', "track = 1.50\n")
    (line,) = warnings(config, capsys, override, "noise.acceleration.absolute=0.005")
    assert says in line


def test_a_draft_that_nothing_measures_is_said_to_leave_no_go(capsys, tmp_path):
    config = two_wheel_drive(tmp_path, '[signals.draft]\nsignal = "DrawbarPin.Draft"\nvalid = "Valid"\n')
    (line,) = warnings(config, capsys)
    assert "signals.draft is not mapped" in line
    assert "no GO" in line
    assert warnings(config, capsys, "vehicle.towing=never") == []


def test_a_draft_said_to_be_unknown_is_not_read_from_a_sensor_that_shows_a_part_of_it():
    def channels(*overrides: str) -> set[str]:
        config = load_config(machine("tractor-2wd"), overrides)
        return {channel.quantity for channel in channels_of(config, load_databases(config))}

    assert channels() - channels("vehicle.towing=unknown") == {"draft"}


@pytest.mark.parametrize("kind", ["kinematic", "specific_force"])
def test_slopes_that_nothing_shows_are_said_to_count_as_drafts(kind, capsys, tmp_path):
    config = two_wheel_drive(tmp_path, 'pitch = "Attitude.Pitch"\n')
    lines = warnings(config, capsys, f"signals.acceleration.kind={kind}")
    assert ["the ground counts as level" in line for line in lines] == [True] * (kind == "kinematic")


def test_the_settings_in_force_name_each_wheel_and_axle(capsys):
    assert main(["check", "--config", "tractor-2wd"]) == 0
    assert "wheel.FL.driven" not in capsys.readouterr().out
    assert main(["check", "--config", "tractor-2wd", "--settings"]) == 0
    out = capsys.readouterr().out
    assert "\nwheel.FL.driven = False\n" in out
    assert "\naxle.rear.max_torque = 16000.0\n" in out
    assert "\nRL and RR are weighed together:" in out
    assert "\nNo load cell at FL, FR:" in out


def test_a_cohesion_in_kilopascals_is_warned_of(capsys):
    (line,) = warnings(FIELD, capsys, "soil.c.value=2.0", "soil.c.std=0.5")
    assert "is it in kPa?" in line


def test_a_configuration_that_cannot_estimate_says_so(capsys):
    assert any("nothing can be estimated" in line for line in warnings(FIELD.with_name("deere.toml"), capsys))


# --- no words of the library that checks ---


def places(model: type[BaseModel], prefix: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Dotted paths of every key; of lists, the first item's."""
    found: list[tuple[str, ...]] = []
    for name, field in model.model_fields.items():
        if name == "folder":
            continue
        path = (*prefix, name)
        found.append(path)
        for kind in _kinds(field.annotation):
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                found += places(kind, (*path, "0") if "list" in str(field.annotation) else path)
    return found


def _kinds(kind: Any) -> list[Any]:
    if get_origin(kind) in (Union, UnionType, list, dict):
        return [part for argument in get_args(kind) for part in _kinds(argument)]
    return [] if get_origin(kind) is Literal else [kind]


WRONG = st.one_of(
    st.none(), st.booleans(), st.integers(-(10**6), 10**6), st.floats(), st.text(max_size=8), st.just(10**30),
    st.lists(st.integers(), max_size=2),
    st.dictionaries(st.sampled_from(["value", "signal", "name", "x"]), st.integers(), max_size=2),
)  # fmt: skip


@given(place=st.sampled_from(places(Config)), value=WRONG)
def test_no_wrong_value_is_told_in_the_words_of_a_library(place, value):
    raw: Any = overridden(tomllib.loads(FIELD.read_text()), [])
    here = raw
    for step in place[:-1]:
        here = here[int(step)] if isinstance(here, list) and step == "0" and here else _grown(here, step)
        if here is None:
            return
    here[place[-1]] = value
    lines: list[str] = []
    try:
        parse_config(raw)
    except ConfigError as error:
        lines = error.faults
    assert [line for line in lines if JARGON.search(line)] == []


def _grown(here: Any, step: str) -> Any:
    if isinstance(here, list):
        return None
    if isinstance(here.get(step), str):
        here[step] = {"signal": here[step]}
    return here.setdefault(step, {})
