"""Bench of growth: how the time of one iteration of a fit grows with samples and wheels.

exponent = log2(time at the largest size / time at half of it)
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from soilbus.estimation.assembly import prior_of
from soilbus.estimation.multistart import Fit
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import SoilPrior
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.wheel import Soil
from soilbus.trials.bench.figure import Figure, in_turn
from soilbus.trials.windows import fit_from_soil, observed

WHEELS = (2, 4)
WINDOW_LENGTHS = (5.0, 10.0, 20.0, 40.0)
"""Lengths of the windows [s]."""
ROUNDS = 6
"""Timed runs, of which the shortest counts."""
MAX_EXPONENT = 1.1
"""Target: all but linear."""


def exponents() -> dict[str, Figure]:
    """Return the exponents of the time for wheels and for samples, by doubling to the largest size."""
    windows = [window for wheels in WHEELS for window in problems(wheels)]
    iterations = []
    for problem, prior in windows:
        if (fit := _fit(problem, prior)) is None:
            raise AssertionError(f"no fit of {problem.n_wheels} wheels and {problem.n} instants")
        iterations.append(fit.iterations)
    times = in_turn([partial(_fit, *window) for window in windows], ROUNDS) / np.array(iterations)
    grid = 1e3 * times.reshape(len(WHEELS), len(WINDOW_LENGTHS))
    what = "exponent of the time of one iteration of a fit"
    more = (
        "An iteration of a fit takes, in ms, by wheels and length of the window:",
        "wheels" + "".join(f"{f'{length:g} s':>8}" for length in WINDOW_LENGTHS),
        *(f"{wheels:6d}" + "".join(f"{t:8.1f}" for t in row) for wheels, row in zip(WHEELS, grid, strict=True)),
    )
    return {
        "wheels_exponent": Figure(
            float(np.log2(grid[-1, -1] / grid[-2, -1])), MAX_EXPONENT,
            f"{WHEELS[-2]} wheels {grid[-2, -1]:.1f} ms, {WHEELS[-1]} wheels {grid[-1, -1]:.1f} ms",
            f"{what}, {WINDOW_LENGTHS[-1]:g} s window", at_most=True, digits=2,
        ),
        "samples_exponent": Figure(
            float(np.log2(grid[-1, -1] / grid[-1, -2])), MAX_EXPONENT,
            f"{WINDOW_LENGTHS[-2]:g} s {grid[-1, -2]:.1f} ms, {WINDOW_LENGTHS[-1]:g} s {grid[-1, -1]:.1f} ms",
            f"{what}, {WHEELS[-1]} wheels", at_most=True, digits=2, more=more,
        ),
    }  # fmt: skip


def _fit(problem: ObservationModel, prior: SoilPrior) -> Fit | None:
    return fit_from_soil(problem, prior, Soil(*prior.median.tolist()))


def problems(wheels: int) -> Iterator[tuple[ObservationModel, SoilPrior]]:
    """Yield windows of all lengths of the reference tractor with this number of wheels."""
    config = reference_configuration()
    config = config.model_copy(update={"wheel": config.wheel[:: len(config.wheel) // wheels]})
    channels = simulate(config, excited("loam", max(WINDOW_LENGTHS)), seed=1).channels
    for length in WINDOW_LENGTHS:
        yield observed(config, channels, length), prior_of(config)
