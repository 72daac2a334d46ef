"""The vehicle over slip under a duty: draft, slope, or both, with the load transfer they bring.

How far a balance may go: torque, sinkage and slip limits, the largest pull, and the best slips.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.decision.sigma_points import SigmaPoints
from soilbus.decision.uncertain_model import ModelOfRows
from soilbus.decision.wheels import Axles, WheelTable
from soilbus.terra.wheel import MAX_ENTRY_ANGLE

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


Cause = Literal["torque", "traction", "sinkage", "slip"]


class Limits(NamedTuple):
    """Of each kind of wheel the greatest torque [N m] (A,), and for each soil the greatest entry angle [rad] (D, A)."""

    torque: Array
    angle: Array

    @classmethod
    def of(cls, axles: Axles, torque_limit: Array, max_sinkage: float, model: ModelOfRows) -> Limits:
        """From the wheels' torque limits (W,) [N m], nan where not known, and a sinkage [m] of wheels on the level."""
        torque = np.full(len(axles.count), np.inf)
        np.fmin.at(torque, axles.of_wheel, torque_limit)
        torque[~axles.driven[:, 0]] = np.inf  # they roll
        deepest = model.angle_of_sinkage(max_sinkage, axles.wheel(axles.level[:, 0]))
        return cls(torque, np.minimum(deepest, MAX_ENTRY_ANGLE))


class Largest(NamedTuple):
    """The largest pull [N] and its slip for each soil (D,), nan where no slip is within the limits; what ends it."""

    pull: Array
    slip: Array
    cause: Cause


def within(balance: Balance, limits: Limits) -> NDArray[np.bool_]:
    """Steady states within the limits (D, F)."""
    usable = balance.known.copy()
    for kind, torque in enumerate(limits.torque):
        usable &= balance.torque[:, kind] <= torque
        usable &= balance.angle[:, kind] <= limits.angle[..., kind, None]
    return usable


def largest_pull(balance: Balance, limits: Limits) -> Largest:
    """Largest pull over slip; the cause is that of the first soil."""
    usable = within(balance, limits)
    row, last = np.arange(len(usable)), usable.shape[1] - 1
    best = np.where(usable, balance.pull, -np.inf).argmax(axis=1)
    after = np.minimum(best + 1, last)
    here, there = balance.columns[row, :, best], balance.columns[row, :, after]
    pull, slip = here[:, 0], balance.slip[best]
    more = balance.known[row, after] & (there[:, 0] > pull)
    kinds = len(limits.torque)
    by_limit = _shares(here[:, 1 + kinds :], there[:, 1 + kinds :], limits)
    share = np.where(more, by_limit.min(axis=1), 0.0)
    pull = pull + share * (there[:, 0] - pull)
    slip = slip + share * (balance.slip[after] - slip)
    none = ~usable[row, best]
    cause: Cause = "traction"
    if best[0] == last:
        cause = "slip"
    elif more[0]:
        cause = "torque" if by_limit[0, :kinds].min() <= by_limit[0, kinds:].min() else "sinkage"
    return Largest(np.where(none, np.nan, pull), np.where(none, np.nan, slip), cause)


def _shares(here: Array, there: Array, limits: Limits) -> Array:
    """Shares of the way from here to there at which each limit is met, 1 where it is not.

    All (D, 2 A): of the torques by kind of wheel, then of the entry angles.
    """
    limit = np.empty(here.shape)
    limit[:, : len(limits.torque)], limit[:, len(limits.torque) :] = limits.torque, limits.angle
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(there > limit, (limit - here) / (there - here), 1.0)


class Place(NamedTuple):
    """A place between the slips of a balance for each soil (D,): the point before it and the share beyond.

    share is nan where there is none.
    """

    before: NDArray[np.intp]
    share: Array

    def on(self, values: Array) -> Array:
        """Values (D, ..., F) at the place: (D, ...)."""
        row = np.arange(len(values))
        here, there = values[row, ..., self.before], values[row, ..., self.before + 1]
        share = self.share.reshape(-1, *(1,) * (here.ndim - 1))
        return np.asarray(here + share * (there - here))


def place_of_pull(balance: Balance, pull: float) -> Place:
    """Where each soil gives this pull [N]: at the least slip if less would do, nowhere if no slip gives it."""
    enough = balance.known & (balance.pull >= pull)
    first = enough.argmax(axis=1)
    before = np.maximum(first - 1, 0)
    row = np.arange(len(first))
    low, high = balance.pull[row, before], balance.pull[row, before + 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip((pull - low) / (high - low), 0.0, 1.0)
    share = np.where(balance.known[row, before], share, 1.0)
    return Place(before, np.where(enough.any(axis=1), share, np.nan))


def slips_of_most(values: Array, balance: Balance, limits: Limits, top: Array) -> Array:
    """Slips (Q, D) at which values (Q, D, F) are largest within the limits; nan where none is above zero.

    top (D,) is the slip at which the limits end.
    """
    slip, last = balance.slip, len(balance.slip) - 1
    usable = within(balance, limits) & (values > 0.0)
    best = (values * usable).argmax(axis=-1)
    after = np.minimum(best + 1, last)
    quantity, row = np.ogrid[: len(values), : values.shape[1]]
    middle = np.minimum(np.maximum(best, 1), last - 1)
    i = np.stack([middle - 1, middle, middle + 1])
    x0, x1, x2 = slip[i]
    y0, y1, y2 = values[quantity, row, i]
    rise, fall = (y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1)
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = 0.5 * (x0 + x1) + 0.5 * (x2 - x0) * rise / (rise - fall)
    inside = usable[quantity, row, i].all(axis=0) & (best == middle)
    low, high = slip[best], slip[after]
    at_end = np.where(usable[quantity, row, after], low, np.clip(top, low, high))
    return np.where(usable[quantity, row, best], np.where(inside, vertex, at_end), np.nan)


def axle_sum(values: Array, axles: Axles, kinds: NDArray[np.bool_], each: Array | float = 1.0) -> Array:
    """Sum over the wheels of some kinds (A,), (D, A, F) to (D, F), each wheel's times a factor (A, 1)."""
    share = (axles.count * each)[:, 0].tolist()
    return reduce(np.add, (share[kind] * values[:, kind] for kind in np.flatnonzero(kinds).tolist()))
