"""Every published quantity beside plain Monte Carlo, over posteriors of many soils and drives and over torque limits.

`python -m tests.lab.capability_spread [--seed 5] [--draws 10000] [--soil NAME]...`
prints what is beyond 2 % in the mean or 10 % in the std, and how many quantities were compared.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from soilbus.decision.balance import balance
from soilbus.decision.capability import Demand, slip_grid
from soilbus.decision.wheels import wheel_table
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.laplace import cold_fit
from soilbus.estimation.posterior import Posterior
from soilbus.simulator.drive import SimulationError
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import KINDS
from soilbus.trials.windows import observed
from tests.lab.random_soils import CONFIG, MAX_SLIP, MODEL, RIG, Compared, assessed, by_draws, compared

DRIVES = {"wide": Swing(0.05, 0.40), "narrow": Swing(0.08, 0.15)}
PRIORS = {"usual": (), "rough c and K": ("soil.c={value=5000.0,std=5000.0}", "soil.K={value=0.02,std=0.02}")}
SLOPE = 0.02


class Case(NamedTuple):
    """One posterior: a drive of 10 s on a soil, with sinkage sensors or without, and its prior."""

    soil: str
    drive: str
    sinkage: bool
    prior: str = "usual"


def posterior_of(case: Case, seed: int) -> Posterior | None:
    """The posterior of the service after the drive; None where there is no fit."""
    config = reference_configuration(PRIORS[case.prior])
    try:
        recording = simulate(config, Scenario(10.0, (Patch(0.0, case.soil),), slip=DRIVES[case.drive]), seed)
    except SimulationError:
        return None
    channels = {n: c for n, c in recording.channels.items() if case.sinkage or not n.startswith("sinkage")}
    fit = cold_fit(observed(CONFIG, channels, 10.0), prior_of(config))
    return None if fit is None or not fit.converged else fit.reported.posterior


def limits_of(posterior: Posterior) -> dict[str, tuple[float, float]]:
    """By name, a torque limit [N m] and the share of the largest draft that is asked for.

    Those that decide nothing, something or all, and those where a limit and the ground
    meet: at the top of the pull and at the rear axle's most efficient slip.
    """
    level = balance(wheel_table(np.array([posterior.soil]), RIG, MODEL, slip_grid(MAX_SLIP)))
    torque = level.torque[0]
    best = assessed(posterior, np.inf, None).set_points["rear"].efficiency
    at_best = int(np.searchsorted(level.slip, 0.1 if best is None else best.value))
    top = int(np.where(level.known[0], level.pull[0], -np.inf).argmax())
    return {
        "strong": (2400.0, 0.5),
        "weak": (1100.0, 0.5),
        "at the top": (0.98 * float(torque[:, top].max()), 0.9),
        "at the best": (float(torque[1, min(at_best, top)]), 0.9),
    }


def quantities(posterior: Posterior, draws: int) -> Iterator[tuple[str, Compared]]:
    """Every uncertain quantity with the name of the limit, for all limits."""
    ours = {}
    for name, (limit, share) in limits_of(posterior).items():
        demand = Demand(share * abs(assessed(posterior, limit, None).max_draft.value), 20.0, SLOPE)
        ours[name] = limit, demand, assessed(posterior, limit, demand)
    with by_draws(draws):
        for name, (limit, demand, able) in ours.items():
            for each in compared(able, assessed(posterior, limit, demand)):
                yield name, each


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--draws", type=int, default=10_000)
    parser.add_argument("--soil", action="append")
    options = parser.parse_args(arguments)
    count = rare = wrong = wrong_rare = 0
    for soil in options.soil or KINDS:
        for case in (Case(soil, d, s, p) for d in DRIVES for s in (True, False) for p in PRIORS):
            posterior = posterior_of(case, options.seed)
            if posterior is None:
                continue
            for limit, each in quantities(posterior, options.draws):
                count, rare, wrong = count + 1, rare + each.rare, wrong + (each.wrong and not each.rare)
                wrong_rare += each.wrong and each.rare
                if each.wrong:
                    print(*case, limit, each, "rare" if each.rare else "", flush=True)
    print(f"{count} quantities, beyond 2 % or 10 %: {wrong}; {rare} are made by rare draws, of which {wrong_rare}")


if __name__ == "__main__":
    main()
