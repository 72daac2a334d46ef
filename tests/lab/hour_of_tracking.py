"""One soil for an hour, the tracker carried on all the time: false changes, mismatches, calibration.

`python -m tests.lab.hour_of_tracking [loam wet_clay] [--minutes 60] [--seed 1]` prints the table.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import numpy as np

from soilbus.estimation.tracker import TrackerState
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS
from tests.lab.driven_windows import errors, tracker_of, windows


class Hour(NamedTuple):
    """Windows on one soil, those reported as changed, those that do not fit, and errors (N, 2) of the others.

    Errors are those of bearing pressure and tan phi in their standard deviations; chi2 (N,).
    """

    windows: int
    changes: int
    mismatches: int
    errors: np.ndarray
    chi2: np.ndarray


def hour(soil: str, minutes: float, seed: int) -> Hour:
    """Drive `minutes` on one soil, slip wandering between 0.05 and 0.40."""
    config = reference_configuration()
    scenario = Scenario(60.0 * minutes, (Patch(0.0, soil),), slip=Swing(0.05, 0.40))
    tracker = tracker_of(config)
    results = [tracker.estimate(window, end) for window, end in windows(config, simulate(config, scenario, seed))]
    good = [r.fit for r in results if r.fit is not None and not r.mismatch]
    return Hour(
        len(results),
        sum(r.state is not TrackerState.STEADY for r in results),
        len(results) - len(good),
        np.array([errors(fit.posterior, SOILS[soil]) for fit in good]),
        np.array([fit.chi2 for fit in good]),
    )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("soils", nargs="*", default=["loam", "wet_clay"])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    print("soil          windows  false  mis-        chi2   rms error / sd       within 1.96 sd")
    print("                     changes  matches  (mean)  bearing  tan phi     bearing  tan phi")
    for soil in args.soils:
        result = hour(soil, args.minutes, args.seed)
        rms, within = np.sqrt(np.mean(result.errors**2, axis=0)), np.mean(np.abs(result.errors) < 1.96, axis=0)
        print(
            f"{soil:<12}  {result.windows:7d}  {result.changes:5d}  {result.mismatches:7d}  {result.chi2.mean():6.3f}"
            f"  {rms[0]:7.2f}  {rms[1]:7.2f}     {within[0]:7.1%}  {within[1]:7.1%}"
        )


if __name__ == "__main__":
    main()
