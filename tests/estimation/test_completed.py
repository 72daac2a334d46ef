"""The completed model's derivatives along the contact's tangent are those of the contact itself."""

from __future__ import annotations

import numpy as np
import pytest

from soilbus.assembly import model_of, rig_of
from soilbus.estimation.completed import CompletedProblem
from soilbus.estimation.effect_parameters import parameters_of
from soilbus.estimation.window import BinStore
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.soils import SOILS
from soilbus.terra.tangent import Tangent
from soilbus.terra.wheel import wheel_forces

SOIL = SOILS["loam"]
PULL = 0.3
"""Of every parameter, in prior std."""


@pytest.fixture(scope="module")
def problems() -> dict[str, CompletedProblem]:
    """By shear law, 6 s of a drive."""
    found = {}
    for law in ("exponential", "rational"):
        config = reference_configuration([f"model.shear_law={law}"])
        rig, store = rig_of(config), BinStore(rig_of(config), 0.1, 0.0)
        channels = simulate(reference_configuration(), excited("loam", 6.0), seed=3).channels
        store.add({name: (c.t, c.value) for name, c in channels.items() if name in rig.channels})
        found[law] = CompletedProblem(store.window(0.0, 6.0), rig, model_of(config), 0.2)
    return found


@pytest.mark.parametrize("name", CATALOGUE)
def test_the_tangent_serves_as_well_as_the_contact(problems, monkeypatch, name):
    effect = CATALOGUE[name]
    plain = problems[effect.base_law or "exponential"]
    free = parameters_of(effect, plain.n_wheels)
    problem = plain.completed([effect], free)
    gains = np.concatenate([np.zeros(problem.n_sensors), np.full(len(free), PULL)])
    latents = problem.carried(problem.start(SOIL), SOIL, gains)
    fast = problem._response(SOIL, gains, latents)
    monkeypatch.setattr(Tangent, "at", lambda self, state, model: wheel_forces(state, model))
    slow = problem._response(SOIL, gains, latents)
    for field, told, expected in zip(fast._fields, fast, slow, strict=True):
        for one, other in zip(*(a.reshape(-1, *a.shape[-2:]) for a in (told, expected)), strict=True):
            scale = np.abs(other).max(initial=1e-12)
            assert np.abs(one - other).max(initial=0.0) < 1e-4 * scale, field
