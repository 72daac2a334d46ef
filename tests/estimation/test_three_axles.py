"""Machines with three axles: how they share their load, what they know of the soil, and how much they can pull."""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from soilbus.config.file import machine, parse_config
from soilbus.config.model import Config
from soilbus.decision.balance import Duty, balance
from soilbus.decision.wheels import wheel_table
from soilbus.estimation.assembly import motors_of, rig_of
from soilbus.estimation.instrumentation import completed
from soilbus.estimation.window import NoiseTable, forward, made_window, pairs, turning
from soilbus.terra.soils import SOILS
from soilbus.trials.draft_trials import trial
from statics import MODEL, wheel

MIDDLE = 1.5
"""Distance of the middle axle ahead of the rear one [m], of 2.4 m between the first and the last."""
PLACES = {"front": 2.4, "middle": MIDDLE, "rear": 0.0}


def six_wheels(cells: bool = True, axle: list[dict[str, Any]] | None = None, motors: bool = True) -> Config:
    """Its configuration, signals of names that no DBC has."""
    raw = tomllib.loads(machine("tractor").read_text(encoding="utf-8"))
    raw["vehicle"] = {
        "mass": 3600.0, "wheelbase": 2.4, "cg_ahead_of_rear_axle": 1.25, "cg_height": 0.8, "hitch_height": 0.5,
    }  # fmt: skip
    raw["axle"] = [{"name": "middle", "ahead_of_rear_axle": MIDDLE}] if axle is None else axle
    raw["wheel"] = []
    for name, letter in (("front", "F"), ("middle", "M"), ("rear", "R")):
        for corner in (letter + side for side in "LR"):
            of_wheel = {"name": corner, "axle": name, "radius": 0.52, "width": 0.36, "speed": f"Speeds.{corner}"}
            of_motor = {"gear_ratio": 28.0, "max_torque": 2600.0, "torque": f"Motor{corner}.Torque"}
            raw["wheel"].append(
                of_wheel | (of_motor if motors else {}) | ({"load": f"Loads.{corner}"} if cells else {})
            )
    raw["estimator"] = {} if cells else {"max_bearing_std": 0.2}
    return parse_config(raw, folder=Path())


WEIGHT = 3600.0 * 9.80665


def of_springs(draft: float) -> np.ndarray:
    """Loads [N] of the front, middle and rear axle on the level, each axle a spring below a rigid frame."""
    stiffness, x = 2.0e5, np.array([*PLACES.values()])
    moment = WEIGHT * 1.25 - draft * 0.5  # about the rear contact
    of_heave_and_pitch = stiffness * np.array([[3.0, x.sum()], [x.sum(), (x**2).sum()]])
    heave, pitch = np.linalg.solve(of_heave_and_pitch, [WEIGHT, moment])
    return np.asarray(stiffness * (heave + pitch * x))


@pytest.mark.parametrize("cells", [True, False])
def test_the_largest_draft_of_six_wheels_on_loam_is_within_its_interval(cells):
    config = six_wheels(cells)
    found = [trial(config, "loam", seed) for seed in range(16)]
    off = np.array([(each.predicted - each.true) / each.std for each in found])
    assert np.isfinite(off).all()
    assert (np.abs(off) < 1.96).sum() >= 14  # of sixteen 95 % intervals: two misses at most in 96 of 100 cases
    assert np.median([abs(each.predicted / each.true - 1.0) for each in found]) < 0.1
    assert np.median([each.std / each.true for each in found]) < 0.2


def test_the_pull_of_six_wheels_is_that_of_each_wheel_under_its_load():
    found = balance(wheel_table(np.array([SOILS["loam"]]), rig_of(six_wheels()), MODEL, np.array([0.1, 0.3])), Duty())
    for slip, pull in zip(found.slip, found.pull[0], strict=True):
        if slip not in (0.1, 0.3):
            continue
        loads = of_springs(pull)
        assert 2.0 * sum(wheel(SOILS["loam"], load / 2.0, slip, 0.52, 0.36)[1] for load in loads) == pytest.approx(
            pull, abs=1e-4 * WEIGHT
        )


def window_of(rig, truth):
    """A second of one state, each channel as the truth has it; nan where it says nothing."""
    t = np.arange(0.05, 1.0, 0.1)
    columns = [np.full(len(t), truth.get(name, np.nan)) for name in rig.channels]
    mean = np.stack(columns, axis=1)
    count = 5.0 * np.isfinite(mean)
    return completed(forward(made_window(NoiseTable.of(rig), t, mean, count, int(count.sum()))), rig)


