"""Predictions of the observation model with effects and their derivatives, for each effect of the catalogue."""

from copy import copy

import numpy as np
import pytest

from soilbus.estimation.assembly import model_of, rig_of
from soilbus.estimation.nuisance_parameters import parameters_of
from soilbus.estimation.observation_with_effects import ObservationModelWithEffects
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import forces_with
from soilbus.terra.soils import SOILS
from soilbus.trials.windows import bins_of

SOIL = SOILS["loam"]
PULL = 0.3
"""Of every parameter, in prior std."""
NOISE = np.array(0.005)
"""S^-1 r of the balance [1/N]: one sd of 200 N."""


@pytest.fixture(scope="module")
def problems() -> dict[str, ObservationModelWithEffects]:
    """By shear law, 6 s of a drive."""
    found = {}
    for law in ("exponential", "rational"):
        config = reference_configuration([f"model.shear_law={law}"])
        channels = simulate(reference_configuration(), excited("loam", 6.0), seed=3).channels
        window = bins_of(config, channels).window(0.0, 6.0)
        found[law] = ObservationModelWithEffects(window, rig_of(config), model_of(config), 0.2)
    return found


@pytest.fixture(params=CATALOGUE)
def at(request, problems):
    """A problem with one effect, gains and latents at which the wheels just carry their loads."""
    effect = CATALOGUE[request.param]
    plain = problems[effect.base_law or "exponential"]
    free = parameters_of(effect, plain.n_wheels)
    problem = plain.with_effects([effect], free)
    gains = np.concatenate([np.zeros(problem.n_sensors), np.full(len(free), PULL)])
    latents = problem.with_entry_angles(problem.start(SOIL), SOIL, gains)
    for _ in range(4):
        there = problem._response(SOIL, gains, latents)
        latents = latents._replace(entry_angle=latents.entry_angle + there.load_residual / there.load_slope)
    return problem, gains, latents


def predicted(problem, soil, gains, latents):
    """Drawbar pull, torque and sinkage (3, N, W), and the pull beyond the measured demand (N,)."""
    response = problem._response(soil, gains, latents)
    return response.value, problem.extra_pull(gains, latents, NOISE)[0].sum(0)


def moved(problem, gains, latents):
    """Derivatives of a response by name and number, with a step and the arguments after it."""
    for i, name in enumerate(SOIL._fields):
        step = 1e-5 * getattr(SOIL, name)
        yield ("by_soil", i), step, lambda way, n=name, d=step: (
            SOIL._replace(**{n: getattr(SOIL, n) + way * d}), gains, latents
        )  # fmt: skip
    for i in range(len(problem.free)):
        nudge = 1e-4 * (np.arange(len(gains)) == problem.n_sensors + i)
        yield ("by_effects", i), 1e-4, lambda way, d=nudge: (SOIL, gains + way * d, latents)
    for field, name in (("by_load", "load"), ("by_speed", "speed"), ("by_ground", "ground_speed")):
        value = getattr(latents, name)
        step = 1e-5 * float(value.mean())
        yield (field,), step, lambda way, n=name, v=value, d=step: (
            SOIL, gains, latents._replace(**{n: v + way * d})
        )  # fmt: skip


def test_derivatives_are_those_of_the_predictions(at):
    problem, gains, latents = at
    response = problem._response(SOIL, gains, latents)
    for (field, *place), step, change in moved(problem, gains, latents):
        (up, pull_up), (down, pull_down) = (predicted(problem, *change(way)) for way in (1.0, -1.0))
        ours, expected = getattr(response, field), (up - down) / (2.0 * step)
        ours = ours[:, place[0]] if place else ours
        for one, other, size in zip(ours, expected, response.value, strict=True):
            scale = np.abs(other).max() + 1e-6 * np.abs(size).max() / step * 1e-3
            assert np.abs(one - other).max() < 1e-4 * scale, (field, place)
        if field == "by_effects":
            of_pull = (pull_up - pull_down) / (2.0 * step)
            by_effects = problem.extra_pull(gains, latents, NOISE)[1]
            assert by_effects[place[0]] == pytest.approx(of_pull, rel=1e-4, abs=1e-6)


def test_predictions_are_the_forces_after_the_hooks(at):
    problem, gains, latents = at
    (active,) = problem.active(gains[problem.n_sensors :])
    response = problem._response(SOIL, gains, latents)
    around = problem._surroundings(latents)
    state = problem._wheels(SOIL, [], latents, latents.entry_angle).state
    forces = forces_with([active], state, problem.model, around)
    load = forces[0] + (0.0 if active.effect.load is None else active.effect.load(around, active.values))
    assert load == pytest.approx(latents.load, rel=1e-9)
    assert response.value[0] == pytest.approx(forces[1], rel=1e-9)
    if active.effect.torque is None:
        assert response.value[1] == pytest.approx(forces[2], rel=1e-9)
    else:
        assert response.value[1] == pytest.approx(active.effect.torque(forces[2], around, active.values), rel=1e-9)


def test_a_mass_share_leaves_the_noise_of_the_readings_in_the_balance(problems):
    # An acceleration that takes up what loads and slips leave would make any mass share fit better.
    effect = CATALOGUE["inertia"]
    free = parameters_of(effect, problems["exponential"].n_wheels)
    problem = problems["exponential"].with_effects([effect], free)
    gains = np.zeros(problem.n_sensors + len(free))
    latents = problem.start(SOIL, gains)
    more = gains + PULL * (np.arange(len(gains)) == problem.n_sensors)
    balance = [
        problem.linearise(SOIL, g, latents).rows[:, 0].reshape(problem.n, -1)[:, problem.layout.balance]
        for g in (gains, more)
    ]
    share = PULL * free[0].std * problem.rig.chassis.mass * problem.acceleration * problem.has_balance
    assert balance[1] - balance[0] == pytest.approx(share, rel=1e-9, abs=1e-6)


@pytest.mark.parametrize(("wavelength", "counts"), [(4.0, True), (200.0, False)], ids=["bumps", "hills"])
def test_a_body_that_pitches_on_bumps_is_noise_of_the_balance(problems, wavelength, counts):
    problem = copy(problems["exponential"])
    problem.pitch = 0.02 * np.sin(2.0 * np.pi * problem.distance / wavelength)
    added = (problem.on_bumps().demand_var - problem.demand_var)[problem.has_balance]
    swing = (problem.rig.chassis.mass * 9.80665 * 0.02) ** 2 / 2.0
    assert (added > 0.3 * swing).all() if counts else (added < 0.01 * swing).all()
