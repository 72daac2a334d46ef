"""Drives over borders: how soon a valid estimate of the new soil comes, and whether any valid one is wrong.

`PYTHONPATH=service:tests/support python tests/estimation/borders.py [loam:wet_clay …] [--speeds 1.5] [--transition 1]
[--seeds 20] [--first 1]` prints a table; `--windows` every window near the border besides.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from drives import errors, sweep, task_of, windows

from soilbus.assembly import model_of, prior_of, rig_of
from soilbus.config import Config
from soilbus.daemon.estimator import WindowEstimator
from soilbus.estimation.bound import cramer_rao
from soilbus.estimation.completed import CompletedProblem
from soilbus.estimation.soil_change import Crossing, without_crossing
from soilbus.estimation.tracker import elsewhere
from soilbus.estimation.window import BinStore
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing, soil_along
from soilbus.terra.wheel import Soil
from soilbus.traversability import Status

PAIRS = ("loam:wet_clay", "wet_clay:loam", "loam:clayey_soil_38", "clayey_soil_38:loam")
BEFORE, AFTER = 15.0, 10.0
"""Seconds on the first soil, at least, and on the second."""
SPREAD = 2.0
"""Seconds over which the times of the border vary: windows end at whole ones."""
WRONG, IN_TIME = 3.0, 2.0
"""Standard deviations; seconds."""


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


class Drive(NamedTuple):
    """What is driven and measured; the first wheels are on the second soil from `on`, the last from `left` [s]."""

    recording: Recording
    soils: tuple[Patch, Patch]
    on: float
    left: float


def drive(config: Config, pair: str, speed: float, transition: float, seed: int, after: float = AFTER) -> Drive:
    """A drive at a constant speed [m/s] over a border that is so long [m], and so many seconds more."""
    first, second = pair.split(":")
    vehicle = config.vehicle
    reached = BEFORE + SPREAD * float(np.random.default_rng([seed, 7]).random())
    at = reached * speed + vehicle.wheelbase - vehicle.cg_ahead_of_rear_axle
    soils = (Patch(0.0, first), Patch(at, second))
    on = reached + transition / speed
    left = on + vehicle.wheelbase / speed
    scenario = Scenario(
        left + after + 1.0, soils, Swing(speed, speed + 1e-6), slip=Swing(0.05, 0.40), transition=transition
    )
    return Drive(simulate(config, scenario, seed), soils, on, left)


def crossed(config: Config, pair: str, speed: float, transition: float, seed: int, after: float = AFTER) -> list[Told]:
    """The windows of such a drive."""
    recording, soils, _, left = drive(config, pair, speed, transition, seed, after)
    behind, vehicle = config.vehicle.cg_ahead_of_rear_axle, config.vehicle
    estimator, between = WindowEstimator(config), np.linspace(-behind, vehicle.wheelbase - behind, 17)
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


def least_sd(config: Config, driven: Drive, t: float) -> float:
    """Relative sd of the bearing pressure that no unbiased estimate goes below t [s] after the last wheel's border.

    The Cramér-Rao bound of all that the wheels measured on the second soil, where the
    border is known, and the sensors' gain errors.
    """
    recording, end = driven.recording, driven.left + t
    rig = rig_of(config)
    rig = replace(rig, noise={name: noise._replace(gain=0.0) for name, noise in rig.noise.items()})
    store = BinStore(rig, config.estimator.bin, 0.0)
    channels, truth = recording.channels, recording.truth
    times = {name: channels[name].t for name in rig.channels if name in channels}
    store.add({name: (at, np.interp(at, truth["t"], truth[name])) for name, at in times.items()})
    border = Crossing(driven.on, driven.on, driven.left - driven.on)
    window = without_crossing(store.window(driven.on, end), border, rig.front)
    settings = config.estimator
    problem = CompletedProblem(window, rig, model_of(config), settings.min_speed, settings.max_turn)
    bound = cramer_rao(problem, elsewhere(prior_of(config)), driven.soils[1].parameters())
    bearing = bound.bearing_pressure(settings.z_ref, settings.b_ref)
    return bearing.std / bearing.value


def first_valid(told: list[Told]) -> float:
    """Seconds from the border until a window is valid; inf if none is."""
    return min((w.t for w in told if w.valid and w.t > 0.0), default=np.inf)


def wrong(told: list[Told]) -> list[Told]:
    """Windows that are valid and beyond what they say."""
    return [w for w in told if w.valid and not w.away < WRONG]


def main() -> None:
    """Prints the table."""
    parser = sweep(__doc__ or "", 20)
    parser.add_argument("pairs", nargs="*", default=list(PAIRS))
    parser.add_argument("--speeds", type=float, nargs="+", default=[1.5])
    parser.add_argument("--transition", type=float, default=1.0)
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
                f"  {np.mean(delay <= IN_TIME):10.0%}  {len(away):13d}  {len(bad):5d} {np.sqrt(np.mean(away**2)):5.2f}",
                flush=True,
            )
            if args.windows:
                for seed, told in drives.items():
                    for w in (w for w in told if w.t > -4.0 - args.transition / speed):
                        state = "valid" if w.valid else "-"
                        print(f"  {seed:4d} {w.t:6.2f} {state:5} {w.away:5.1f} {w.sd:6.1%} {w.reason}")
                continue
            for seed, w in bad:
                print(f"  seed {seed}: {w.away:.1f} sd off, {w.t:+.2f} s, sd {w.sd:.1%}")
            for seed, told in drives.items():
                if first_valid(told) > IN_TIME:
                    w = max((w for w in told if w.t <= IN_TIME), key=lambda w: w.t)
                    least = least_sd(config, drive(config, pair, speed, args.transition, seed), w.t)
                    said = f"sd {w.sd:.1%} where the bound is {least:.1%}, {w.away:.1f} sd off"
                    print(f"  seed {seed}: {w.reason} at {w.t:.2f} s: {said}")


if __name__ == "__main__":
    main()
