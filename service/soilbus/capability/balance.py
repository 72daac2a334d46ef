"""The vehicle over slip under a duty: draft, slope, or both, with the load transfer they bring."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.capability.wheels import WheelTable

Array = NDArray[np.float64]

PARTS = 5
"""Points into which each step of the slip grid is divided."""
SMALL_PULL = 1.0
"""Pull [N] for the slope of the load transfer."""
STEPS = 3
"""Of Newton's method with the slope of the start, which is nearly that of the end."""
MAX_SINE = 0.99


class Duty(NamedTuple):
    """What the pull is for: a draft [N] and a slope (its sine).  The one that is None takes all that is left."""

    draft: float | None = None
    sine: float | None = 0.0

    def split(self, pull: Any, weight: float) -> tuple[Any, Any]:
        """Draft [N] and sine of the slope that take this pull [N]."""
        if self.draft is None:
            return pull - weight * (self.sine or 0.0), self.sine
        return self.draft, (pull - self.draft) / weight


LEVEL = Duty()


@dataclass(frozen=True, slots=True)
class Balance:
    """The steady states of D soils at F slips: pull [N] of the vehicle (D, F), known (D, F) where there is one.

    drawbar [N], torque [N m] and angle (entry angle [rad]) are one wheel's, (D, A, F).
    """

    slip: Array
    known: NDArray[np.bool_]
    pull: Array
    drawbar: Array
    torque: Array
    angle: Array


def balance(table: WheelTable, duty: Duty = LEVEL) -> Balance:
    """Steady states under a duty between the slips of the table, on PARTS times as many slips.

    Cubic Hermite interpolation: the table knows how everything changes with slip.
    """
    slips = tuple(table.slip.tolist())
    columns, by_slip = _over_slip(table)
    balanced = table.balanced
    if duty != LEVEL:
        other, balanced = _under(table, duty)
        difference = np.where(np.isfinite(other), other - columns, 0.0)
        columns, by_slip = columns + difference, by_slip + difference @ _differences(slips)
    slip, cell, of_values, of_slopes = _refinement(slips)
    known = (balanced[:, :-1] & balanced[:, 1:])[:, cell]
    fine = np.where(np.isfinite(columns), columns, 0.0) @ of_values
    fine += np.where(np.isfinite(by_slip), by_slip, 0.0) @ of_slopes
    drawbar, torque, angle = np.moveaxis(fine[:, 1:].reshape(len(fine), 3, -1, len(slip)), 1, 0)
    return Balance(slip, known, fine[:, 0], drawbar, torque, angle)


def _columns(pull: Array, at: Array) -> Array:
    """Pull, then drawbar pull, torque and entry angle by kind of wheel: (D, 1 + 3 A, S)."""
    return np.concatenate([pull[:, None], *at], axis=1)


def _over_slip(table: WheelTable) -> tuple[Array, Array]:
    """Columns of the level table, and their derivatives by slip with the loads following."""
    axles = table.axles
    loss = 1.0 - (axles.count * table.by_load[0] * axles.lever).sum(axis=1)
    pull_by_slip = (axles.count * table.by_slip[0]).sum(axis=1) / loss
    by_slip = table.by_slip + table.by_load * (axles.lever * pull_by_slip[:, None])
    return _columns(table.pull, table.at), _columns(pull_by_slip, by_slip)


def _under(table: WheelTable, duty: Duty) -> tuple[Array, NDArray[np.bool_]]:
    """Columns of the table under another duty, and where they are a steady state (D, S)."""
    axles, weight = table.axles, table.axles.weight
    pull = np.where(table.balanced, table.pull, 0.0)
    light, heavy = (axles.loads(*duty.split(np.array([p]), weight)) for p in (0.0, SMALL_PULL))
    slope = (axles.count * table.by_load[0] * (heavy - light)).sum(axis=1) / SMALL_PULL - 1.0
    for _ in range(STEPS):
        load = axles.loads(*duty.split(pull, weight))
        pull = pull - (table.pull_at(load) - pull) / slope
    _, sine = duty.split(pull, weight)
    balanced = table.balanced & (load > 0.0).all(axis=1) & (np.abs(sine) < MAX_SINE)
    return _columns(pull, table.at_load(load)), balanced


@cache
def _refinement(slips: tuple[float, ...]) -> tuple[Array, NDArray[np.intp], Array, Array]:
    """Finer slips (F,), the grid's step in which each lies, and what values and slopes (S, F) add to it."""
    slip = np.array(slips)
    step, part = np.divmod(np.arange(PARTS * (len(slip) - 1) + 1), PARTS)
    part = np.where(step == len(slip) - 1, PARTS, part) / PARTS
    cell = np.minimum(step, len(slip) - 2)
    width = np.diff(slip)[cell]
    of_values, of_slopes = np.zeros((2, len(slip), len(cell)))
    column = np.arange(len(cell))
    of_values[cell, column] = (1.0 + 2.0 * part) * (1.0 - part) ** 2
    of_values[cell + 1, column] = part**2 * (3.0 - 2.0 * part)
    of_slopes[cell, column] = width * part * (1.0 - part) ** 2
    of_slopes[cell + 1, column] = width * part**2 * (part - 1.0)
    return slip[cell] + width * part, cell, of_values, of_slopes


@cache
def _differences(slips: tuple[float, ...]) -> Array:
    """What turns values at the slips (S,) into derivatives by slip (S, S), of second order."""
    return np.asarray(np.gradient(np.eye(len(slips)), np.array(slips), axis=1))
