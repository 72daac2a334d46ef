"""Tables and figures of Xi et al. 2024 (World Electr. Veh. J. 15:217) by our equations.

soilbus.paper.table(3), soilbus.paper.figure("sensitivity").plot()
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from soilbus.api.residuals import blank_figure, frame_of
from soilbus.api.wheel import wheel_forces
from soilbus.terra.soil_laws import SHEAR_LAWS, lumped_modulus, normal_stress, shear_displacement
from soilbus.terra.soils import KINDS
from soilbus.trials.paper import WheelEquations, entry_angle
from soilbus.trials.paper_report import PaperTable, paper_table
from soilbus.trials.paper_tables import RUNS, SANDY_LOAM, SINKAGE, SLIP, START_ERRORS, WET_CLAY, as_print, from_print
from soilbus.words import did_you_mean

__all__ = ["PaperFigure", "figure", "table"]

TRACTOR_1 = partial(wheel_forces, radius=WET_CLAY.radius, width=WET_CLAY.width)
"""Forces of its wheel."""
SHARES = np.linspace(0.5, 1.5, 21)
"""Of a parameter's value, as the paper's start values are off."""
LOADS = np.linspace(500.0, 8000.0, 31)
"""Of a wheel [N]."""
ANGLES = 181
"""Places along the rim."""
STEPS = 9
"""Of the iteration, with its start."""
Rows = Iterator[tuple[Any, ...]]


def table(number: int, sinkage: float = SINKAGE) -> PaperTable:
    """Return table 3, 4, 6 or 7 of the paper beside its method run again, for simulated wheels of a sinkage [m].

    Returns
    -------
    PaperTable
        Its `rows` as figures; prints itself as a table: printed start, result, error and time beside the error that
        the printed result has, our result by the same iteration (eq. 41), its error, steps and time.

    Raises
    ------
    ValueError
        The paper has no such table, or no wheel sinks so deep.

    Examples
    --------
    >>> import soilbus
    >>> [(row.parameter, row.on, round(row.ours, 2)) for row in soilbus.paper.table(3).rows[:2]]
    [('phi [deg]', 'wet clay', 14.0), ('phi [deg]', 'sandy loam', 29.0)]
    """
    if number not in START_ERRORS:
        raise ValueError(f"no table {number} of estimates in the paper; there are {', '.join(map(str, START_ERRORS))}")
    return paper_table(number, sinkage)


@dataclass(frozen=True, repr=False)
class PaperFigure:
    """One figure as a table of its lines, and as a plot; columns are what distinguishes panels, lines, then x and y."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]

    def to_frame(self) -> Any:
        """Return a pandas DataFrame: a row for each point."""
        return frame_of(self.rows, self.columns)

    def plot(self) -> Any:
        """Return a figure of matplotlib: a panel for each quantity, a line for each soil, law or parameter."""
        *panels, line, x, y = self.columns
        groups = list(self.to_frame().groupby(panels, sort=False))
        drawn = blank_figure(4.0 * len(groups), 3.6)
        for axis, (names, points) in zip(drawn.subplots(1, len(groups), squeeze=False)[0], groups, strict=True):
            for name, own in points.groupby(line, sort=False):
                axis.plot(own[x], own[y], label=name)
            axis.set(title=", ".join(names), xlabel=x, ylabel=y)
        drawn.legend(*axis.get_legend_handles_labels(), loc="outside right upper", fontsize=8, frameon=False)
        return drawn


def figure(name: str, sinkage: float = SINKAGE) -> PaperFigure:
    """Return a figure of the paper for tractor 1 at its slip of 0.2.

    Parameters
    ----------
    name
        "sensitivity": load, drawbar pull and torque at a sinkage over each soil parameter, all over their true values.
        "torque": torque that a wheel needs on each known soil, over its load.
        "shear": shear stress along the rim by both shear laws.
        "convergence": estimates over their true values after each step of eq. 41, from the printed start values.
    sinkage
        Of the wheel [m], which the paper does not print; "torque" is over the load and has its own.

    Raises
    ------
    ValueError
        No such figure, or no wheel sinks so deep.
    """
    if name not in FIGURES:
        raise ValueError(f"no figure is named {name}{did_you_mean(name, FIGURES)}; known: {', '.join(FIGURES)}")
    columns, rows = FIGURES[name]
    return PaperFigure(columns, tuple(rows(sinkage)))


def _sensitivity(sinkage: float) -> Rows:
    for soil, trial in (("wet clay", WET_CLAY), ("sandy loam", SANDY_LOAM)):
        true = TRACTOR_1(trial.soil, None, SLIP, sinkage=sinkage)
        for parameter, value in trial.soil._asdict().items():
            changed = trial.soil._replace(**{parameter: SHARES * value})
            found = TRACTOR_1(changed, None, SLIP, sinkage=sinkage)
            for force in ("load", "drawbar_pull", "torque"):
                ratios = getattr(found, force) / getattr(true, force)
                yield from ((soil, force, parameter, *at) for at in zip(SHARES, ratios, strict=True))


def _torque(_sinkage: float) -> Rows:
    for law in SHEAR_LAWS:
        for soil in KINDS:
            needed = TRACTOR_1(soil, LOADS, SLIP, model=law).torque
            yield from ((law, soil, load, torque) for load, torque in zip(LOADS, needed, strict=True))


def _shear(sinkage: float) -> Rows:
    for soil, trial in (("wet clay", WET_CLAY), ("sandy loam", SANDY_LOAM)):
        of, end = trial.soil, entry_angle(trial.at(sinkage))
        angle = np.linspace(0.0, end, ANGLES)
        depth = trial.radius * (np.cos(np.maximum(angle, end - angle)) - np.cos(end))  # rear as front: eqs. 5-9
        normal = normal_stress(lumped_modulus(of.k_c, of.k_phi, trial.width), of.n, depth)
        for law, mobilised in SHEAR_LAWS.items():
            share = mobilised(shear_displacement(end, angle, SLIP, trial.radius) / of.K)[0]
            stress = share * (of.c + normal * np.tan(of.phi))
            yield from ((soil, law, *at) for at in zip(np.degrees(angle), stress / 1e3, strict=True))


def _convergence(sinkage: float) -> Rows:
    for run in (run for run in RUNS if run.table in (3, 4)):
        wheel, true = WheelEquations(run.trial.at(sinkage)), run.trial.truth
        for step in range(STEPS):
            end = wheel.newton(wheel.forces(true), from_print(run.start), most=step).end
            for parameter, value, is_ in zip(("phi", "K_L", "n"), as_print(end), as_print(true), strict=True):
                yield parameter, f"{run.on}, {START_ERRORS[run.table]} % off", step, value / is_


FIGURES: dict[str, tuple[tuple[str, ...], Callable[[float], Rows]]] = {
    "sensitivity": (("soil", "force", "parameter", "share of the parameter", "share of the force"), _sensitivity),
    "torque": (("shear law", "soil", "load [N]", "torque [N.m]"), _torque),
    "shear": (("soil", "shear law", "angle [deg]", "shear stress [kPa]"), _shear),
    "convergence": (("parameter", "run", "step", "over truth"), _convergence),
}
"""Columns and rows of each figure."""
