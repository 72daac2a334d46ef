"""What is proportional to a noisy reading is estimated without bias, however loosely it is known."""

import pytest

from records import recorded
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.score import further_scores, scores
from soilbus.estimation.assembly import prior_of
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active

DRIVE = excited("loam", 60.0)
LOUD = reference_configuration([f"noise.{quantity}.gain=0.03" for quantity in ("torque", "load", "draft")])
LOUD = LOUD.model_copy(update={"signals": LOUD.signals.model_copy(update={"acceleration": None})})
PLAIN = reference_configuration()


@pytest.mark.parametrize("name", ["draft_gain", "inertia"])
def test_an_error_that_is_not_there_is_not_found_where_gains_are_loose(name):
    record, prior = recorded(DRIVE, 5, config=LOUD), prior_of(LOUD)
    base = fit_model([record], prior, ())
    effect = CATALOGUE[name]
    (score,) = scores([record], prior, base, [effect])
    completed = fit_model([record], prior, (effect,), score.starts)
    assert base.score < completed.score
    first = completed.parameters()[name][effect.parameters[0].name]
    assert abs(first.value) < 2.0 * first.std


def test_the_depth_of_a_pan_is_found_where_the_score_is_blind():
    pan = CATALOGUE["hardpan"]
    record, prior = recorded(DRIVE, 5, Active(pan, {"stiffness": 6.0, "depth": 0.02})), prior_of(PLAIN)
    base = fit_model([record], prior, ())
    (blind,) = scores([record], prior, base, [pan])
    best = further_scores([record], prior, base, [pan])[0]
    assert blind.fall < 5.0 < 50.0 < best.fall
    found = fit_model([record], prior, (pan,), best.starts).parameters()["hardpan"]
    assert found["depth"].value == pytest.approx(0.02, abs=4.0 * found["depth"].std + 0.001)
    assert found["stiffness"].value == pytest.approx(6.0, abs=4.0 * found["stiffness"].std)