def driving(rig, **more):
    each = {f"torque.{w}": 800.0 for w in rig.wheels} | {f"speed.{w}": 2.5 for w in rig.wheels}
    return each | {"ground_speed": 1.2, "draft": 6000.0, "pitch": 0.0, "acceleration": 0.0} | more


def test_loads_that_no_cell_measures_are_those_of_a_frame_on_springs():
    rig = rig_of(six_wheels(cells=False))
    load = window_of(rig, driving(rig)).load[0]
    assert load == pytest.approx(np.repeat(of_springs(6000.0), 2) / 2.0, rel=1e-9)


def test_a_cell_of_one_axle_leaves_the_others_to_weight_and_moment():
    middle = {"name": "middle", "ahead_of_rear_axle": MIDDLE, "load": "Loads.Middle"}
    rig = rig_of(six_wheels(cells=False, axle=[middle]))
    load = window_of(rig, driving(rig) | {"load.middle": 5000.0}).load[0]
    front, rear = load[:2].sum(), load[4:].sum()
    assert load[2:4].sum() == pytest.approx(5000.0)
    assert front + rear == pytest.approx(WEIGHT - 5000.0)
    assert front * 2.4 + 5000.0 * MIDDLE == pytest.approx(WEIGHT * 1.25 - 6000.0 * 0.5)


def test_an_axle_whose_share_is_not_sure_makes_the_loads_less_sure_and_their_sum_no_less():
    rig = rig_of(six_wheels(cells=False))
    rows = {row.kind: row for row in rig.instrumentation.load}
    frame = np.array(rows["frame"].weight)
    assert frame @ np.ones(6) == pytest.approx(0.0, abs=1e-12)
    assert frame @ np.repeat([*PLACES.values()], 2) == pytest.approx(0.0, abs=1e-12)
    assert rows["frame"].gain > 0.0
    assert sorted(row.kind for row in rig.instrumentation.load) == ["frame", *["side"] * 3, "transfer", "weight"]


def test_every_axle_has_its_left_and_right_wheel_in_a_turn():
    rig = dataclasses.replace(rig_of(six_wheels()), track=1.6)
    assert pairs(rig).T.tolist() == [[0, 1], [2, 3], [4, 5]]
    left_turn = {f"speed.{w}": 2.0 if w.endswith("L") else 3.0 for w in rig.wheels}
    assert turning(window_of(rig, driving(rig) | left_turn), rig, 0.15).all()
    one_spins = {"speed.ML": 5.0}
    assert not turning(window_of(rig, driving(rig) | one_spins), rig, 0.15).any()


def test_a_shaft_drives_three_axles_by_their_grip():
    shaft = {"name": "both", "torque": "Shaft.Torque", "motor_speed": "Shaft.Speed", "differential": "locked"}
    config = six_wheels(axle=[{"name": "middle", "ahead_of_rear_axle": MIDDLE}, shaft], motors=False)
    rig = rig_of(config)
    between = [c for c in rig.instrumentation.couplings if not c.of_axle]
    assert [(c.one, c.other, c.locked) for c in between] == [((0, 1), (2, 3), True), ((2, 3), (4, 5), True)]
    (motor,) = [m for m in motors_of(config, rig) if m.name == "both"]
    assert motor.share == pytest.approx(np.repeat(of_springs(0.0), 2) / 2.0 / WEIGHT)


def test_the_wheels_of_a_single_axle_carry_all_of_the_weight():
    raw = tomllib.loads(machine("tractor").read_text(encoding="utf-8"))
    wheels = [{k: v for k, v in of.items() if k != "load"} | {"axle": "only"} for of in raw["wheel"][2:]]
    vehicle = {"mass": 500.0, "cg_height": 0.6, "hitch_height": 0.4}
    config = parse_config(raw | {"vehicle": vehicle, "wheel": wheels, "axle": [{"name": "only"}]}, folder=Path())
    rig = rig_of(config)
    assert window_of(rig, driving(rig)).load[0] == pytest.approx([500.0 * 9.80665 / 2.0] * 2)
    assert config.vehicle.wheelbase == pytest.approx(2.0 * 0.62)


@pytest.mark.parametrize(
    ("axle", "ahead"),
    [
        ([], [1.0, 0.5, 0.0]),
        ([{"name": "rear"}, {"name": "middle", "ahead_of_rear_axle": 0.6}], [1.0, 0.25, 0.0]),
    ],
)
def test_axles_stand_front_to_rear_equally_far_apart_or_where_they_are_said_to(axle, ahead):
    assert rig_of(six_wheels(axle=axle)).ahead == pytest.approx(np.repeat(ahead, 2))
