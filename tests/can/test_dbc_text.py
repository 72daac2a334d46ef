"""A DBC without what nobody maps says the same of what somebody does."""

from pathlib import Path

import pytest

from soilbus.can.dbc_files import load_databases, of_messages
from soilbus.can.mapping import channels_of
from soilbus.config.file import load_config, shipped_dbc
from soilbus.config.model import ConfigError
from soilbus.pipeline.intake import Intake
from soilbus.simulator.reference import TRACTOR

FIELD = Path(__file__).resolve().parents[1] / "field/field.toml"


def crowded(folder: Path, n: int, end: str = "\n") -> Path:
    """The reference vehicle's DBC with n messages more, a ninth of them of a group that the standards fix."""
    head, rest = shipped_dbc("tractor.dbc").read_text().split("\nCM_", 1)
    messages, about = [], []
    for i in range(n):
        number = (1 << 31) + (0x08FE4500 if i % 9 == 0 else 0x10000000 + 0x100 * (i // 250)) + i % 250
        messages.append(f"BO_ {number} Extra{i}: 8 Vector__XXX")
        messages += [f' SG_ S{k} : {8 * k}|8@1+ (0.5,-10) [-10|117] "km/h" Vector__XXX' for k in range(8)]
        messages.append("")
        about.append(
            f'CM_ SG_ {number} S0 "says \\"nothing\\"; of\nBO_ 99 Hidden: 8 X\n SG_ A : 0|8@1+ (1,0) [0|0] X";'
        )
        about.append(f'CM_ BO_ {number} "a; message";')
        about.append(f'VAL_ {number} S1 254 "error" 255 "not_available" ;')
        about.append(f'BA_ "GenMsgCycleTime" BO_ {number} 100;')
    text = "\n".join([head, *messages, "", "CM_" + rest.rstrip("\n"), *about, ""])
    path = folder / "crowded.dbc"
    path.write_bytes(text.replace("\n", end).encode())
    return path


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_only_what_is_mapped_or_may_be_mistaken_for_it_is_kept(tmp_path, end):
    config = load_config(TRACTOR, [f'dbc.input=["{crowded(tmp_path, 270, end)}"]'])
    whole, cut = load_databases(config), load_databases(config, mapped_only=True)
    assert len(whole.messages) > 270
    extra = {m.name for m in cut.messages if m.name.startswith("Extra")}
    assert extra == {f"Extra{i}" for i in range(0, 270, 9)}  # ground speed of the wheels, from some source
    assert repr(channels_of(config, cut)) == repr(channels_of(config, whole))
    filters = [Intake(config, database).admission.can_filters() for database in (cut, whole)]
    assert filters[0] == filters[1]
    for message in cut.messages:
        other = whole.get_message_by_name(message.name)
        assert (repr(message), message.cycle_time) == (repr(other), other.cycle_time)
        assert [layout(s) for s in message.signals] == [layout(s) for s in other.signals]


def layout(signal) -> tuple:
    """All of a signal but its comment."""
    return (
        signal.name, signal.start, signal.length, signal.byte_order, signal.is_signed, signal.scale, signal.offset,
        signal.minimum, signal.maximum, signal.unit, signal.choices, signal.multiplexer_ids,
    )  # fmt: skip


@pytest.mark.parametrize("path", [TRACTOR, FIELD, FIELD.with_name("deere.toml")])
def test_a_real_vehicle_has_the_same_channels(path):
    config = load_config(path)
    whole, cut = load_databases(config), load_databases(config, mapped_only=True)
    assert repr(channels_of(config, cut)) == repr(channels_of(config, whole))


def test_a_name_that_is_not_there_is_still_told_its_neighbours():
    config = load_config(FIELD, ["wheel.FL.torque=McuF.ShaftTorque"])
    faults = []
    for mapped_only in (False, True):
        with pytest.raises(ConfigError) as caught:
            channels_of(config, load_databases(config, mapped_only))
        faults.append(caught.value.faults)
    assert faults[0] == faults[1]


def test_a_message_that_no_parser_understands_is_left_to_the_parser():
    text = 'BO_ 1 Good: 8 A\n SG_ X : 0|8@1+ (1,0) [0|0] "" A\n\nBO_ 2 Bad 8 A\nBO_ 3 Else: 8 A\n'
    assert of_messages(text, {"Good"}) == text.replace("BO_ 3 Else: 8 A\n", "")
