"""`python -m tests.lab.monte_carlo`: simulated windows, estimated one by one, beside the Cramer-Rao bound.

    RMS ratio = sqrt(mean((error / Cramer-Rao bound)^2)),    coverage = share of |error| < 1.96 std

Each window is a drive of its own: its own slips, loads, noise and gain errors, and a prior whose medians miss the truth
by as much as its sd says, so that the model holds. It is estimated without an earlier window. Errors, standard
deviations and bounds are those of logarithms. An interval cannot cover 95 % at each single soil, but it can for soils
drawn around the named one (`--around`).
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.config.file import load_config, machine
from soilbus.config.model import Config
from soilbus.estimation.assembly import effects_and_parameters_of, model_of, prior_of, rig_of
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.observation_with_effects import ObservationModelWithEffects
from soilbus.estimation.posterior import NORMAL_95, PARAMETERS, Posterior, SoilPrior
from soilbus.pipeline.outputs import known
from soilbus.report.table import table
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import Soil
from soilbus.trials.draws import Each, first_drive, prior_about, processes
from soilbus.trials.windows import bins_of
from tests.lab.cramer_rao import cramer_rao
from tests.lab.driven_windows import exact

__all__ = [
    "ROUGHLY_KNOWN",
    "SLIP_RANGE",
    "SOILS",
    "Cell",
    "Task",
    "Trial",
    "as_json",
    "driven",
    "monte_carlo",
    "monte_carlo_report",
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
MAX_RMS_RATIO = 1.15
"""Target of the RMS error over the Cramer-Rao bound."""
COVERAGE = (0.93, 0.97)
"""Target of the share of 95 % intervals that hold the truth."""
MAX_CHI2_OFF = 0.03
"""Target of the distance of the mean reduced chi-square from 1."""
SHARED = """Windows are simulated with the estimator's own wheel-soil model, noise and priors: the figures show how much
of what such a window holds the estimate gets out, and that its intervals are right if the model is."""


class Task(NamedTuple):
    """One drive to be simulated and estimated, once for each of its `sensor_sets`.

    `around` is the sd of the free parameters' logarithms about the named soil; 0 for that soil.
    """

    config: Config
    soil: str
    duration: float
    seed: int
    around: float = 0.0


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
    seconds: float


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


def monte_carlo(
    config: Config,
    windows: int,
    seed: int,
    soils: Sequence[str] = SOILS,
    durations: Sequence[float] = WINDOW_LENGTHS,
    each: Each = map,
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
    tasks = [task for place in places for task in tasks_of(config, *place, windows, seed, around)]
    results = iter(each(trials, tasks))
    for soil, duration in places:
        found = [next(results) for _ in range(windows)]
        for sinkage, of_cell in zip(sensor_sets(config), zip(*found, strict=True), strict=True):
            yield summary(soil, duration, sinkage, of_cell)


def tasks_of(config: Config, soil: str, duration: float, windows: int, seed: int, around: float = 0.0) -> list[Task]:
    """Independent drives on a soil; they do not depend on the other soils asked for."""
    # The simulator's of_mean noise and the estimator's refer to the same window.
    hop = min(config.estimator.hop, duration)
    of_window = config.estimator.model_copy(update={"window": duration, "hop": hop})
    of_cell = config.model_copy(update={"estimator": of_window})
    key = [seed, zlib.crc32(soil.encode()), round(1e3 * duration)]
    seeds = np.random.SeedSequence(key).generate_state(windows)
    return [Task(of_cell, soil, duration, int(s), around) for s in seeds]


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
    config, name, duration, seed, around = task
    rng, named = np.random.default_rng([seed, 3]), soil_named(name)
    spread = np.where(prior_of(config).log_std > 0.0, around, 0.0)

    def draw() -> tuple[Soil, Scenario]:
        median = prior_about(SoilPrior(np.asarray(named), spread), named, rng).median if around else np.asarray(named)
        soil = Soil(*median.tolist())
        return soil, Scenario(duration, (Patch(0.0, name, soil),), slip=SLIP_RANGE)

    soil, recording = first_drive(config, draw, seed, None if around else 1)
    return recording, soil


def _trial(recording: Recording, task: Task, prior: SoilPrior, soil: Soil, sinkage: bool) -> Trial:
    config, duration = task.config, task.duration
    names = [n for n in rig_of(config).channels if n in recording.channels and (sinkage or not n.startswith("sinkage"))]
    noisy, noiseless = (problem_of(recording, config, duration, names, of_truth) for of_truth in (False, True))
    bound = cramer_rao(noiseless, prior, soil)
    begin = time.thread_time()
    fit = fit_window(noisy, prior)
    seconds = time.thread_time() - begin
    if fit is None:
        nothing = np.full(len(PARAMETERS) + 1, np.nan)
        return Trial(nothing, nothing, nothing, np.nan, False, seconds)
    (value, std), (truth, least) = (_logarithms(p, config) for p in (fit.posterior, bound))
    return Trial(value - truth, std, least, fit.chi2, fit.converged, seconds)


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
        )


def as_json(cell: Cell) -> dict[str, Any]:
    """The cell's figures as plain objects; null for what is not a number."""
    columns = {"rms": cell.rms, "bias": cell.bias, "coverage": cell.coverage, "bound": cell.bound}
    figures: dict[str, Any] = known({
        "soil": cell.soil, "duration": cell.duration, "sinkage": cell.sinkage, "windows": cell.windows,
        "failed": cell.failed, "not_converged": cell.not_converged, "chi2": cell.chi2, "seconds": cell.seconds,
        "quantities": {
            name: {figure: float(column[i]) for figure, column in columns.items()}
            for i, name in enumerate(cell.quantities)
        },
    })  # fmt: skip
    return figures


