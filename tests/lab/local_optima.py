"""Does a window have one optimum?  Descents from random soils of the prior, compared with `fit_window`.

`python -m tests.lab.local_optima 1000 [--only TEXT] [--field tests/field/field.toml]` prints the table.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from soilbus.config.file import load_config
from soilbus.config.model import Config
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.multistart import Fit, fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.parametrization import Coordinates
from soilbus.estimation.posterior import SoilPrior
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil
from soilbus.trials.windows import fit_from_soil, observed

__all__ = [
    "EXCITED",
    "LEANING",
    "SAME_SOIL",
    "SAME_VALUE",
    "Case",
    "Ends",
    "apart",
    "c_and_K_known",
    "cases",
    "constant",
    "descents",
    "ends_of",
    "line",
    "starts",
    "two_wheels",
    "window",
]

KINDS = ("loam", "wet_clay", "dry_sand")
EXCITED = Swing(0.05, 0.40)
LEANING = Swing(-0.15, 0.15)
SAME_VALUE, SAME_SOIL = 0.1, 0.1
"""-2 log posterior, and deviation of a parameter in posterior sd, within which two optima are the same."""


class Case(NamedTuple):
    """A window with its prior."""

    name: str
    problem: ObservationModel
    prior: SoilPrior


class Ends(NamedTuple):
    """Ends of descents, compared with the best of all.

    Attributes
    ----------
    same, other
        Descents that ended at the best optimum, and at another one with the same -2 log posterior.
    worse
        -2 log posterior above the best, of each descent that ended at a worse one.
    failed
        Descents that did not converge.
    fit
        The result of `fit_window`.
    above, off
        Its -2 log posterior above the best, and its largest deviation from the best [posterior sd].
    seconds
        Processor time of one descent.
    """

    same: int
    other: int
    worse: list[float]
    failed: int
    fit: Fit
    above: float
    off: float
    seconds: float


def constant(slip: float) -> Swing:
    """A swing of no amplitude about this slip."""
    return Swing(slip, slip + 1e-6)


def window(
    config: Config, soil: str, seconds: float = 10.0, slip: Swing = EXCITED, sinkage: bool = True, seed: int = 1,
    side_shift: Swing = LEANING,
) -> ObservationModel:  # fmt: skip
    """A window of a simulated drive on a known soil."""
    scenario = Scenario(seconds, (Patch(0.0, soil),), slip=slip, side_shift=side_shift)
    channels = simulate(config, scenario, seed).channels
    wanted = {name: c for name, c in channels.items() if sinkage or not name.startswith("sinkage")}
    return observed(config, wanted, seconds)


def c_and_K_known(soil: str) -> list[str]:
    """Settings by which c and K are known to 25 %."""
    values = {name: getattr(SOILS[soil], name) for name in ("c", "K")}
    return [f"soil.{name}.{key}={v * f}" for name, v in values.items() for key, f in (("value", 1.0), ("std", 0.25))]


def two_wheels(config: Config) -> Config:
    """One wheel in front and one behind."""
    return config.model_copy(update={"wheel": config.wheel[::2]})


def cases(field: Path | None = None) -> Iterator[Case]:
    """Windows of all kinds; `field`: the configuration of a further tractor."""
    for soil in KINDS:
        free, known = reference_configuration(), reference_configuration(c_and_K_known(soil))
        kinds = [
            ("c and K free", free, 2.0, EXCITED), ("c and K free", free, 10.0, EXCITED),
            ("c and K known", known, 2.0, EXCITED), ("c and K known", known, 10.0, EXCITED),
            ("two wheels", two_wheels(free), 10.0, EXCITED),
            ("constant slip", free, 10.0, constant(0.15)),
        ]  # fmt: skip
        if field is not None:
            kinds.append(("field rig", load_config(field, c_and_K_known(soil)), 10.0, EXCITED))
        for name, config, seconds, slip in kinds:
            for sinkage in (True, False):
                what = f"{name}, {soil}, {seconds:g} s{', sinkage' if sinkage else ''}"
                yield Case(what, window(config, soil, seconds, slip, sinkage), prior_of(config))


def starts(prior: SoilPrior, width: float, count: int, seed: int) -> Iterator[Soil]:
    """Random soils of the prior, clipped to the bounds of a fit; width [m] is the mean tyre's."""
    coordinates = Coordinates(prior, width)
    for deviation in np.random.default_rng(seed).standard_normal((count, len(prior.median))):
        yield Soil(*coordinates.within(prior.median * np.exp(prior.log_std * deviation)).tolist())


def apart(fit: Fit, other: Fit) -> float:
    """Largest deviation of a parameter between two modes, in sd of the other."""
    std = np.sqrt(np.diag(other.mode.posterior.log_covariance))
    free = std > 0.0
    off = np.log(fit.mode.soil / other.mode.soil)
    return float(np.max(np.abs(off[free] / std[free]), initial=0.0))


def descents(problem: ObservationModel, prior: SoilPrior, count: int, seed: int) -> tuple[list[Fit], int]:
    """The descents that converged, and how many did not."""
    ends = [fit_from_soil(problem, prior, s) for s in starts(prior, float(problem.rig.width.mean()), count, seed)]
    good = [end for end in ends if end is not None and end.converged]
    return good, count - len(good)


def ends_of(case: Case, count: int, seed: int) -> Ends:
    """Descents from `count` random soils, compared with the fit."""
    fit = fit_window(case.problem, case.prior)
    if fit is None or not fit.converged:
        raise ValueError(f"{case.name}: no fit")
    begin = time.process_time()
    good, failed = descents(case.problem, case.prior, count, seed)
    seconds = (time.process_time() - begin) / count
    best = min([*good, fit], key=lambda end: end.neg2_log_posterior)
    as_good = [end for end in good if end.neg2_log_posterior < best.neg2_log_posterior + SAME_VALUE]
    same = sum(apart(end, best) < SAME_SOIL for end in as_good)
    worse = [
        end.neg2_log_posterior - best.neg2_log_posterior
        for end in good
        if end.neg2_log_posterior >= best.neg2_log_posterior + SAME_VALUE
    ]
    return Ends(
        same,
        len(as_good) - same,
        worse,
        failed,
        fit,
        fit.neg2_log_posterior - best.neg2_log_posterior,
        apart(fit, best),
        seconds,
    )


def line(name: str, ends: Ends, count: int) -> str:
    """One line of the table."""
    shares = "  ".join(f"{100.0 * n / count:5.1f}" for n in (ends.same, ends.other, len(ends.worse), ends.failed))
    second = "-" if ends.fit.second_mode is None else f"second mode, share {ends.fit.second_mode.share:.2f}"
    return f"{name:38s} {shares}   {ends.above:7.3f} {ends.off:6.2f}  {1e3 * ends.seconds:5.1f}  {second}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("--only", default="", help="cases with this in their name")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--field", type=Path, help="configuration of a further tractor, such as tests/field/field.toml")
    args = parser.parse_args(arguments)
    print(f"{args.count} starts each; shares in %: at the best optimum, at another as good, at a worse one, failed;")
    print("the fit: -2 log posterior above the best's, deviation from it in sd; ms of a descent\n")
    print(f"{'window':38s}  same  other  worse failed     above    off     ms  second mode")
    for case in cases(args.field):
        if args.only in case.name:
            print(line(case.name, ends_of(case, args.count, args.seed), args.count), flush=True)


if __name__ == "__main__":
    main()
