"""Drives into curves and out of them: are valid windows right while the curve changes?

`python -m tests.lab.curved_drives [--radii 75 40 25] [--soil loam] [--seeds 8] [--first 1]` prints a table;
`--windows` every window besides.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from soilbus.config.model import Config
from soilbus.decision.traversability import Status
from soilbus.estimation.assembly import rig_of
from soilbus.estimation.path_curvature import sides
from soilbus.estimation.window import Rig, Window
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS
from tests.lab.driven_windows import errors, sweep, task_of, windows

__all__ = [
    "TRACK",
    "Seen",
    "curved",
    "driven",
]

TRACK = 1.5
ENTERED, LEFT, END = 12.0, 25.0, 38.0
"""Seconds: where a curve begins, where it ends, each with up to SPREAD more, and where the drive does."""
SPREAD = 3.0
STEERING = (0.3, 3.0)
"""Seconds that the driver takes to steer."""
WRONG = 3.0


class Seen(NamedTuple):
    """What one window says: t [s] since the curve began, status, errors (2,) in standard deviations, sd of tan phi."""

    t: float
    valid: bool
    reason: str
    away: np.ndarray
    sd: float


def curved(window: Window, rig: Rig, curvature: np.ndarray | float) -> Window:
    """The window on a path of this curvature [1/m], positive to the left.

    Each wheel keeps its slip relative to the ground that passes under it.
    """
    left = np.broadcast_to(np.asarray(curvature, float), window.t.shape)[:, None]
    return replace(window, speed=window.speed * (1.0 + sides(rig) * TRACK / 2.0 * left))


def driven(config: Config, soil: str, radius: float, seed: int, duration: float = END) -> list[Seen]:
    """The windows of a drive [s] with one curve of this radius [m], to the left or to the right."""
    rng = np.random.default_rng([seed, 11])
    begin, end = np.array([ENTERED, LEFT]) + SPREAD * rng.random(2)
    steering, way = rng.uniform(*STEERING), rng.choice([-1.0, 1.0])
    knots = [begin, begin + steering, end, end + steering]
    recording = simulate(config, Scenario(duration, (Patch(0.0, soil),), slip=Swing(0.05, 0.40)), seed)
    estimator, rig, seen = WindowEstimator(config), rig_of(config), []
    for window, at in windows(config, recording):
        on_curve = curved(window, rig, way / radius * np.interp(window.t, knots, [0.0, 1.0, 1.0, 0.0]))
        result = estimator.estimate(task_of(on_curve, at, config, index=round(at - config.estimator.window))).result
        away, sd = np.full(2, np.nan), np.nan
        if result.posterior is not None:
            away = errors(result.posterior, SOILS[soil])
            sd = result.posterior.tan_phi().std / result.posterior.tan_phi().value
        seen.append(Seen(at - begin, result.status is Status.VALID, result.reason, away, sd))
    return seen


def main() -> None:
    """Prints the table."""
    parser = sweep(__doc__ or "", 8)
    parser.add_argument("--radii", type=float, nargs="+", default=[75.0, 40.0, 25.0])
    parser.add_argument("--soil", default="loam")
    args = parser.parse_args()
    config = reference_configuration()
    print("radius  windows since the curve  valid  rms error / sd: bearing  tan phi  most  wrong  others")
    for radius in args.radii:
        drives = {seed: driven(config, args.soil, radius, seed) for seed in range(args.first, args.first + args.seeds)}
        seen = [(seed, w) for seed, drive in drives.items() for w in drive if w.t > 0.0]
        away = np.array([w.away for _, w in seen if w.valid])
        rms, others = np.sqrt(np.mean(away**2, axis=0)), [w.reason for _, w in seen if not w.valid]
        count = ", ".join(f"{others.count(reason)} {reason}" for reason in sorted(set(others)))
        wrong = int((np.abs(away).max(axis=1) > WRONG).sum())
        print(
            f"{radius:6.0f}  {len(seen):23d}  {len(away):5d}  {rms[0]:23.2f}  {rms[1]:7.2f} {np.abs(away).max():5.1f}"
            f"  {wrong:5d}  {count}",
            flush=True,
        )
        for seed, w in seen:
            if args.windows or (w.valid and np.abs(w.away).max() > WRONG):
                state = "valid" if w.valid else "-"
                print(f"  {seed:4d} {w.t:6.2f} {state:5} {w.away[0]:5.1f} {w.away[1]:5.1f} {w.sd:6.1%} {w.reason}")


if __name__ == "__main__":
    main()
