"""Monte Carlo of the estimator: simulated windows, estimated one by one, beside the Cramer-Rao bound.

    RMS ratio = sqrt(mean((error / Cramer-Rao bound)^2)),    coverage = share of |error| < 1.96 std

Each window is a drive of its own: its own slips, loads, noise and gain errors, and a prior whose medians miss the truth
by as much as its sd says, so that the model holds. It is estimated without an earlier window. Errors, standard
deviations and bounds are those of logarithms. The Cramer-Rao bound is local; where a window leaves far soils possible,
posterior samples give a Bayes-risk bound beside it. An interval cannot cover 95 % at each single soil, but it can for
soils drawn around the named one (`around`).
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.estimation.assembly import effects_and_parameters_of, model_of, prior_of, rig_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.laplace import with_nested_laplace
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel, ObservationModelWithEffects
from soilbus.estimation.posterior import NORMAL_95, PARAMETERS, Posterior, SoilPrior
from soilbus.pipeline.outputs import known
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import Soil
from soilbus.trials.draws import Each, first_drive, prior_about
from soilbus.trials.windows import bins_of, exact
from tests.lab.bayes_risk_bound import BayesRisk, bayes_risk
from tests.lab.cramer_rao import cramer_rao
from tests.lab.importance_sampling import sample_posterior

__all__ = [
    "ROUGHLY_KNOWN",
    "SLIP_RANGE",
    "SOILS",
    "BayesRiskFigures",
    "Cell",
    "Task",
    "Trial",
    "as_json",
    "driven",
    "monte_carlo",
    "problem_of",
    "sensor_sets",
    "summary",
    "tasks_of",
    "trials",
]

SOILS = ("loam", "wet_clay", "dry_sand")
WINDOW_LENGTHS = (2.0, 10.0, 60.0)
"""Lengths of the windows [s]."""
SLIP_RANGE = Swing(0.05, 0.40)
"""Slip of every drive."""
ROUGHLY_KNOWN = ("soil.c.value=3000", "soil.c.std=750", "soil.K.value=0.02", "soil.K.std=0.005")
"""Settings with which cohesion and shear modulus are known to 25 %."""


class Task(NamedTuple):
    """One drive to be simulated and estimated, once for each of its `sensor_sets`.

    posterior_samples is the number of samples of the posterior beside each fit; around the sd of the free
    parameters' logarithms about the named soil (0: that soil).
    """

    config: Config
    soil: str
    duration: float
    seed: int
    posterior_samples: int = 0
    around: float = 0.0


@dataclass(frozen=True, slots=True)
class Trial:
    """One window: error, std and Cramer-Rao bound (6 + 1,) of the logarithms of parameters and bearing pressure.

    Held parameters have zeros. All are nan where the fit failed. bayes_risk is None where no posterior was sampled.
    """

    error: Array
    std: Array
    bound: Array
    chi2: float
    converged: bool
    seconds: float
    bayes_risk: BayesRisk | None = None


@dataclass(frozen=True, slots=True)
class Cell:
    """All windows of one soil, duration [s] and set of sensors.

    Attributes
    ----------
    quantities
        Names (Q,) of the free parameters and the bearing pressure.
    rms, bias
        Root mean square and mean (Q,) of error over bound.
    coverage
        Share (Q,) of 95 % intervals that hold the truth.
    bound
        Root mean square (Q,) of the bounds.
    chi2
        Mean of the reduced chi-squares. These figures are of the windows that converged.
    failed, not_converged
        Number of the other windows.
    seconds
        Median processor time [s] of a fit.
    bayes_risk
        None without posterior samples.
    """

    soil: str
    duration: float
    sinkage: bool
    windows: int
    failed: int
    not_converged: int
    quantities: tuple[str, ...]
    rms: Array
    bias: Array
    coverage: Array
    bound: Array
    chi2: float
    seconds: float
    bayes_risk: BayesRiskFigures | None = None


@dataclass(frozen=True, slots=True)
class BayesRiskFigures:
    """Bayes-risk bound of a cell's windows, in units of the Cramer-Rao bounds, for each quantity (Q,).

    Attributes
    ----------
    windows
        Windows with posterior samples.
    least, least_scatter
        RMS error below which no estimate is on all soils that the windows allow, and its standard error.
    best, ours
        RMS error at the true soil of the estimate with the least average one, and of ours.
    share, scatter
        ours / best, and its standard error (the windows are the same).
    effective
        Median effective number of posterior samples.
    """

    windows: int
    least: Array
    least_scatter: Array
    best: Array
    ours: Array
    share: Array
    scatter: Array
    effective: float


def monte_carlo(
    config: Config,
    windows: int,
    seed: int,
    soils: Sequence[str] = SOILS,
    durations: Sequence[float] = WINDOW_LENGTHS,
    each: Each = map,
    posterior_samples: int = 0,
    around: float = 0.0,
) -> Iterator[Cell]:
    """Cells of all soils and durations, each with all `sensor_sets` on the same drives.

    Parameters
    ----------
    config
        The vehicle.
    windows
        Drives in a cell.
    seed
        The same seed gives the same windows.
    soils, durations
        Names, and lengths [s].
    each
        The built-in map, or that of `processes`.
    posterior_samples
        Samples of each window's posterior; 0 for none.
    around
        Standard deviation of the logarithms of each drive's soil about the named one.

    Raises
    ------
    KeyError
        A soil is unknown.
    SimulationError
        The tractor cannot drive on one.
    """
    for name in soils:
        soil_named(name)
    places = list(product(soils, durations))
    tasks = [task for place in places for task in tasks_of(config, *place, windows, seed, posterior_samples, around)]
    results = iter(each(trials, tasks))
    for soil, duration in places:
        found = [next(results) for _ in range(windows)]
        for sinkage, of_cell in zip(sensor_sets(config), zip(*found, strict=True), strict=True):
            yield summary(soil, duration, sinkage, of_cell)


def tasks_of(
    config: Config, soil: str, duration: float, windows: int, seed: int, posterior_samples: int = 0, around: float = 0.0
) -> list[Task]:
    """Independent drives on a soil; they do not depend on the other soils asked for."""
    # The simulator's of_mean noise and the estimator's refer to the same window.
    hop = min(config.estimator.hop, duration)
    of_window = config.estimator.model_copy(update={"window": duration, "hop": hop})
    of_cell = config.model_copy(update={"estimator": of_window})
    key = [seed, zlib.crc32(soil.encode()), round(1e3 * duration)]
    seeds = np.random.SeedSequence(key).generate_state(windows)
    return [Task(of_cell, soil, duration, int(s), posterior_samples, around) for s in seeds]


def sensor_sets(config: Config) -> tuple[bool, ...]:
    """Whether sinkage is measured: with and without where a wheel has a sensor of it, else without alone."""
    return (True, False) if any(wheel.sinkage is not None for wheel in config.wheel) else (False,)


def trials(task: Task) -> tuple[Trial, ...]:
    """A drive simulated, and its window estimated with each of the `sensor_sets`.

    Raises SimulationError where the tractor cannot drive on, KeyError for an unknown soil.
    """
    recording, soil = driven(task)
    prior = prior_about(prior_of(task.config), soil, np.random.default_rng([task.seed, 1]))
    return tuple(_trial(recording, task, prior, soil, sinkage) for sinkage in sensor_sets(task.config))


def driven(task: Task) -> tuple[Recording, Soil]:
    """The drive and its soil: the named one, or the first drawn around it on which the tractor gets on."""
    config, name, duration, seed, _, around = task
    rng, named = np.random.default_rng([seed, 3]), soil_named(name)
    spread = np.where(prior_of(config).log_std > 0.0, around, 0.0)

    def draw() -> tuple[Soil, Scenario]:
        median = prior_about(SoilPrior(np.asarray(named), spread), named, rng).median if around else np.asarray(named)
        soil = Soil(*median.tolist())
        return soil, Scenario(duration, (Patch(0.0, name, soil),), slip=SLIP_RANGE)

    soil, recording = first_drive(config, draw, seed, None if around else 1)
    return recording, soil


def _trial(recording: Recording, task: Task, prior: SoilPrior, soil: Soil, sinkage: bool) -> Trial:
    config, _, duration, seed, drawn, _ = task
    names = [n for n in rig_of(config).channels if n in recording.channels and (sinkage or not n.startswith("sinkage"))]
    noisy, noiseless = (problem_of(recording, config, duration, names, of_truth) for of_truth in (False, True))
    bound = cramer_rao(noiseless, prior, soil)
    begin = time.thread_time()
    found, joint_prior = fit_window(noisy, prior), Gaussian.of(prior, noisy.gain_std)
    fit = with_nested_laplace(noisy, prior, joint_prior, found) if found is not None and found.converged else found
    seconds = time.thread_time() - begin
    if fit is None or found is None:
        nothing = np.full(len(PARAMETERS) + 1, np.nan)
        return Trial(nothing, nothing, nothing, np.nan, False, seconds)
    (value, std), (truth, least) = (_logarithms(p, config) for p in (fit.reported.posterior, bound))
    trial = Trial(value - truth, std, least, fit.chi2, fit.converged, seconds)
    if not drawn or not fit.converged:
        return trial
    posterior = sample_posterior(noisy, prior, joint_prior, found, drawn, np.random.default_rng([seed, 2]))
    if posterior is None:
        return trial
    soils = zip(np.exp(posterior.logs).tolist(), posterior.bound, strict=True)
    logarithms = [_logarithms(Posterior(Soil(*soil), covariance), config) for soil, covariance in soils]
    value, bound_of_each = (np.array(column) for column in zip(*logarithms, strict=True))
    return replace(trial, bayes_risk=bayes_risk(value, posterior.share, bound_of_each, truth))


def problem_of(
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


def summary(soil: str, duration: float, sinkage: bool, windows: Sequence[Trial]) -> Cell:
    """The figures of one cell; nan where no window converged."""
    good = [trial for trial in windows if trial.converged]
    names = (*PARAMETERS, "bearing_pressure")
    error, std, bound = (np.array([getattr(t, of) for t in good]).reshape(-1, 7) for of in ("error", "std", "bound"))
    free = bound.any(axis=0)
    error, std, bound = error[:, free], std[:, free], bound[:, free]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = error / bound
        count = np.float64(len(good))
        return Cell(
            soil=soil,
            duration=duration,
            sinkage=sinkage,
            windows=len(windows),
            failed=sum(not np.isfinite(trial.chi2) for trial in windows),
            not_converged=sum(bool(np.isfinite(trial.chi2)) and not trial.converged for trial in windows),
            quantities=tuple(names[i] for i in np.flatnonzero(free)),
            rms=np.sqrt((share**2).sum(axis=0) / count),
            bias=share.sum(axis=0) / count,
            coverage=(np.abs(error) < NORMAL_95 * std).sum(axis=0) / count,
            bound=np.sqrt((bound**2).sum(axis=0) / count),
            chi2=float(sum(trial.chi2 for trial in good) / count),
            seconds=float(np.median([trial.seconds for trial in windows])),
            bayes_risk=_bayes_risk_figures([trial for trial in good if trial.bayes_risk is not None], np.asarray(free)),
        )


def _bayes_risk_figures(windows: Sequence[Trial], free: NDArray[np.bool_]) -> BayesRiskFigures | None:
    """The figures of windows whose exact posteriors are known; None without any."""
    known = [(trial, trial.bayes_risk) for trial in windows if trial.bayes_risk is not None]
    if not known:
        return None
    ours = np.array([trial.error / trial.bound for trial, _ in known])[:, free] ** 2
    best = np.array([bayes_risk.error / trial.bound for trial, bayes_risk in known])[:, free] ** 2
    risk, weight = (
        np.array([getattr(bayes_risk, of) for _, bayes_risk in known])[..., free] for of in ("risk", "weight")
    )
    average = risk.sum(axis=0) / weight.sum(axis=0)
    off = np.sqrt(((risk - average * weight) ** 2).sum(axis=0)) / weight.sum(axis=0)
    tilt = average.argmax(axis=0), np.arange(average.shape[1])
    square = ours.sum(0) / best.sum(0)
    return BayesRiskFigures(
        windows=len(known),
        least=np.sqrt(average[tilt]),
        least_scatter=0.5 * off[tilt] / np.sqrt(average[tilt]),
        best=np.sqrt(best.mean(0)),
        ours=np.sqrt(ours.mean(0)),
        share=np.sqrt(square),
        scatter=0.5 * np.sqrt(square) * np.sqrt(((ours - square * best) ** 2).sum(0)) / ours.sum(0),
        effective=float(np.median([bayes_risk.effective for _, bayes_risk in known])),
    )


def as_json(cell: Cell) -> dict[str, Any]:
    """The cell's figures as plain objects; null for what is not a number."""
    columns = {"rms": cell.rms, "bias": cell.bias, "coverage": cell.coverage, "bound": cell.bound}
    if cell.bayes_risk is not None:
        columns |= {"least": cell.bayes_risk.least, "least_scatter": cell.bayes_risk.least_scatter}
        columns |= {"best": cell.bayes_risk.best, "rms_beside_best": cell.bayes_risk.ours}
    figures: dict[str, Any] = known({
        "soil": cell.soil, "duration": cell.duration, "sinkage": cell.sinkage, "windows": cell.windows,
        "failed": cell.failed, "not_converged": cell.not_converged, "chi2": cell.chi2, "seconds": cell.seconds,
        "quantities": {
            name: {figure: float(column[i]) for figure, column in columns.items()}
            for i, name in enumerate(cell.quantities)
        },
    })  # fmt: skip
    return figures
