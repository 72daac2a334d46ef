"""Bench of growth: how the time of a Gauss-Newton step grows with samples and wheels.

exponent = log2(time at the largest size / time at half of it)
time = fixed + each (wheels x instants)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.can.channels import Column
from soilbus.config.model import Config, Wheel
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.solver import Iterate, Objective
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.trials.bench.figure import Figure, in_turn
from soilbus.trials.windows import observed

WHEELS = (1, 2, 4, 8)
WINDOW_LENGTHS = (5.0, 10.0, 20.0, 40.0)
"""Lengths of the windows [s]."""
ROUNDS = 12
"""Timed runs, of which the shortest counts."""
STEPS = 5
"""Gauss-Newton steps that are timed in a row."""
MAX_EXPONENT = 1.1
"""Target: all but linear."""


def exponents() -> dict[str, Figure]:
    """The exponents for wheels and for samples.

    They are those of doubling to the largest size, where the fixed time hides least. A fit takes about a dozen steps at
    any size.
    """
    sizes, works, iterations = [], [], []
    for wheels in WHEELS:
        for problem, prior in problems(wheels):
            fit = fit_window(problem, prior)
            if fit is None:
                raise AssertionError(f"no fit of {wheels} wheels and {problem.n} instants")
            sizes.append(wheels * problem.n)
            iterations.append(fit.iterations)
            works.append(_steps(problem, prior, fit.mode.soil))
    size, times = np.array(sizes, float), in_turn(works, ROUNDS) / STEPS
    fixed, each = line(size, times)
    off = float(np.max(np.abs((fixed + each * size) / times - 1.0)))
    grid = times.reshape(len(WHEELS), len(WINDOW_LENGTHS))
    what = "exponent of one Gauss-Newton step's time"
    more = (
        f"A Gauss-Newton step takes {1e3 * fixed:.1f} ms + {1e6 * each:.1f} us each wheel-instant, to "
        f"{100.0 * off:.0f} %. In ms, in us each wheel-instant, and how many a cold fit takes:",
        *_rows(1e3 * times, 1e6 * times / size, iterations),
    )
    return {
        "wheels_exponent": Figure(
            float(np.log2(grid[-1, -1] / grid[-2, -1])), MAX_EXPONENT,
            f"{WHEELS[-2]} wheels {1e3 * grid[-2, -1]:.1f} ms, {WHEELS[-1]} wheels {1e3 * grid[-1, -1]:.1f} ms",
            f"{what}, {WINDOW_LENGTHS[-1]:g} s window", at_most=True, digits=2,
        ),
        "samples_exponent": Figure(
            float(np.log2(grid[-1, -1] / grid[-1, -2])), MAX_EXPONENT,
            f"{WINDOW_LENGTHS[-2]:g} s {1e3 * grid[-1, -2]:.1f} ms, "
            f"{WINDOW_LENGTHS[-1]:g} s {1e3 * grid[-1, -1]:.1f} ms",
            f"{what}, {WHEELS[-1]} wheels", at_most=True, digits=2, more=more,
        ),
    }  # fmt: skip


def line(size: Array, times: Array) -> tuple[float, float]:
    """Fixed time [s] and time each wheel-instant [s] of the straight line that is relatively closest; (M,) each."""
    (fixed, each), *_ = np.linalg.lstsq(np.column_stack([1.0 / times, size / times]), np.ones(len(times)))
    return float(fixed), float(each)


def _steps(problem: ObservationModel, prior: SoilPrior, soil: Array) -> Callable[[], Any]:
    """Some Gauss-Newton steps at the optimum."""
    objective = Objective(problem, prior, Gaussian.of(prior, problem.gain_std))

    def next_iterate(iterate: Iterate) -> Iterate:
        quadratic = objective.quadratic_model(iterate)
        step = None if quadratic is None else quadratic.step()
        if quadratic is None or step is None:
            raise AssertionError("a Gauss-Newton step failed at the optimum")
        return objective.stepped(iterate, quadratic, step)

    start = next_iterate(next_iterate(objective.start(soil)))

    def work() -> None:
        iterate = start
        for _ in range(STEPS):
            iterate = next_iterate(iterate)

    return work


def problems(wheels: int) -> Iterator[tuple[ObservationModel, SoilPrior]]:
    """Windows of all lengths of a tractor with this number of wheels, half of them on each axle; one: a test rig."""
    config = _configuration(max(wheels, 2))
    recording = simulate(config, excited("loam", max(WINDOW_LENGTHS)), seed=1)
    channels = dict(recording.channels)
    if wheels == 1:
        config = config.model_copy(update={"wheel": config.wheel[:1], "vehicle": None})
        pull = recording.truth[f"drawbar_pull.{config.wheel[0].name}"]
        noise = config.noise.draft.absolute * np.random.default_rng(1).standard_normal(len(pull))
        channels["draft"] = Column(recording.truth["t"], pull + noise)
    for length in WINDOW_LENGTHS:
        yield observed(config, channels, length), prior_of(config)


def _configuration(wheels: int) -> Config:
    """The reference tractor with more or fewer wheels, and as much heavier or lighter."""
    config = reference_configuration()
    axles = [next(w for w in config.wheel if w.axle == axle) for axle in ("front", "rear")]
    fitted = [_own_sensors(w, f"{w.name}{i}") for w in axles for i in range(wheels // 2)]
    if config.vehicle is None:
        raise AssertionError("the reference tractor is a vehicle")
    vehicle = config.vehicle.model_copy(update={"mass": config.vehicle.mass * wheels / len(config.wheel)})
    return config.model_copy(update={"wheel": fitted, "vehicle": vehicle})


def _own_sensors(wheel: Wheel, name: str) -> Wheel:
    """The wheel under another name, with sensors of its own."""
    signals = {
        role: mapped.model_copy(update={"signal": f"{mapped.signal}{name}"})
        for role in ("torque", "speed", "load")
        if (mapped := getattr(wheel, role)) is not None
    }
    return wheel.model_copy(update={"name": name, **signals})


def _rows(times: Array, each: Array, iterations: Sequence[int]) -> list[str]:
    """A line for each number of wheels."""
    cells = [f"{t:8.1f}{e:6.1f}{i:4d}" for t, e, i in zip(times, each, iterations, strict=True)]
    rows = [cells[i : i + len(WINDOW_LENGTHS)] for i in range(0, len(cells), len(WINDOW_LENGTHS))]
    head = "wheels" + "".join(f"{f'{length:g} s':>18}" for length in WINDOW_LENGTHS)
    return [head, *(f"{wheels:6d}" + "".join(row) for wheels, row in zip(WHEELS, rows, strict=True))]
