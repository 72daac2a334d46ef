"""`python -m tests.lab.posterior_forms`: which Gaussian of a window's fit has honest intervals?

    mode        optimum and inverse of the information                   (`Fit.mode`)
    denoised    the same, of the window without the noise of loads       (`Fit.mode` after `with_nested_laplace`)
    laplace     averaged along n where n is not determined               (`Fit.reported`)

All are of the same windows: drives with an independent prior each, as in `monte_carlo`, or at constant slip and loads.
Of each quantity's logarithm (of tan phi itself) the table has the share of 95 % intervals that hold the truth [%], the
rms error in reported sd, and the rms error in Cramer-Rao bounds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.estimation.assembly import prior_of, rig_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.laplace import with_nested_laplace
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.posterior import NORMAL_95, PARAMETERS, Posterior, Scalar, bearing_pressure, tyre_modulus
from soilbus.report.table import table
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import soil_named
from soilbus.trials.draws import prior_about
from tests.lab.cramer_rao import cramer_rao
from tests.lab.monte_carlo import ROUGHLY_KNOWN, SLIP_RANGE, SOILS, problem_of, tasks_of

FORMS = ("mode", "denoised", "laplace")
QUANTITIES = ("pressure", "tan phi", "n", "K_L", "k_c")
DRIVES = {"2 s": (2.0, True), "10 s": (10.0, True), "10 s constant": (10.0, False)}
"""Length of the window [s] and whether slip and loads vary, by name."""
CONSTANT_SLIP, NO_SHIFT = Swing(0.15, 0.15 + 1e-6), Swing(0.0, 1e-9)


class Figures(NamedTuple):
    """Of one window: errors in reported sd (forms, quantities), in bounds (the same), processor time [s].

    `seconds` is that of the fit, `laplace_seconds` that of what is done after it.
    """

    in_sd: Array
    in_bounds: Array
    seconds: float
    laplace_seconds: float


def values_and_sd(posterior: Posterior, config: Config, width: float) -> tuple[Array, Array]:
    """QUANTITIES of a posterior and their sd: logarithms, but for tan phi; K_L of a tyre of this width [m]."""
    estimator, tan_phi = config.estimator, posterior.tan_phi()
    sd = np.sqrt(np.diag(posterior.log_covariance))

    def logarithm(scalar: Scalar) -> tuple[float, float]:
        return float(np.log(scalar.value)), posterior.propagate(scalar.gradient) / scalar.value

    def parameter(name: str) -> tuple[float, float]:
        return float(np.log(getattr(posterior.soil, name))), float(sd[PARAMETERS.index(name)])

    pairs = (
        logarithm(bearing_pressure(posterior.soil, estimator.z_ref, estimator.b_ref)),
        (tan_phi.value, tan_phi.std),
        parameter("n"),
        logarithm(tyre_modulus(posterior.soil, width)),
        parameter("k_c"),
    )
    value, std = np.array(pairs).T
    return value, std


def figures_of(config: Config, soil_name: str, varied: bool, sinkage: bool, seed: int) -> Figures | None:
    """Of one window; None where the fit does not converge."""
    duration, soil = config.estimator.window, soil_named(soil_name)
    scenario = Scenario(duration, (Patch(0.0, soil_name),), slip=SLIP_RANGE)
    if not varied:
        scenario = Scenario(
            duration, scenario.soils, slip=CONSTANT_SLIP, side_shift=NO_SHIFT, speed=Swing(1.4, 1.4 + 1e-6)
        )
    recording, rig = simulate(config, scenario, seed), rig_of(config)
    names = [n for n in rig.channels if n in recording.channels and (sinkage or not n.startswith("sinkage"))]
    problem, noiseless = (problem_of(recording, config, duration, names, of_truth) for of_truth in (False, True))
    prior = prior_about(prior_of(config), soil, np.random.default_rng([seed, 1]))
    began = time.thread_time()
    fit = fit_window(problem, prior)
    if fit is None or not fit.converged:
        return None
    between = time.thread_time()
    whole = with_nested_laplace(problem, prior, Gaussian.of(prior, problem.gain_std), fit)
    ended, width = time.thread_time(), float(rig.width.mean())
    bound = cramer_rao(noiseless, prior, soil)
    truth, least = values_and_sd(bound, config, width)
    gaussians = (fit.mode, whole.mode, whole.reported)
    found = [values_and_sd(gaussian.posterior, config, width) for gaussian in gaussians]
    off = np.array([value - truth for value, _ in found])
    return Figures(off / np.array([sd for _, sd in found]), off / least, between - began, ended - between)


def rows(place: Sequence[str], found: Sequence[Figures]) -> Iterator[list[str]]:
    """Of the table: one for each form."""
    in_sd, in_bounds = (np.array([getattr(one, of) for one in found]) for of in ("in_sd", "in_bounds"))
    held = 100.0 * np.mean(np.abs(in_sd) < NORMAL_95, axis=0)
    rms, of_bounds = (np.sqrt(np.mean(off**2, axis=0)) for off in (in_sd, in_bounds))
    for form, *columns in zip(FORMS, held, rms, of_bounds, strict=True):
        yield [
            *place,
            form,
            *(f"{h:5.1f} {r:4.2f} {b:4.2f}" for h, r, b in zip(*columns, strict=True)),
            str(len(found)),
        ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, drive, print."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.posterior_forms", description=__doc__)
    parser.add_argument("--drives", type=int, default=40, help="of each soil and window (40)")
    parser.add_argument("--seed", type=int, default=1, help="of drives, noise and priors (1)")
    parser.add_argument("--window", choices=DRIVES, action="append", help="kind of window; repeatable (all)")
    chosen = parser.parse_args(arguments)
    reference = reference_configuration(ROUGHLY_KNOWN)
    head = ("window", "sinkage", "soil", "form", *QUANTITIES, "windows")
    for window, has_sinkage in product(chosen.window or DRIVES, (True, False)):
        duration, varied = DRIVES[window]
        sinkage = "measured" if has_sinkage else "none"
        lines: list[list[str]] = []
        of_all: list[Figures] = []
        for soil in SOILS:
            tasks = tasks_of(reference, soil, duration, chosen.drives, chosen.seed)
            each = [figures_of(task.config, soil, varied, has_sinkage, task.seed) for task in tasks]
            found = [one for one in each if one is not None]
            of_all += found
            lines += rows((window, sinkage, soil), found) if found else []
        if of_all:
            print(table(head, [*lines, *rows((window, sinkage, "all"), of_all)]), flush=True)
            fit, laplace = (1e3 * float(np.mean(of)) for of in zip(*(one[2:] for one in of_all), strict=True))
            print(f"processor time of fit, and of denoising and average: {fit:.0f} ms, {laplace:.0f} ms\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
