"""Drives over borders: how soon a valid estimate of the new soil comes, and whether any valid one is wrong.

`PYTHONPATH=service:tests/support python tests/estimation/borders.py [loam:wet_clay …] [--speeds 1.5] [--transition 1]
[--seeds 20] [--first 1]` prints a table; `--windows` every window near the border besides.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import numpy as np
from drives import errors, task_of, windows

from soilbus.config import Config
from soilbus.daemon.estimator import WindowEstimator
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing, soil_along
from soilbus.terra.wheel import Soil
from soilbus.traversability import Status

PAIRS = ("loam:wet_clay", "wet_clay:loam", "loam:clayey_soil_38", "clayey_soil_38:loam")
BEFORE, AFTER = 15.0, 10.0
"""Seconds on the first soil, at least, and on the second."""
SPREAD = 2.0
"""Seconds over which the times of the border vary: windows end at whole ones."""
WRONG = 3.0
"""Standard deviations."""


class Told(NamedTuple):
    """What one window says; t [s] since the last wheel left the border.

    away: error of bearing pressure and tan phi, the larger one, in standard deviations, from the
    soil anywhere between the axles; nan without an estimate.  sd: that of bearing pressure over its value.
    """

    t: float
    valid: bool
    reason: str
    away: float
    sd: float


def crossed(config: Config, pair: str, speed: float, transition: float, seed: int, after: float = AFTER) -> list[Told]:
    """The windows of a drive at a constant speed [m/s] over a border that is so long [m]."""
    first, second = pair.split(":")
    wheelbase, ahead = config.vehicle.wheelbase, config.vehicle.wheelbase - config.vehicle.cg_ahead_of_rear_axle
    reached = BEFORE + SPREAD * float(np.random.default_rng([seed, 7]).random())
    at = reached * speed + ahead
    left = (at + transition + wheelbase - ahead) / speed
    soils = (Patch(0.0, first), Patch(at, second))
    scenario = Scenario(
        left + after + 1.0, soils, Swing(speed, speed + 1e-6), slip=Swing(0.05, 0.40), transition=transition
    )
    recording = simulate(config, scenario, seed)
    estimator, between = WindowEstimator(config), np.linspace(ahead - wheelbase, ahead, 17)
    told = []
    for window, end in windows(config, recording):
        result = estimator.estimate(task_of(window, end, config, index=round(end - config.estimator.window))).result
        place = np.interp(end, recording.truth["t"], recording.truth["distance"])
        under = np.transpose(soil_along(soils, place + between, transition))
        posterior, away, sd = result.posterior, np.nan, np.nan
        if posterior is not None:
            away = min(float(np.abs(errors(posterior, Soil(*map(float, soil)))).max()) for soil in under)
            sd = result.bearing.std / result.bearing.value
        told.append(Told(end - left, result.status is Status.VALID, result.reason, away, sd))
    return told


def first_valid(told: list[Told]) -> float:
    """Seconds from the border until a window is valid; inf if none is."""
    return min((w.t for w in told if w.valid and w.t > 0.0), default=np.inf)


def wrong(told: list[Told]) -> list[Told]:
    """Windows that are valid and beyond what they say."""
    return [w for w in told if w.valid and not w.away < WRONG]


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pairs", nargs="*", default=list(PAIRS))
    parser.add_argument("--speeds", type=float, nargs="+", default=[1.5])
    parser.add_argument("--transition", type=float, default=1.0)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--windows", action="store_true")
    args = parser.parse_args()
    config = reference_configuration()
    print("pair                     speed  drives  valid from [s]: median  most  within 2 s  valid windows  wrong  rms")
    for pair in args.pairs:
        for speed in args.speeds:
            drives = {
                seed: crossed(config, pair, speed, args.transition, seed)
                for seed in range(args.first, args.first + args.seeds)
            }
            delay = np.array([first_valid(told) for told in drives.values()])
            away = np.array([w.away for told in drives.values() for w in told if w.valid])
            bad = [(seed, w) for seed, told in drives.items() for w in wrong(told)]
            print(
                f"{pair:<24} {speed:5.2f}  {len(drives):6d}  {np.median(delay):22.2f} {delay.max():5.2f}"
                f"  {np.mean(delay <= 2.0):10.0%}  {len(away):13d}  {len(bad):5d} {np.sqrt(np.mean(away**2)):5.2f}",
                flush=True,
            )
            if args.windows:
                for seed, told in drives.items():
                    for w in (w for w in told if w.t > -4.0 - args.transition / speed):
                        state = "valid" if w.valid else "-"
                        print(f"  {seed:4d} {w.t:6.2f} {state:5} {w.away:5.1f} {w.sd:6.1%} {w.reason}")
            else:
                for seed, w in bad:
                    print(f"  seed {seed}: {w.away:.1f} sd off, {w.t:+.2f} s, sd {w.sd:.1%}")


if __name__ == "__main__":
    main()
