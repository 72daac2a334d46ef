"""The noise rows of `soilbus paper`: one operating point beside a window of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from soilbus.arrays import Array
from soilbus.report.table import table
from soilbus.trials.paper import EXACT, SIMPSON, Equations
from soilbus.trials.paper_noise import (
    LEVELS,
    Noise,
    best_depth,
    bounds,
    cramer_rao,
    one_instant,
    relative_errors,
    windows_of,
)
from soilbus.trials.paper_tables import SANDY_LOAM, WET_CLAY, Trial

DRAWS = 500
"""Noise draws of one instant."""
WINDOWS = 20
"""Windows of 100 instants."""
FEWEST = 20
"""Solutions below which no statistics of them are shown."""
HEAD = ("soil", "noise", "what", "solved %", "K_L %", "phi %", "n %", "p %", "K_L between")


def noise_table(sinkage: float, seed: int) -> str:
    """Bounds and Monte Carlo of one instant and of a window at a sinkage [m], for two soils and LEVELS of noise."""
    rows = [row for soil, trial in _SOILS for level in LEVELS for row in _rows(soil, trial, level, sinkage, seed)]
    return table(HEAD, rows)


def noise_text(sinkage: float, seed: int) -> str:
    """What the table shows."""
    levels = "; ".join(
        f"{name}: W {100 * s.W:g} %, DP {100 * s.DP:g} %, T {100 * s.T:g} %, sinkage {1e3 * s.sinkage:g} mm, "
        f"slip {s.slip:g}" for name, s in LEVELS.items()
    )  # fmt: skip
    depths = ", ".join(f"{soil} {1e3 * pressure_depth(trial, sinkage):.0f} mm" for soil, trial in _SOILS)
    return (
        f"Standard deviations by level: {levels}. Integrals are exact in data and solver, the shear law is rational. "
        f"One instant: {DRAWS} draws, seed {seed}, solutions with n from 0.03 to 3; medians and the 5th and 95th "
        f"percentile of K_L are of the draws that have a solution; Cramer-Rao bounds from the 3x3 Jacobian, linear "
        f"however large. 100 instants: load +-30 %, slip 0.05 to 0.4, {WINDOWS} windows through the estimator of "
        f"soilbus; K_L between least and greatest. p: bearing pressure K_L z^n at the depth where one instant "
        f"determines it best ({depths})."
    )


def noise_summary(sinkage: float) -> str:
    """What the bounds say of Simpson's rule, of averaging, and of the noise that the paper's accuracy would need."""
    level = LEVELS["0.1 %"]
    forces_only = level._replace(sinkage=0.0, slip=0.0)
    exact, simpson = K_L_bound(sinkage, level, EXACT), K_L_bound(sinkage, level, SIMPSON)
    alone = K_L_bound(sinkage, forces_only, EXACT)
    return (
        f"With Simpson's rule the bound of K_L of wet clay at 0.1 % is {100 * simpson:.3g} % instead of "
        f"{100 * exact:.3g} %. A hundred instants at one and the same point would only divide the bounds by 10. For "
        f"K_L to 2 %, W, DP and T must be right to {forces_only.W * 0.02 / alone:.1e} of their values, with sinkage "
        f"and slip exact."
    )


def pressure_depth(trial: Trial, sinkage: float) -> float:
    """Depth [m] of the bearing pressure that one instant at a sinkage [m] determines best."""
    return best_depth(cramer_rao(trial.at(sinkage), trial.truth, LEVELS["0.1 %"]), trial.truth.n)


def K_L_bound(sinkage: float, noise: Noise, equations: Equations) -> float:
    """Least relative standard deviation of K_L of wet clay from one instant at a sinkage [m]."""
    return float(np.sqrt(cramer_rao(WET_CLAY.at(sinkage), WET_CLAY.truth, noise, equations)[0, 0]))


_SOILS = (("wet clay", WET_CLAY), ("sandy loam", SANDY_LOAM))


def _rows(soil: str, trial: Trial, level: str, sinkage: float, seed: int) -> list[tuple[str, ...]]:
    noise, truth, depth = LEVELS[level], trial.truth, pressure_depth(trial, sinkage)
    bound = bounds(cramer_rao(trial.at(sinkage), truth, noise), truth.n, depth)
    once = one_instant(trial, sinkage, noise, DRAWS, seed)
    fits = windows_of(trial, sinkage, noise, WINDOWS, seed)

    def row(what: str, found: Array, of: int, errors: Iterable[float], between: Sequence[float]) -> tuple[str, ...]:
        solved = f"{100.0 * len(found) / of:.0f}"
        if len(found) < min(FEWEST, of // 2):
            return (soil, level, what, solved, *"-----")
        low, high = (np.quantile(found[:, 0], between) / 1e3).tolist()
        return (soil, level, what, solved, *_percent(errors), f"{low:.4g} to {high:.4g}")

    median = np.median(np.abs(relative_errors(once, truth, depth)), axis=0) if len(once) else ()
    rms = np.sqrt(np.mean(relative_errors(fits, truth, depth) ** 2, axis=0)) if len(fits) else ()
    return [
        (soil, level, "one instant: bound", "", *_percent(bound), ""),
        row("one instant: median error", once, DRAWS, median, (0.05, 0.95)),
        row("100 instants: RMS error", fits, WINDOWS, rms, (0.0, 1.0)),
    ]


def _percent(values: Iterable[float]) -> tuple[str, ...]:
    return tuple(f"{100.0 * value:.3g}" for value in values)
