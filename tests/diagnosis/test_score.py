"""What is proportional to a noisy reading is estimated without bias, however loosely it is known."""

from __future__ import annotations

import pytest

from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.records import Record, record_of
from soilbus.diagnosis.score import further_scores, scores
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.sensors.bins import Bins
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active

DURATION = 60.0
LOUD = [f"noise.{quantity}.gain=0.03" for quantity in ("torque", "load", "draft")]


def recorded(overrides=(), effects=()) -> tuple[Record, object]:
    config = reference_configuration(overrides)
    config = config.model_copy(update={"signals": config.signals.model_copy(update={"acceleration": None})})
    rig, store = rig_of(config), Bins(rig_of(config), 0.1, 0.0)
    channels = simulate(config, excited("loam", DURATION), 5, tuple(effects)).channels
    store.add({name: (c.t, c.value) for name, c in channels.items() if name in rig.channels})
    return record_of("x", store.window(0.0, DURATION), rig, model_of(config), 0.2, 0.15), prior_of(config)


@pytest.mark.parametrize("name", ["draft_gain", "inertia"])
def test_an_error_that_is_not_there_is_not_found_where_gains_are_loose(name):
    record, prior = recorded(LOUD)
    base = fit_model([record], prior, ())
    effect = CATALOGUE[name]
    (score,) = scores([record], prior, base, [effect])
    completed = fit_model([record], prior, (effect,), score.starts)
    assert base.score < completed.score
    first = completed.parameters()[name][effect.parameters[0].name]
    assert abs(first.value) < 2.0 * first.std


def test_the_depth_of_a_pan_is_found_where_the_score_is_blind():
    pan = CATALOGUE["hardpan"]
    record, prior = recorded(effects=[Active(pan, {"stiffness": 6.0, "depth": 0.02})])
    base = fit_model([record], prior, ())
    (blind,) = scores([record], prior, base, [pan])
    best = further_scores([record], prior, base, [pan])[0]
    assert blind.fall < 5.0 < 50.0 < best.fall
    found = fit_model([record], prior, (pan,), best.starts).parameters()["hardpan"]
    assert found["depth"].value == pytest.approx(0.02, abs=4.0 * found["depth"].std + 0.001)
    assert found["stiffness"].value == pytest.approx(6.0, abs=4.0 * found["stiffness"].std)
