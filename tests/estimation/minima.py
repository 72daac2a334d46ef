"""Does a window have one optimum?  Descents from random soils of the prior, beside what `fit_window` finds.

`PYTHONPATH=service python tests/estimation/minima.py 1000 [--only TEXT]` prints the table.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from soilbus.assembly import model_of, prior_of, rig_of
from soilbus.config import Config, load_config
from soilbus.estimation.coordinates import BOUND
from soilbus.estimation.gauss_newton import Fit, descend, fit_window
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.residuals import WindowProblem
from soilbus.estimation.window import BinStore
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil

FIELD = Path(__file__).resolve().parents[1] / "field/field.toml"
KINDS = ("loam", "wet_clay", "dry_sand")
EXCITED = Swing(0.05, 0.40)
SAME_COST, SAME_SOIL = 0.1, 0.1
"""Cost, and deviation of any parameter in posterior standard deviations, within which two optima are one."""


class Case(NamedTuple):
    """A window with its prior."""

    name: str
    problem: WindowProblem
    prior: SoilPrior


def case(
    name: str, config: Config, soil: str, seconds: float = 10.0, slip: Swing = EXCITED, sinkage: bool = True,
    seed: int = 1, side_shift: Swing = Swing(-0.15, 0.15),
) -> Case:  # fmt: skip
    """A window of a simulated drive on a known soil."""
    scenario = Scenario(seconds, (Patch(0.0, soil),), slip=slip, side_shift=side_shift)
    rig, channels = rig_of(config), simulate(config, scenario, seed).channels
    store = BinStore(rig, config.estimator.bin, 0.0)
    store.add({
        c: (channels[c].t, channels[c].value)
        for c in rig.channels if c in channels and (sinkage or not c.startswith("sinkage"))
    })  # fmt: skip
    problem = WindowProblem(store.window(0.0, seconds), rig, model_of(config), config.estimator.min_speed)
    return Case(f"{name}, {soil}, {seconds:g} s" + (", sinkage" if sinkage else ""), problem, prior_of(config))


def told(soil: str) -> list[str]:
    """Settings by which c and K are known to 25 %."""
    values = {name: getattr(SOILS[soil], name) for name in ("c", "K")}
    return [f"soil.{name}.{key}={v * f}" for name, v in values.items() for key, f in (("value", 1.0), ("std", 0.25))]


def two_wheels(config: Config) -> Config:
    """One wheel in front and one behind."""
    return config.model_copy(update={"wheel": config.wheel[::2]})


def cases() -> Iterator[Case]:
    """Windows of all kinds."""
    for soil in KINDS:
        free, known, field = (
            reference_configuration(),
            reference_configuration(told(soil)),
            load_config(FIELD, told(soil)),
        )
        for sinkage in (True, False):
            for seconds in (2.0, 10.0):
                yield case("c and K free", free, soil, seconds, sinkage=sinkage)
                yield case("c and K known", known, soil, seconds, sinkage=sinkage)
            yield case("field rig", field, soil, sinkage=sinkage)
            yield case("two wheels", two_wheels(free), soil, sinkage=sinkage)
            yield case("constant slip", free, soil, slip=Swing(0.15, 0.15 + 1e-6), sinkage=sinkage)


def drawn(prior: SoilPrior, rng: np.random.Generator, width: float) -> Soil:
    """A soil of the prior, kept as near to it as a fit keeps its own."""
    deviation = np.clip(rng.standard_normal(len(prior.median)), -BOUND, BOUND)
    return Soil(*(prior.median * np.exp(prior.log_std * deviation)).tolist())


def apart(fit: Fit, other: Fit) -> float:
    """Largest deviation of a parameter of one fit from another's, in standard deviations of the other."""
    std = np.sqrt(np.diag(other.posterior.log_covariance))
    free = std > 0.0
    return float(
        np.max(np.abs(np.log(np.asarray(fit.posterior.soil) / other.posterior.soil)[free] / std[free]), initial=0)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("--only", default="")
    args = parser.parse_args()
    import time

    for one in cases():
        if args.only not in one.name:
            continue
        rng = np.random.default_rng(1)
        begin = time.time()
        fit = fit_window(one.problem, one.prior)
        t_fit = time.time() - begin
        begin = time.time()
        ends = [descend(one.problem, one.prior, drawn(one.prior, rng, 0.3)) for _ in range(args.count)]
        t = time.time() - begin
        none = sum(e is None for e in ends)
        notc = sum(e is not None and not e.converged for e in ends)
        good = [e for e in ends if e is not None and e.converged]
        best = min([*good, fit], key=lambda e: e.cost)
        same = sum(e.cost < best.cost + SAME_COST and apart(e, best) < SAME_SOIL for e in good)
        off = sum(e.cost < best.cost + SAME_COST and apart(e, best) >= SAME_SOIL for e in good)
        worse = [e for e in good if e.cost >= best.cost + SAME_COST]
        print(
            f"{one.name:40s} same {same} off {off} worse {len(worse)} notconv {notc} none {none}; fit +{fit.cost - best.cost:.3f} apart {apart(fit, best):.3f} conv {fit.converged} | {1e3 * t_fit:.0f} ms, {1e3 * t / args.count:.1f} ms each",
            sorted({round(e.cost - best.cost, 1) for e in worse})[:6],
            flush=True,
        )


if __name__ == "__main__":
    main()
