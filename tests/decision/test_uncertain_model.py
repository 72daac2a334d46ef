"""What is not known of the effects in the model takes its share in every deviation: against Monte Carlo."""

import numpy as np
import pytest

from soilbus.decision.capability import Demand, assess
from soilbus.decision.uncertain_model import UncertainModel
from soilbus.estimation.assembly import effects_and_parameters_of, model_of, rig_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.nuisance_parameters import active_at
from soilbus.estimation.posterior import Posterior
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.effects.steady import CompletedModel
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil

SPEED, DRAWS = 1.4, 200
LOG_STD = np.array([0.15, 0.05, 0.03, 0.025, 0.05, 0.05])
SENSORS = 3
"""Gain errors of sensors that a belief carries before the effects' parameters."""
MODELS = {
    "drivetrain_loss": "{name='drivetrain_loss',share={value=0.08,std=0.03},drag={value=60.0,std=20.0}}",
    "two": "{name='multipass',stiffness={value=0.4,std=0.15},density={value=0.08,std=0.05}},"
    "{name='bulldozing',density={value=3e5,std=1e5}}",
}
FELT = ("drivetrain_loss",)
"""Where the largest draft's deviation would be wrong without the effects' share."""


def given(text: str):
    return reference_configuration([f"model.effects=[{text.replace(chr(39), chr(34))}]"])


def belief_of(config, seed: int = 3) -> tuple[Gaussian, np.ndarray]:
    """A joint belief with correlations all over, as windows leave it, and its std."""
    _, free = effects_and_parameters_of(config)
    std = np.concatenate([LOG_STD, np.full(SENSORS, 0.005), [float(f.std > 0.0) for f in free]])
    mixed = np.random.default_rng(seed).standard_normal((len(std), 3 * len(std)))
    correlation = np.corrcoef(mixed)
    correlation[0, 1:] = correlation[1:, 0] = 0.4 * correlation[0, 1:]
    pulls = np.concatenate([np.zeros(SENSORS), np.full(len(free), 0.1)])
    return Gaussian(np.array(SOILS["loam"]), pulls, correlation * np.outer(std, std)), std


def of_draw(config, gaussian, draw, torque_limit, demand):
    """The capability of one soil with one set of effects, both exactly known."""
    effects, free = effects_and_parameters_of(config)
    model = CompletedModel.of(model_of(config), active_at(effects, free, draw[6 + SENSORS :], 4), SPEED)
    known = Posterior(Soil(*np.exp(draw[:6]).tolist()), np.zeros((6, 6)))
    return assess(known, rig_of(config), model, demand, torque_limit, 0.6, 0.3)[0]


@pytest.mark.parametrize("name", MODELS)
def test_deviations_with_effects_equal_monte_carlo(name):
    config = given(MODELS[name])
    gaussian, _ = belief_of(config)
    torque_limit = np.full(4, 1300.0 if name == "drivetrain_loss" else np.nan)
    demand = Demand(2500.0, 20.0, 0.03)
    uncertain = UncertainModel.of(model_of(config), *effects_and_parameters_of(config), gaussian, 4, SPEED)
    able, _ = assess(gaussian.posterior, rig_of(config), uncertain, demand, torque_limit, 0.6, 0.3)
    held, _ = assess(gaussian.posterior, rig_of(config), uncertain.mean, demand, torque_limit, 0.6, 0.3)
    mean = np.concatenate([np.log(gaussian.soil), gaussian.gains])
    draws = np.random.default_rng(11).multivariate_normal(mean, gaussian.covariance, DRAWS, method="eigh")
    drawn = [of_draw(config, gaussian, draw, torque_limit, demand) for draw in draws]
    for quantity in (
        lambda a: a.max_draft, lambda a: a.max_pull, lambda a: a.max_grade, lambda a: a.forecast.slip,
        lambda a: a.forecast.torque, lambda a: a.forecast.deepest,
    ):  # fmt: skip
        found, values = quantity(able), np.array([quantity(each).value for each in drawn])
        assert found.std == pytest.approx(values.std(), rel=0.16)  # of which sampling: 5 % (one sigma)
        assert found.value == pytest.approx(
            values.mean(), abs=3.5 * values.std() / DRAWS**0.5 + 0.01 * abs(found.value)
        )
    assert able.max_draft.value == pytest.approx(held.max_draft.value, rel=0.01)
    if name in FELT:
        assert not 0.84 < held.max_draft.std / np.std([each.max_draft.value for each in drawn]) < 1.16
