"""What to drive next: the manoeuvre tells rivals apart, can be driven, and more recordings do not mislead the score."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from soilbus.diagnosis.diagnose import Diagnosis, diagnose
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.score import scores
from soilbus.diagnosis.search import Addition
from soilbus.diagnosis.verdict import Verdict
from soilbus.estimation.assembly import prior_of
from soilbus.offline import manoeuvre
from soilbus.offline.manoeuvre import Plan, record_of_recording, what_excites, what_to_drive
from soilbus.simulator.manoeuvre import of_json
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing, excited
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active
from soilbus.terra.soils import SOILS
from wheels_around import active

CONFIG = reference_configuration()
PRIOR = prior_of(CONFIG)


LOSS, MORE_LOSS, PUSH = (
    active("drivetrain_loss", share=0.022),
    active("drivetrain_loss", share=0.05),
    active("draft_offset", offset=300.0),
)


def recorded(scenario: Scenario, seed: int, *effects: Active) -> Record:
    return record_of_recording("drive", simulate(CONFIG, replace(scenario, vehicle_seed=7), seed, effects), CONFIG)


def made_sure(addition: Addition) -> Addition:
    name = addition.effect.name
    by_block = addition.by_block | {name: addition.by_block[name] + 1e3}
    return replace(addition, by_block=by_block, probability=1.0, alternatives=dict.fromkeys(addition.alternatives, 0.0))


@cache
def ambiguous() -> Diagnosis:
    found = diagnose([recorded(excited("dry_sand", 60.0), 4, LOSS)], PRIOR, list(CATALOGUE.values()))
    assert found.verdict is Verdict.AMBIGUOUS
    return found


@cache
def planned() -> Plan:
    return what_to_drive(ambiguous(), CONFIG)


def test_the_plan_is_within_the_vehicles_limits_and_reads_back():
    plan = planned()
    assert set(plan.between) <= {rival.names[0] for rival in ambiguous().rivals}
    assert "drivetrain_loss" in plan.between
    assert max(plan.manoeuvre.slip) < CONFIG.traversability.max_slip
    assert min(s for row in plan.separations.values() for s in row.values()) > 0.0
    again = of_json(json.dumps(plan.as_json()))
    assert again == plan.manoeuvre == of_json(json.dumps({"manoeuvre": plan.as_json()}))


@pytest.mark.parametrize(
    "text",
    [
        "x",
        '{"t": [0, 1]}',
        "[]",
        '{"t":[0,0],"slip":[0,0],"speed":[1,1],"side_load":[0,0],"slope":[0,0]}',
        '{"t":[0,1e9],"slip":[0,0],"speed":[1,1],"side_load":[0,0],"slope":[0,0]}',
        '{"t":[0,9],"slip":[0,5],"speed":[1,1],"side_load":[0,0],"slope":[0,0]}',
        '{"t":[0,9],"slip":[0,0],"speed":[1,NaN],"side_load":[0,0],"slope":[0,0]}',
        '{"t":[0,9],"slip":[0,0],"speed":[1,-1],"side_load":[0,0],"slope":[0,0]}',
        '{"t":[0,9],"slip":[0,"a"],"speed":[1,1],"side_load":[0,0],"slope":[0,0]}',
    ],
)
def test_what_is_no_manoeuvre_is_refused(text):
    with pytest.raises(ValueError, match="manoeuvre"):
        of_json(text)


def test_the_predicted_separation_is_what_a_drive_then_adds():
    """S predicts the difference of chi-squares that the rival, fitted to both, keeps over the truth: by simulation."""
    plan = planned()
    first = recorded(excited("dry_sand", 60.0), 4, LOSS)
    ground = Scenario(plan.manoeuvre.duration, (Patch(0.0, "dry_sand"),))
    gained = {name: [] for name in plan.separations["drivetrain_loss"]}
    for seed in (11, 12):
        further = recorded(plan.manoeuvre.over(ground), seed, LOSS)
        for name, found in gained.items():
            alone, both = (
                [fit_model(records, PRIOR, (CATALOGUE[n],)).score for n in (name, "drivetrain_loss")]
                for records in ([first], [first, further])
            )
            found.append((both[0] - both[1]) - (alone[0] - alone[1]))
    assert max(plan.separations["drivetrain_loss"].values()) > 20.0
    for name, predicted in plan.separations["drivetrain_loss"].items():
        assert np.mean(gained[name]) == pytest.approx(predicted, abs=2.0 * 2.0 * np.sqrt(predicted / 2.0))


def test_a_drive_that_leaves_no_doubt_is_planned(monkeypatch):
    """Probabilities of one to the last digit, by the first pattern of each column."""
    few = {column: tried[:1] for column, tried in manoeuvre.patterns(CONFIG.traversability.max_slip).items()}
    monkeypatch.setattr(manoeuvre, "patterns", lambda max_slip: few)
    found = ambiguous()
    sure = replace(found, additions=tuple(made_sure(addition) for addition in found.additions))
    assert what_to_drive(sure, CONFIG).expected_probability == 1.0


def test_what_excites_determines_a_soil_better_than_steady_driving():
    drive, expected = what_excites(CONFIG, SOILS["loam"])
    assert max(drive.slip) - min(drive.slip) > 0.3
    steady = Scenario(48.0, (Patch(0.0, "loam"),), slip=Swing(0.15, 0.15), side_shift=Swing(0.0, 0.0), slip_spread=0.0)
    fits = [fit_model([recorded(each, 5)], PRIOR, ()) for each in (steady, drive.over(excited("loam", 48.0)))]
    plain, driven = (fit.fits[-1].posterior.parameters()["n"].std for fit in fits)
    assert driven < 0.3 * plain
    assert driven == pytest.approx(expected.parameters()["n"].std, rel=0.5)


@pytest.mark.parametrize("held", ["n", "K"])
def test_what_excites_leaves_out_what_is_held(held):
    config = reference_configuration([f"soil.{held}.std=0"])
    drive, expected = what_excites(config, SOILS["loam"])
    assert max(drive.slip) - min(drive.slip) > 0.3
    assert expected.parameters()[held].std == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("hidden", [PUSH, MORE_LOSS], ids=["draft_offset", "drivetrain_loss"])
def test_of_two_recordings_the_score_predicts_what_the_fit_then_finds(hidden):
    """Gains are shared: what the first recording has put into them is not lost at the second."""
    records = [recorded(excited("loam", 40.0), seed, hidden) for seed in (1, 2)]
    base = fit_model(records, PRIOR, ())
    (score,) = scores(records, PRIOR, base, [hidden.effect])
    fitted = fit_model(records, PRIOR, (hidden.effect,), score.starts)
    fall = base.neg2_log_posterior - fitted.neg2_log_posterior
    assert fall > 100.0
    assert score.fall == pytest.approx(fall, rel=0.25)
