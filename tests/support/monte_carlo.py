"""Simulated windows, estimated one by one, beside the Cramer-Rao bound.

Each window is a drive of its own: its own slips, loads, noise and gain errors, and a prior whose medians miss the truth
by as much as its sd says, so that the model holds. It is estimated without an earlier window. Errors, standard
deviations and bounds are those of logarithms.
"""

import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cramer_rao import cramer_rao
from driven_windows import exact
from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.estimation.assembly import effects_and_parameters_of, model_of, prior_of, rig_of
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.observation_with_effects import ObservationModelWithEffects
from soilbus.estimation.posterior import PARAMETERS, Posterior, SoilPrior
from soilbus.simulator.drive import SimulationError
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import Soil
from soilbus.trials.draws import prior_about
from soilbus.trials.windows import bins_of

SLIP_RANGE = Swing(0.05, 0.40)
"""Slip of every drive."""
ROUGHLY_KNOWN = ("soil.c.value=3000", "soil.c.std=750", "soil.K.value=0.02", "soil.K.std=0.005")
"""Settings with which cohesion and shear modulus are known to 25 %."""


class Task(NamedTuple):
    """One drive to be simulated and estimated, with sinkage sensors and without."""

    config: Config
    soil: str
    duration: float
    seed: int


@dataclass(frozen=True, slots=True)
class Trial:
    """One window: error, std and Cramer-Rao bound (6 + 1,) of the logarithms of parameters and bearing pressure.

    Held parameters have zeros. All are nan where the fit failed.
    """

    error: Array
    std: Array
    bound: Array
    chi2: float
    converged: bool


def tasks_of(config: Config, soil: str, duration: float, windows: int, seed: int) -> list[Task]:
    """Independent drives on a soil; they do not depend on the other soils asked for."""
    # The simulator's of_mean noise and the estimator's refer to the same window.
    hop = min(config.estimator.hop, duration)
    of_window = config.estimator.model_copy(update={"window": duration, "hop": hop})
    of_cell = config.model_copy(update={"estimator": of_window})
    key = [seed, zlib.crc32(soil.encode()), round(1e3 * duration)]
    return [Task(of_cell, soil, duration, int(s)) for s in np.random.SeedSequence(key).generate_state(windows)]


def trials(task: Task) -> tuple[Trial, Trial]:
    """A drive simulated, and its window estimated with sinkage sensors and without."""
    soil = soil_named(task.soil)
    recording = simulate(task.config, Scenario(task.duration, (Patch(0.0, task.soil),), slip=SLIP_RANGE), task.seed)
    if recording.bogged_at is not None:
        raise SimulationError(f"the tractor gets stuck on {task.soil}")
    prior = prior_about(prior_of(task.config), soil, np.random.default_rng([task.seed, 1]))
    return _trial(recording, task, prior, soil, True), _trial(recording, task, prior, soil, False)


def _trial(recording: Recording, task: Task, prior: SoilPrior, soil: Soil, sinkage: bool) -> Trial:
    config, duration = task.config, task.duration
    names = [n for n in rig_of(config).channels if n in recording.channels and (sinkage or not n.startswith("sinkage"))]
    noisy, noiseless = (_problem(recording, config, duration, names, of_truth) for of_truth in (False, True))
    bound, fit = cramer_rao(noiseless, prior, soil), fit_window(noisy, prior)
    if fit is None:
        nothing = np.full(len(PARAMETERS) + 1, np.nan)
        return Trial(nothing, nothing, nothing, np.nan, False)
    (value, std), (truth, least) = (_logarithms(p, config) for p in (fit.posterior, bound))
    return Trial(value - truth, std, least, fit.chi2, fit.converged)


def _problem(
    recording: Recording, config: Config, duration: float, names: Iterable[str], of_truth: bool
) -> ObservationModel:
    """The window of these channels as measured, or as it truly was at the times of the samples."""
    columns = {name: recording.channels[name] for name in names}
    if of_truth:
        columns = exact(recording, config, columns)
    window, settings = bins_of(config, columns).window(0.0, duration), config.estimator
    return ObservationModelWithEffects(
        window, rig_of(config), model_of(config), settings.min_speed, settings.max_turn,
        *effects_and_parameters_of(config),
    )  # fmt: skip


def _logarithms(posterior: Posterior, config: Config) -> tuple[Array, Array]:
    """Logarithms (7,) of the parameters and the bearing pressure, and their std."""
    bearing = posterior.bearing_pressure(config.estimator.z_ref, config.estimator.b_ref)
    soil = np.append(np.asarray(posterior.soil), bearing.value)
    with np.errstate(divide="ignore"):
        logarithms = np.log(soil)
    return logarithms, np.append(np.sqrt(np.diag(posterior.log_covariance)), bearing.std / bearing.value)
