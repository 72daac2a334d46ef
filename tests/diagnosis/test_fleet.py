"""A fleet's diagnosis: few of the names are false, and a fault is found where it is and from its first log on."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from soilbus.diagnosis.fleet import Onset, diagnose_vehicle, named, onset_probabilities, onsets_of
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.verdict import Verdict
from soilbus.estimation.assembly import prior_of, rig_of, with_effects
from soilbus.offline.fleet import judged
from soilbus.offline.manoeuvre import record_of_recording
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE

CONFIG = reference_configuration()


def test_of_the_names_given_as_many_are_false_as_was_said():
    rng = np.random.default_rng(7)
    false, given, surest = 0, 0, 0
    for _ in range(300):
        chances = rng.beta(0.4, 0.4, 60)  # many sure either way, some in between
        true = rng.random(60) < chances  # calibrated
        chosen = np.array(named(chances.tolist(), 0.05))
        false, given = false + int((chosen & ~true).sum()), given + int(chosen.sum())
        surest += int((chances >= 0.95).sum())
    assert 0.04 < false / given < 0.06
    assert given > 1.1 * surest  # a threshold of 0.95 on each gives fewer names than the rate allows


def test_no_name_is_given_where_none_is_sure():
    assert named([]) == []
    assert named([0.6, 0.9]) == [False, False]
    assert named([0.5, 1.0, 1.0, 0.96]) == [False, True, True, True]


def test_the_onset_is_where_the_evidence_begins():
    chances = onset_probabilities([15.0, 22.0, 25.0, 11.0])
    assert np.argmax(chances) == 2
    assert sum(chances) == pytest.approx(1.0)
    assert onset_probabilities([-5.0, -5.0, -5.0])[-1] > 0.7  # none has it
    assert onset_probabilities([0.0, 0.0]) == pytest.approx([1 / 3, 1 / 3, 1 / 3])  # logs that show nothing


def record(seed: int, vehicle: int, soil: str, *effects: str) -> Record:
    drive = replace(excited(soil, 30.0), vehicle_seed=vehicle)
    recording = simulate(with_effects(CONFIG, list(effects)), drive, seed=seed)
    return record_of_recording(str(seed), recording, CONFIG)


def test_a_load_cell_that_drifted_is_found_from_the_log_on_and_a_sound_vehicle_is_left_alone():
    offset = "wheel_load_offset.offset=800"
    drifted = [record(1, 7, "loam"), record(2, 7, "dry_sand", offset), record(3, 7, "loam", offset)]
    sound = [record(4, 8, "loam"), record(5, 8, "dry_sand")]
    catalogue = [CATALOGUE[name] for name in ("wheel_load_offset", "draft_offset", "slip_sinkage", "rolling_radius")]
    faulty, healthy = (diagnose_vehicle(records, prior_of(CONFIG), catalogue) for records in (drifted, sound))
    assert not any(named(list(healthy.probabilities.values())))
    assert max(faulty.probabilities, key=faulty.probabilities.__getitem__) == "wheel_load_offset"
    assert named(list(faulty.probabilities.values()))[0]
    onset = faulty.onsets["wheel_load_offset"]
    assert onset.first == 1
    assert onset.probabilities[1] > 0.95
    assert onset.never < 0.01
    for sizes, wanted in zip(onset.sizes, (0.0, 800.0, 800.0), strict=True):
        for wheel in rig_of(CONFIG).wheels:
            estimate = sizes[f"offset_{wheel}"]
            assert abs(estimate.value - wanted) < 4.0 * estimate.std + 60.0


@pytest.mark.parametrize(("explained", "name"), [(700.0, "draft_gain"), (900.0, "grade")])
def test_logs_that_contradict_each_other_are_diagnosed_apart_where_that_explains_more(explained, name, monkeypatch):
    """Score: 1000 for both logs together, 100 for each by itself; an effect that begins explains 50 more."""

    def found(records, *_):
        best, fall = ("grade", explained) if len(records) == 2 else ("draft_gain", 50.0)
        addition = SimpleNamespace(effect=CATALOGUE[best], probability=0.9, alternatives={})
        models = {"base": SimpleNamespace(score=fall), "completed": SimpleNamespace(score=0.0)}
        return SimpleNamespace(additions=[addition], verdict=Verdict.NAMED, **models)

    fakes = {
        "diagnose": found,
        "fit_model": lambda records, *_: SimpleNamespace(score=1000.0 if len(records) == 2 else 100.0),
        "onsets_of": lambda *_: {},
    }
    for function, fake in fakes.items():
        monkeypatch.setattr(f"soilbus.diagnosis.fleet.{function}", fake)
    logs = [SimpleNamespace(training=SimpleNamespace(effects=())) for _ in range(2)]
    assert diagnose_vehicle(logs, None, []).probabilities == {name: 0.9}


def test_logs_that_contradict_the_later_ones_stay_out_whatever_explains_these(monkeypatch):
    """All logs together are explained by a wrong effect, those from the onset on by several that begin anywhere."""

    def found(records, *_):
        names = {"bulldozing": 0.999} if len(records) == 2 else {"grade": 0.4, "draft_offset": 0.4}
        best, *others = names
        alternatives = {name: names[name] for name in others}
        addition = SimpleNamespace(effect=CATALOGUE[best], probability=names[best], alternatives=alternatives)
        return SimpleNamespace(additions=[addition], verdict=Verdict.AMBIGUOUS)

    def onsets(records, prior, of):
        name = of.additions[0].effect.name
        return {name: Onset(1, (0.0, 1.0), 0.0, ()) if name == "bulldozing" else Onset(0, (0.6, 0.4), 0.0, ())}

    fakes = {"diagnose": found, "onsets_of": onsets, "fit_model": lambda *_: None}
    for name, fake in fakes.items():
        monkeypatch.setattr(f"soilbus.diagnosis.fleet.{name}", fake)
    logs = [SimpleNamespace(training=SimpleNamespace(effects=())) for _ in range(2)]
    assert diagnose_vehicle(logs, None, []).probabilities == {"grade": 0.4, "draft_offset": 0.4}


def test_the_fleet_names_what_is_sure_and_says_how_common_it_is():
    def vehicle(name: str, **chances: float) -> dict:
        effects = [{"name": effect, "probability": p, "parameters": {}, "onset": None} for effect, p in chances.items()]
        return {"vehicle": name, "verdict": "named" if chances else None, "effects": effects}

    fleet = judged([
        vehicle("a", draft_offset=0.99, slip_sinkage=0.98), vehicle("b", slip_sinkage=0.97),
        vehicle("c", slip_sinkage=0.5), vehicle("d"),
    ])  # fmt: skip
    assert [[e["name"] for e in v["effects"] if e["named"]] for v in fleet["vehicles"]] == [
        ["draft_offset", "slip_sinkage"], ["slip_sinkage"], [], [],
    ]  # fmt: skip
    shares = {effect["name"]: (effect["vehicles_named"], effect["expected_share"]) for effect in fleet["effects"]}
    assert shares["slip_sinkage"] == (2, pytest.approx(2.45 / 3))
    assert fleet["vehicles_diagnosed"] == 3


def test_what_describes_the_ground_of_a_log_has_no_onset():
    records = [record(1, 7, "loam"), record(2, 7, "dry_sand")]
    ground = SimpleNamespace(additions=[SimpleNamespace(effect=CATALOGUE[name]) for name in ("soil_drift", "grade")])
    assert onsets_of(records, prior_of(CONFIG), ground) == {}
