"""The vehicle over slip under a duty: draft, slope, or both, with the load transfer they bring."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.capability.sigma_points import SigmaPoints
from soilbus.capability.wheels import WheelTable

Array = NDArray[np.float64]

PARTS = 5
"""Points into which each step of the slip grid is divided."""
STEPS = 3
"""Of Newton's method with the slope of the start, which is nearly that of the end."""
MAX_SINE = 0.99


class Duty(NamedTuple):
    """What the pull is for: a draft [N] and a slope (its sine).  The one that is None takes all that is left."""

    draft: Any = None
    sine: float | None = 0.0

    def split(self, pull: Any, weight: float) -> tuple[Any, Any]:
        """Draft [N] and sine of the slope that take this pull [N]."""
        if self.draft is None:
            return pull - weight * (self.sine or 0.0), self.sine
        return self.draft, (pull - self.draft) / weight


LEVEL = Duty()


@dataclass(frozen=True, slots=True)
class Balance:
    """The steady states of D soils at F slips, known (D, F) where there is one.

    columns (D, 1 + 3 A, F): pull [N] of the vehicle, then by kind of wheel drawbar pull [N], torque [N m]
    and entry angle [rad] of one.
    """

    slip: Array
    known: NDArray[np.bool_]
    columns: Array

    @property
    def pull(self) -> Array:
        """Of the vehicle [N] (D, F)."""
        return self.columns[:, 0]

    @property
    def drawbar(self) -> Array:
        """Pull of one wheel [N] (D, A, F)."""
        return self._of_wheels(0)

    @property
    def torque(self) -> Array:
        """Of one wheel [N m] (D, A, F)."""
        return self._of_wheels(1)

    @property
    def angle(self) -> Array:
        """Entry angle [rad] (D, A, F)."""
        return self._of_wheels(2)

    def drawn(self, points: SigmaPoints) -> Balance:
        """The same of a posterior's mode and draws (1 + N in the place of D), from that of its points."""
        known = np.broadcast_to(self.known[0], (len(points.share), len(self.slip)))
        if not self.known.all():
            known = known & (points.drawn(self.known.astype(float)) > 0.5)
        return Balance(self.slip, known, points.drawn(self.columns, self.known[:, None]))

    def _of_wheels(self, quantity: int) -> Array:
        kinds = self.columns.shape[1] // 3
        return self.columns[:, 1 + quantity * kinds : 1 + (quantity + 1) * kinds]


def balance(table: WheelTable, duty: Duty = LEVEL, level: Balance | None = None) -> Balance:
    """Steady states under a duty between the slips of the table, on PARTS times as many slips.

    Cubic Hermite interpolation: the table knows how everything changes with slip.  `level` is
    the table's balance on the level, where that is at hand.
    """
    slip, cell, of_values, of_slopes, of_changes = _refinement(tuple(table.slip.tolist()))
    if level is None:
        columns = _times(_columns(table.pull, table.at), of_values) + _times(_by_slip(table), of_slopes)
        level = Balance(slip, _between(table.balanced, cell), columns)
    if duty == LEVEL:
        return level
    change, balanced = _under(table, duty)
    return Balance(slip, _between(balanced, cell), level.columns + _times(change, of_changes))


def climbing(table: WheelTable, drafts: Sequence[float], level: Balance) -> list[Balance]:
    """As `balance` with each of the drafts [N] and the slope that takes what is left, all worked out together."""
    slip, cell, _, _, of_changes = _refinement(tuple(table.slip.tolist()))
    changes, balanced = _under(table, Duty(np.array(drafts)[:, None, None], None))
    columns = level.columns + _times(changes, of_changes)
    return [Balance(slip, _between(known, cell), of) for known, of in zip(balanced, columns, strict=True)]


def _times(columns: Array, matrix: Array) -> Array:
    """Columns (..., C, S), those not known as zero, times a matrix (S, F): (..., C, F)."""
    known = np.where(np.isfinite(columns), columns, 0.0)
    return np.asarray(known.reshape(-1, len(matrix)) @ matrix).reshape(*columns.shape[:-1], -1)


def _between(balanced: NDArray[np.bool_], cell: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Where both ends of a step of the grid are balanced (D, F)."""
    return np.asarray((balanced[:, :-1] & balanced[:, 1:])[:, cell])


def _columns(pull: Array, at: Iterable[Array]) -> Array:
    """Pull (..., D, S), then pulls, torques and entry angles by kind, each (..., D, A, S): (..., D, 1 + 3 A, S)."""
    return np.concatenate([pull[..., None, :], *at], axis=-2)


def _by_slip(table: WheelTable) -> Array:
    """Derivatives by slip of the columns of the level table, with the loads following."""
    axles = table.axles
    loss = 1.0 - (axles.count * table.by_load[0] * axles.lever).sum(axis=1)
    pull_by_slip = (axles.count * table.by_slip[0]).sum(axis=1) / loss
    by_slip = table.by_slip + table.by_load * (axles.lever * pull_by_slip[:, None])
    return _columns(pull_by_slip, by_slip)


def _under(table: WheelTable, duty: Duty) -> tuple[Array, NDArray[np.bool_]]:
    """Change of the table's columns under another duty, and where they are a steady state (D, S).

    A duty of several drafts (Q, 1, 1) gives each for all of them, (Q, D, ...).
    """
    axles, weight = table.axles, table.axles.weight
    level = pull = np.where(table.balanced, table.pull, 0.0)
    by_pull = axles.lever if duty.draft is None else axles.tilt / weight
    slope = (axles.count * table.by_load[0] * by_pull).sum(axis=1) - 1.0
    for _ in range(STEPS):
        load = axles.loads(*duty.split(pull, weight))
        pull = pull - (table.pull_at(load) - pull) / slope
    _, sine = duty.split(pull, weight)
    balanced = table.balanced & (load > 0.0).all(axis=-2) & (np.abs(sine) < MAX_SINE)
    change = _columns(pull - level, table.change_at(load))
    return np.where(balanced[..., None, :], change, np.nan), balanced


@cache
def _refinement(slips: tuple[float, ...]) -> tuple[Array, NDArray[np.intp], Array, Array, Array]:
    """Finer slips (F,), the grid's step in which each lies, and what values, slopes and values whose
    slopes are not known, so taken from differences of second order, (S, F) add to it."""
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
    differences = np.gradient(np.eye(len(slip)), slip, axis=1)
    return slip[cell] + width * part, cell, of_values, of_slopes, of_values + differences @ of_slopes