def monte_carlo_report(cells: Sequence[Cell]) -> str:
    """RMS ratio and coverage of each quantity, one line a cell, with marks where targets are missed."""
    names = list(dict.fromkeys(name for cell in cells for name in cell.quantities))
    head = ("soil", "window", "sinkage", *names, "chi2", "failed", "open", "fit")
    return "\n".join([table(head, [_row(cell, names) for cell in cells]), *_notes(cells), SHARED]) + "\n"


def _row(cell: Cell, names: Sequence[str]) -> tuple[str, ...]:
    n = cell.windows - cell.failed - cell.not_converged
    figures = dict(zip(cell.quantities, zip(cell.rms.tolist(), cell.coverage.tolist(), strict=True), strict=True))
    of_quantities = [_figure(*figures[name], n) if name in figures else "held" for name in names]
    chi2 = f"{cell.chi2:.3f}{_mark(abs(cell.chi2 - 1.0) - MAX_CHI2_OFF, 0.0)}"
    fitted = "measured" if cell.sinkage else "none"
    counts = (str(cell.failed), str(cell.not_converged))
    return (cell.soil, f"{cell.duration:g} s", fitted, *of_quantities, chi2, *counts, f"{1e3 * cell.seconds:.0f} ms")


def _figure(rms: float, coverage: float, n: int) -> str:
    """Such as "1.02 95.0" of n windows."""
    low, high = COVERAGE
    too_large = _mark(rms - MAX_RMS_RATIO, _rms_scatter(n))
    astray = _mark(max(low - coverage, coverage - high), _coverage_scatter(n))
    return f"{rms:.2f}{too_large} {100.0 * coverage:.1f}{astray}"


def _mark(excess: float, scatter: float) -> str:
    """How far a target is missed: ~ where chance may have done it, * where it can hardly have."""
    if excess <= 0.0:
        return ""
    return "~" if excess < 2.0 * scatter else "*"


def _rms_scatter(n: int) -> float:
    """Standard deviation of the root mean square of n standard normal errors."""
    return math.sqrt(0.5 / max(n, 1))


def _coverage_scatter(n: int) -> float:
    """Standard deviation of the share of n 95 % intervals that hold the truth."""
    return math.sqrt(0.95 * 0.05 / max(n, 1))


def _notes(cells: Sequence[Cell]) -> Iterator[str]:
    n = min(cell.windows for cell in cells)
    low, high = (100.0 * share for share in COVERAGE)
    yield "Each quantity: RMS error over the Cramér-Rao bound, and share of 95 % intervals that hold the truth [%]."
    yield f"Targets: at most {MAX_RMS_RATIO}; {low:.0f} to {high:.0f} %; chi2 1 +- {MAX_CHI2_OFF}."
    scatter = f"{_rms_scatter(n):.3f} and the other by {100.0 * _coverage_scatter(n):.1f} points"
    yield f"{n} windows scatter the one by {scatter}"
    yield "by chance: ~ marks a target missed by less than twice that, * one missed by more."
    yield "failed: no optimum; open: not converged; both are left out.  fit: median processor time, from cold."


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the report, and keep the figures as JSON if asked."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.monte_carlo", description=__doc__)
    parser.add_argument("--config", default="tractor", help="TOML configuration or a reference machine's name")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a value")
    parser.add_argument("--windows", type=int, default=200, help="of each kind (200)")
    parser.add_argument("--around", type=float, default=0.0, help="std of soils' log (0)")
    parser.add_argument("--seed", type=int, default=1, help="of drives, noise and priors (1)")
    parser.add_argument("--json", type=Path, help="write the figures as JSON")
    chosen = parser.parse_args(arguments)
    config = load_config(machine(chosen.config), [*ROUGHLY_KNOWN, *chosen.set])
    with processes(os.cpu_count() or 1) as each:
        cells = list(monte_carlo(config, chosen.windows, chosen.seed, each=each, around=chosen.around))
    if chosen.json is not None:
        chosen.json.write_text(json.dumps([as_json(cell) for cell in cells]))
    print(monte_carlo_report(cells), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
