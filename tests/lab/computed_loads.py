"""Drives of machines whose loads are not measured, one window each, and how far off its estimate is.

Each drive has its own mass, centre of gravity and friction of the differentials, drawn by their priors, loads that
shake by the given rms, and a window of the estimator's length, whose prior of the soil is drawn about the truth. The
noise of loads without cells is that of FIELD_BOUNCE, so that intervals are wider than need be on ground that shakes
less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from monte_carlo import ROUGHLY_KNOWN, SLIP_RANGE
from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import SoilPrior
from soilbus.simulator.drive import SimulationError
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import REFERENCES, reference_configuration
from soilbus.simulator.scenario import Patch, Scenario
from soilbus.terra.soils import soil_named
from soilbus.trials.draws import prior_about
from soilbus.trials.windows import bins_of

FIELD_BOUNCE = 0.12
"""Rms of a wheel's load about its steady one, over it [1]: that of the field vehicle."""
OPEN_BIAS = 0.05
"""Share of an axle's torque by which the two sides of an open differential differ through friction."""


@dataclass(frozen=True, slots=True)
class Task:
    """One drive."""

    machine: str
    soil: str
    bounce: float
    seed: int


def configured(machine: str) -> Config:
    """A reference machine, c and K known to 25 %."""
    return reference_configuration(ROUGHLY_KNOWN, REFERENCES[machine])


def window_of(task: Task) -> tuple[ObservationModel, SoilPrior] | None:
    """The window of a drive and its prior; None where the soil is too soft to drive."""
    config = configured(task.machine)
    settings = config.estimator
    config = config.model_copy(update={"wheel": [wheel.model_copy(update={"sinkage": None}) for wheel in config.wheel]})
    soils = (Patch(0.0, task.soil),)
    scenario = Scenario(settings.window, soils, slip=SLIP_RANGE, bounce=task.bounce, drawn_mass=True)
    try:
        channels = simulate(with_drawn_friction(config, task.seed), scenario, task.seed).channels
    except SimulationError:
        return None
    window = bins_of(config, channels).window(0.0, settings.window)
    problem = ObservationModel(window, rig_of(config), model_of(config), settings.min_speed, settings.max_turn)
    return problem, prior_about(prior_of(config), soil_named(task.soil), np.random.default_rng([task.seed, 1]))


def with_drawn_friction(config: Config, seed: int) -> Config:
    """The machine with a friction of its open differentials that is drawn: the estimator knows its sd alone."""
    rng = np.random.default_rng([seed, 2])
    drawn = [OPEN_BIAS * abs(rng.standard_normal()) for _ in config.axle]
    return config.model_copy(update={
        "axle": [
            axle.model_copy(update={"torque_bias": bias} if axle.torque and axle.differential == "open" else {})
            for axle, bias in zip(config.axle, drawn, strict=True)
        ]
    })  # fmt: skip


def errors(task: Task) -> Array | None:
    """Errors of pressure, tan phi and n in reported standard deviations; None where it is not driven or not solved."""
    drive, config, soil = window_of(task), configured(task.machine), soil_named(task.soil)
    if drive is None:
        return None
    problem, prior = drive
    fit = fit_window(problem, prior)
    if fit is None or not fit.converged:
        return None
    posterior = fit.posterior
    z_ref, b_ref = config.estimator.z_ref, config.estimator.b_ref
    pressure, tan_phi = posterior.bearing_pressure(z_ref, b_ref), posterior.tan_phi()
    log_n = np.log(posterior.soil.n / soil.n) / np.sqrt(posterior.log_covariance[2, 2])
    return np.array([
        np.log(pressure.value / soil.bearing_pressure(z_ref, b_ref)) * pressure.value / pressure.std,
        (tan_phi.value - np.tan(soil.phi)) / tan_phi.std,
        log_n,
    ])  # fmt: skip
