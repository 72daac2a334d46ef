"""What a log decides that no name does: the driven axle, the kind of accelerometer, signs, which speed is true."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
from cantools.database.can import Database

from soilbus.can.candump import Frame
from soilbus.can.role_matching import Assignment, Slot, assigned, candidates
from soilbus.sensors.role_evidence import Facts, Recording, facts_of, weighed

GEAR, RADIUS = 24.0, 0.6
T = np.arange(0.0, 40.0, 0.05)
V = 1.5 + 0.5 * np.sin(0.5 * T)
SLIP = 0.12 + 0.08 * np.sin(0.9 * T)
PITCH = 0.06 * np.sin(0.35 * T)
FEELS = np.gradient(V, T) + 9.80665 * np.sin(PITCH)


@pytest.fixture(scope="module")
def text() -> str:
    return (Path(__file__).resolve().parent / "orchard.dbc").read_text()


def drive(**changed: np.ndarray) -> dict[str, np.ndarray]:
    """Values in the DBC's units of a rear-driven machine whose front wheels roll freely."""
    front, rear = 3.6 * V, 3.6 * V / (1.0 - SLIP)
    values = {
        "WhlSpdFrntLft": front, "WhlSpdFrntRght": front, "WhlSpdReLft": rear, "WhlSpdReRght": rear,
        "InvSpdAct": rear / 3.6 / RADIUS * GEAR * 30.0 / math.pi, "InvTrqAct": 100.0 + 300.0 * SLIP,
        "GpsSog": V, "VehSpdRef": (front + rear) / 2.0, "HtchDrft": 3.0 * SLIP, "AxlLdFrnt": np.full(len(T), 1200.0),
        "AxlLdRe": np.full(len(T), 1800.0), "ImuPtch": np.degrees(PITCH), "ImuAx": FEELS,
    }  # fmt: skip
    return values | changed


def frames(database: Database, values: Mapping[str, np.ndarray]) -> Iterator[Frame]:
    for i, t in enumerate(T):
        for message in database.messages:
            data = {s.name: float(values[s.name][i]) if s.name in values else 0.0 for s in message.signals}
            if any(s.name in values for s in message.signals):
                yield (
                    float(t),
                    message.frame_id,
                    message.is_extended_frame,
                    message.encode(data, strict=False),
                    False,
                    False,
                )


def found(text: str, values: Mapping[str, np.ndarray]) -> tuple[Assignment, Facts]:
    database = Database(strict=False)
    database.add_dbc_string(text)
    known = candidates(database)
    recording = Recording(known, database, frames(database, values))
    assignment = assigned(weighed(known, recording))
    return assignment, facts_of(assignment, recording)


def test_a_motor_of_no_name_drives_the_axle_that_turns_with_it(text):
    _, facts = found(text, drive())
    assert facts.axle == "rear"
    assert facts.per_metre["rear"] * RADIUS == pytest.approx(GEAR, rel=0.01)
    assert facts.mass == pytest.approx(3000.0)
    assert facts.backward == {}


def test_a_motor_that_turns_with_both_axles_stays_open(text):
    even = 3.6 * V / (1.0 - SLIP)
    _, facts = found(text, drive(WhlSpdFrntLft=even, WhlSpdFrntRght=even))
    assert facts.axle == ""


@pytest.mark.parametrize(
    ("reads", "kind"),
    [(FEELS, "specific_force"), (np.gradient(V, T), "kinematic"), (np.zeros(len(T)), "")],
    ids=["with gravity", "without", "neither"],
)
def test_the_slope_says_what_an_accelerometer_feels(text, reads, kind):
    assert found(text, drive(ImuAx=reads))[1].kind == kind


def test_a_level_drive_does_not_say_what_it_feels(text):
    level = drive(ImuPtch=np.zeros(len(T)), ImuAx=np.gradient(V, T))
    assert found(text, level)[1].kind == ""


def test_a_torque_or_draft_that_is_negative_all_along_is_turned(text):
    _, facts = found(text, drive(InvTrqAct=-100.0 - 300.0 * SLIP, HtchDrft=-3.0 * SLIP))
    assert set(facts.backward) == {"INV_Actual.InvTrqAct", "HCU_Hitch.HtchDrft"}


def test_a_motor_that_is_mounted_the_other_way_round_is_turned_with_its_torque(text):
    values = drive()
    back = {name: -values[name] for name in ("InvSpdAct", "InvTrqAct")}
    assert set(found(text, values | back)[1].backward) == {"INV_Actual.InvSpdAct", "INV_Actual.InvTrqAct"}


def test_of_two_speeds_of_no_name_the_one_that_slips_is_the_ground_speed(text):
    for old, new in (("GpsSog", "spd_a"), ("VehSpdRef", "spd_b"), ("Reference speed from the wheel speeds", "")):
        text = text.replace(old, new)
    values = drive()
    values |= {"spd_a": values.pop("GpsSog"), "spd_b": values.pop("VehSpdRef")}
    assignment, _ = found(text, values)
    assert assignment.asserted[Slot("ground_speed", "")].path == "INS_Motion.spd_a"


def test_motor_and_wheels_in_metres_per_second_leave_the_gear_to_the_radius(text):
    renamed = text.replace("InvTrqAct", "RearMotTrq").replace("InvSpdAct", "RearMotSpd").replace("InvTrqMax", "RearMax")
    values = drive()
    values |= {"RearMotTrq": values.pop("InvTrqAct"), "RearMotSpd": values.pop("InvSpdAct")}
    _, facts = found(renamed, values)
    assert facts.gear_ratio == {}
    assert facts.per_metre["rear"] * RADIUS == pytest.approx(GEAR, rel=0.01)
