"""Vehicles of a type: what all share is the type's, a fault is its vehicle's, and sound vehicles get no name."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from soilbus.can.log_writer import write_log
from soilbus.diagnosis.evidence import OwnParameters
from soilbus.diagnosis.vehicle_type import Factor, SharedEffect, own_probabilities, shared_effect
from soilbus.estimation.assembly import with_effects
from soilbus.estimation.nuisance_parameters import parameters_of
from soilbus.offline.batch import jobs_of, run_batch
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE

GAIN = CATALOGUE["draft_gain"]


def factor(value: float, std: float) -> Factor:
    """Of a draft gain of this value, as a vehicle's logs show it; evidence by the formula of Gaussians."""
    free = tuple(parameters_of(GAIN, 4))
    prior = free[0].std
    information = np.array([[(prior / std) ** 2]])
    own = OwnParameters(information, information @ [value / prior], free)
    fall = value**2 / (std**2 + prior**2) * (prior / std) ** 2 - np.log1p((prior / std) ** 2)
    return Factor({GAIN.name: float(fall)}, 800.0, own)


def shared(*vehicles: Factor) -> SharedEffect | None:
    return shared_effect({GAIN.name: GAIN}, [{GAIN.name: each} for each in vehicles], 4)


def test_equal_values_are_the_types_and_unequal_ones_the_vehicles():
    rng = np.random.default_rng(3)
    found = shared(*(factor(0.1 + 0.004 * e, 0.004) for e in rng.normal(size=8)))
    assert found is not None
    assert found.probability > 0.9
    assert found.vehicles == tuple(range(8))
    estimate = found.parameters["gain"]
    assert abs(estimate.value - 0.1) < 4.0 * estimate.std < 0.02
    assert shared(*(factor(value, 0.004) for value in rng.normal(0.0, 0.1, 8))) is None
    assert shared(*(factor(0.004 * e, 0.004) for e in rng.normal(size=8))) is None


def test_a_vehicle_that_differs_is_left_out_and_does_not_move_the_value():
    rng = np.random.default_rng(4)
    found = shared(factor(-0.2, 0.004), *(factor(0.1 + 0.004 * e, 0.004) for e in rng.normal(size=7)))
    assert found is not None
    assert found.vehicles == tuple(range(1, 8))
    assert abs(found.parameters["gain"].value - 0.1) < 0.01


def test_one_vehicles_fault_is_not_the_types_where_the_others_say_nothing():
    assert shared(factor(0.1, 0.004), *(factor(0.0, 0.5) for _ in range(7))) is None


def test_two_vehicles_are_no_type():
    assert shared(factor(0.1, 0.004), factor(0.1, 0.004)) is None


def test_what_is_common_in_other_vehicles_is_more_probable():
    undecided = {"draft_gain": 0.48, "lugs": 0.48}
    sure = [[{"draft_gain": 0.99}]] * 10
    (alone,), *_ = own_probabilities([[undecided], []], 20)
    (among,), *_ = own_probabilities([[undecided], *sure], 20)
    assert alone["draft_gain"] == pytest.approx(alone["lugs"])
    assert among["draft_gain"] > 0.85
    rare = own_probabilities([[{"lugs": 0.9}], *[[]] * 50], 20)[0][0]
    assert rare["lugs"] < 0.5  # of fifty vehicles none has anything


def test_how_common_an_effect_is_agrees_with_what_the_other_vehicles_have():
    rng = np.random.default_rng(1)
    chances, vehicles, names = rng.uniform(0.01, 0.2, 300), 300, 20
    found = own_probabilities([[{"lugs": p}] for p in chances], names)
    after = np.array([place["lugs"] for (place,) in found])
    others = after.sum() - after
    something = (others + 1.0) / (vehicles + 1.0)  # rule of succession: of the 299 others, and one with, one without
    share = something * (others + 1.0) / (others + names)
    odds = chances / (1.0 - chances) * names * share / (1.0 - something)
    assert after == pytest.approx(odds / (1.0 + odds), abs=1e-4)


def test_a_batch_writes_the_effects_of_types_and_vehicles(client, tmp_path):
    config = reference_configuration(["estimator.window=10", "estimator.hop=10"])
    pd = pytest.importorskip("pandas")
    truth = with_effects(config, ["drivetrain_loss.drag=110"])
    for v, soil in enumerate(("loam", "dry_sand", "wet_clay")):
        (tmp_path / f"logs/T{v}").mkdir(parents=True)
        drive = replace(excited(soil, 40.0), vehicle_seed=v)
        write_log(frames(simulate(truth, drive, seed=40 + v), config), tmp_path / f"logs/T{v}/a.log")

    def run(folder: str, say: Callable[[str], None] = lambda _: None) -> Path:
        jobs = jobs_of(config, "tractor.toml", [str(tmp_path / "logs")], lambda path: config)
        run_batch(client, jobs, tmp_path / folder, say, diagnose=True)
        return tmp_path / folder

    out = run("out")
    rows = pd.read_parquet(out / "effects.parquet")
    (drag,) = rows[(rows.effect == "drivetrain_loss") & (rows.parameter == "drag")].to_dict("records")
    assert (drag["scope"], drag["named"]) == ("type", True)
    assert pd.isna(drag["vehicle"])
    assert abs(drag["value"] - 110.0) < 4.0 * drag["std"] < 60.0
    assert not rows[rows.scope == "vehicle"].named.any()
    fleet_of_file = json.loads((out / "diagnosis.json").read_text())
    assert fleet_of_file["types"][0]["vehicles"] == ["T0", "T1", "T2"]
    before = (out / "diagnosis.json").read_bytes()
    said: list[str] = []
    run("out", said.append)
    assert (out / "diagnosis.json").read_bytes() == before
    assert not any("diagnosed" in line for line in said)
    os.utime(tmp_path / "logs/T1/a.log", (0, 0))  # another file for all that is known
    run("out", said.append)
    assert "1 of 1 vehicles diagnosed" in said
    assert (out / "diagnosis.json").read_bytes() == before
