"""`python -m tests.lab.computed_loads`: are intervals honest where loads are not measured?

Each drive has its own mass, centre of gravity and friction of the differentials, drawn by their priors, loads that
shake by the given rms, and a window of the estimator's length, whose prior of the soil is drawn about the truth. The
table: share of 95 % intervals that hold the truth, and rms of the errors in reported standard deviations, for bearing
pressure, tan phi and n; its last lines are of all machines and soils. The noise of loads without cells is that of
FIELD_BOUNCE, so that intervals are wider than need be on ground that shakes less.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from monte_carlo import ROUGHLY_KNOWN, SLIP_RANGE
from soilbus.arrays import Array
from soilbus.config.model import Axle, Config, Signal
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import NORMAL_95, SoilPrior
from soilbus.simulator.drive import SimulationError
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import REFERENCES, TRACTOR, reference_configuration
from soilbus.simulator.scenario import Patch, Scenario
from soilbus.terra.soils import soil_named
from soilbus.trials.draws import prior_about, processes
from soilbus.trials.windows import bins_of

CELLS = ("cells", "axle cells", "none")
"""Load cells of the wheels, of the axles, of neither."""
SOILS = ("loam", "clayey_soil_38")
FIELD_BOUNCE = 0.12
"""Rms of a wheel's load about its steady one, over it [1]: that of the field vehicle."""
BOUNCES = (0.03, FIELD_BOUNCE)
"""The same of a smooth field, and of one like the field vehicle's."""
QUANTITIES = ("pressure", "tan phi", "n")
OPEN_BIAS = 0.05
"""Share of an axle's torque by which the two sides of an open differential differ through friction."""


@dataclass(frozen=True, slots=True)
class Task:
    """One drive."""

    machine: str
    cells: str
    soil: str
    bounce: float
    seed: int


def configured(machine: str, cells: str) -> Config | None:
    """A reference machine with the load cells of CELLS, c and K known to 25 %; None where it has fewer."""
    config = reference_configuration(ROUGHLY_KNOWN, REFERENCES[machine])
    if machine != TRACTOR.stem:
        own = "axle cells" if any(axle.load is not None for axle in config.axle) else "none"
        return config if cells == own else None
    if cells == "cells":
        return config
    wheels = [wheel.model_copy(update={"load": None, "sinkage": None}) for wheel in config.wheel]
    axles = [Axle(name=name, load=Signal(signal=f"AxleLoads.{name}")) for name in ("front", "rear")]
    return config.model_copy(update={"wheel": wheels, "axle": axles if cells == "axle cells" else []})


def window_of(task: Task) -> tuple[ObservationModel, SoilPrior] | None:
    """The window of a drive and its prior; None where the soil is too soft to drive."""
    config = configured(task.machine, task.cells)
    assert config is not None
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
    """Errors of QUANTITIES in reported standard deviations; None where it cannot be driven or is not solved."""
    drive, config, soil = window_of(task), configured(task.machine, task.cells), soil_named(task.soil)
    if drive is None or config is None:
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


def tasks(drives: int, seed: int, bounces: Sequence[float]) -> Iterator[list[Task]]:
    """The drives of each line of the table."""
    for machine, cells, soil, bounce in product(REFERENCES, CELLS, SOILS, bounces):
        if configured(machine, cells) is not None:
            key = [seed, zlib.crc32(f"{machine} {soil}".encode())]
            seeds = np.random.SeedSequence(key).generate_state(drives)
            yield [Task(machine, cells, soil, bounce, int(s)) for s in seeds]


def line(title: str, found: Iterable[Array | None]) -> str:
    """Of the table."""
    off = np.array([one for one in found if one is not None]).reshape(-1, len(QUANTITIES))
    held, rms = np.mean(np.abs(off) < NORMAL_95, axis=0), np.sqrt(np.mean(off**2, axis=0))
    scatter = np.sqrt(0.95 * 0.05 / max(len(off), 1))
    figures = "  ".join(f"{100.0 * h:5.1f} {r:4.2f}" for h, r in zip(held, rms, strict=True))
    return f"{title:48}  {figures}  {len(off):5d} +- {100.0 * scatter:.1f}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, drive, print."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.computed_loads", description=__doc__)
    parser.add_argument("--drives", type=int, default=100, help="of each line (100)")
    parser.add_argument("--seed", type=int, default=1, help="of drives, noise and priors (1)")
    parser.add_argument("--bounce", type=float, action="append", help="rms of the loads over themselves; repeatable")
    parser.add_argument("--processes", type=int, default=1)
    chosen = parser.parse_args(arguments)
    print(f"{'machine':14}{'loads':12}{'soil':16}bounce  " + "  ".join(f"{q:>10}" for q in QUANTITIES) + "  drives")
    pooled: dict[str, list[Array | None]] = {}
    with processes(chosen.processes) as each:
        for of in tasks(chosen.drives, chosen.seed, chosen.bounce or BOUNCES):
            first, found = of[0], list(each(errors, of))
            print(line(f"{first.machine:14}{first.cells:12}{first.soil:16}{first.bounce:6.0%}", found), flush=True)
            pooled.setdefault(f"{'all':14}{first.cells:12}{'':16}{first.bounce:6.0%}", []).extend(found)
    for title, found in pooled.items():
        print(line(title, found))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
