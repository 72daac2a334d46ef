"""The vehicle over slip under a duty: steady states, the largest pull within the limits, and the best slips.

    pull balance      sum(P_w(s, N_w)) = draft + weight * sine        P_w: drawbar pull of a wheel [N], s: slip
    load transfer     N_w = level_w * cosine + tilt_w * sine + lever_w * draft
    largest pull      max over s of the pull, subject to T_w <= T_max, entry angle <= its limit, s <= s_max

A duty is a draft, a slope, or both.  The wheels' table (`wheels.wheel_table`) holds the steady states on the level at a
few slips, with their derivatives by load and slip.  Other duties follow by Newton steps on the pull; the slips between
by cubic Hermite interpolation.  Everything is computed for all soils of a posterior's sigma points at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.decision.sigma_points import SigmaPoints
from soilbus.decision.uncertain_model import ModelOfRows
from soilbus.decision.wheels import DRAWBAR, MAX_SINE, Axles, WheelTable
from soilbus.terra.wheel import MAX_ENTRY_ANGLE

__all__ = [
    "LEVEL",
    "Balance",
    "BetweenSlips",
    "Columns",
    "Duty",
    "Largest",
    "Limits",
    "axle_sum",
    "balance",
    "climbing",
    "largest_pull",
    "point_of_pull",
    "slips_of_most",
    "within",
]

SUBDIVISIONS = 5
"""Parts into which each step of the slip grid is divided."""
NEWTON_STEPS = 3
"""Newton steps on the pull, all with the slope at the start, which is nearly that at the end."""
Cause = Literal["torque", "traction", "sinkage", "slip"]
"""What ends the pull: a motor, the soil's strength, the sinkage limit, the slip limit."""


class Duty(NamedTuple):
    """Use of the pull: a draft [N] and a slope (its sine); the one that is None takes the rest."""

    draft: Any = None
    sine: float | None = 0.0

    def split(self, pull: Any, weight: float) -> tuple[Any, Any]:
        """Return the draft [N] and the sine of the slope that use this pull [N] of a vehicle of this weight [N]."""
        if self.draft is None:
            return pull - weight * (self.sine or 0.0), self.sine
        return self.draft, (pull - self.draft) / weight


LEVEL = Duty()


class Columns(NamedTuple):
    """Places of a balance's columns: the vehicle's pull, then three quantities for each kind of wheel."""

    pull: int
    drawbar: slice
    torque: slice
    angle: slice

    @staticmethod
    @cache
    def of(kinds: int) -> Columns:
        """Return the columns for this number of kinds of wheels."""
        return Columns(0, *(slice(1 + i * kinds, 1 + (i + 1) * kinds) for i in range(3)))


@dataclass(frozen=True)
class Balance:
    """The steady states of D soils at F slips, for A kinds of wheels.

    Attributes
    ----------
    slip
        (F,).
    known
        (D, F), where a steady state exists.
    columns
        (D, 1 + 3 A, F): pull of the vehicle [N], then drawbar pull [N], torque [N m] and entry angle [rad] of one wheel
        of each kind.  Read them by the properties.
    """

    slip: Array
    known: NDArray[np.bool_]
    columns: Array

    @cached_property
    def at(self) -> Columns:
        """Places of the columns."""
        return Columns.of(self.columns.shape[1] // 3)

    @cached_property
    def pull(self) -> Array:
        """Pull of the vehicle [N] (D, F)."""
        return self.columns[:, self.at.pull]

    @cached_property
    def drawbar(self) -> Array:
        """Drawbar pull of one wheel [N] (D, A, F)."""
        return self.columns[:, self.at.drawbar]

    @cached_property
    def torque(self) -> Array:
        """Torque of one wheel [N m] (D, A, F)."""
        return self.columns[:, self.at.torque]

    @cached_property
    def angle(self) -> Array:
        """Entry angle [rad] (D, A, F)."""
        return self.columns[:, self.at.angle]

    def drawn(self, points: SigmaPoints) -> Balance:
        """Return the balance of a posterior's mode and draws (1 + N instead of D), from that of its sigma points."""
        known = np.broadcast_to(self.known[0], (len(points.share), len(self.slip)))
        if not self.known.all():
            known = known & (points.drawn(self.known.astype(float)) > 0.5)
        return Balance(self.slip, known, points.drawn(self.columns, self.known[:, None]))


class Limits(NamedTuple):
    """Limits: torque [N m] (G,) of each motor, and entry angle [rad] on each soil (D, A) of each kind of wheel.

    motors (G, A): torque of a motor for one unit of each kind of wheel's; where each wheel has its own, G = A and it is
    the unit matrix.
    """

    torque: Array
    angle: Array
    motors: Array

    @classmethod
    def of(cls, axles: Axles, torque_limit: Array, max_sinkage: float, model: ModelOfRows) -> Limits:
        """Return the limits of each kind of wheel.

        Parameters
        ----------
        axles
            The kinds of wheels.
        torque_limit
            (W,) [N m], nan where not known.
        max_sinkage
            [m], converted to an entry angle at the wheels' loads on the level.
        model
            The wheel-soil models of the D soils.
        """
        A = len(axles.count)
        torque, motors = np.full(A, np.inf), np.eye(A)
        np.fmin.at(torque, axles.of_wheel, torque_limit)
        torque[~axles.driven[:, 0]] = np.inf  # they roll
        for group in axles.shared_motors:
            of_kind = np.zeros(A)
            np.add.at(of_kind, axles.of_wheel[list(group.wheels)], group.weight)
            limit = float(np.array(group.weight) @ torque_limit[list(group.wheels)])
            torque[:A][of_kind > 0.0] = np.inf
            motors, torque = np.vstack([motors, of_kind]), np.append(torque, np.inf if np.isnan(limit) else limit)
        deepest = model.angle_of_sinkage(max_sinkage, axles.wheel(axles.level[:, 0]))
        return cls(torque, np.minimum(deepest, MAX_ENTRY_ANGLE), motors)

    def of_motors(self, torque: Array) -> Array:
        """Return the torques of the motors (D, G, ...) from those of one wheel of each kind (D, A, ...)."""
        return torque if len(self.motors) == self.motors.shape[1] else np.einsum("ga,da...->dg...", self.motors, torque)


class Largest(NamedTuple):
    """Largest pull [N] and its slip for each soil (D,), nan where no slip is within the limits, and what limits it."""

    pull: Array
    slip: Array
    cause: Cause


class BetweenSlips(NamedTuple):
    """A point between two slips of a balance, for each soil (D,).

    before: index of the slip before it; share: of the step to the next slip, nan where there is no such point.
    """

    before: NDArray[np.intp]
    share: Array

    def on(self, values: Array) -> Array:
        """Return values (D, ..., F) interpolated linearly at the point: (D, ...)."""
        row = np.arange(len(values))
        here, there = values[row, ..., self.before], values[row, ..., self.before + 1]
        share = self.share.reshape(-1, *(1,) * (here.ndim - 1))
        return np.asarray(here + share * (there - here))


def balance(table: WheelTable, duty: Duty = LEVEL, level: Balance | None = None) -> Balance:
    """Return the steady states under a duty, on a slip grid SUBDIVISIONS times as fine as the table's.

    Parameters
    ----------
    table
        Wheels at the loads of the steady level pull.
    duty
        Draft and slope.
    level
        The table's balance on the level, where it is already computed.

    Notes
    -----
    Cubic Hermite interpolation between the table's slips, with the table's derivatives by slip.
    """
    slip, cell, of_values, of_slopes, of_changes = _refinement(tuple(table.slip.tolist()))
    if level is None:
        columns = _interpolated(_columns(table.pull, table.at), of_values) + _interpolated(
            _derivatives_by_slip(table), of_slopes
        )
        level = Balance(slip, _between(table.balanced, cell), columns)
    if duty == LEVEL:
        return level
    change, balanced = _change_under(table, duty)
    return Balance(slip, _between(balanced, cell), level.columns + _interpolated(change, of_changes))


def climbing(table: WheelTable, drafts: Sequence[float], level: Balance) -> list[Balance]:
    """Return the `balance` with each of the drafts [N] and the slope that uses the rest of the pull."""
    slip, cell, _, _, of_changes = _refinement(tuple(table.slip.tolist()))
    changes, balanced = _change_under(table, Duty(np.array(drafts)[:, None, None], None))
    columns = level.columns + _interpolated(changes, of_changes)
    return [Balance(slip, _between(known, cell), of) for known, of in zip(balanced, columns, strict=True)]


def largest_pull(balance: Balance, limits: Limits) -> Largest:
    """Return the largest pull over slip within the limits.

    Parameters
    ----------
    balance
        Steady states of D soils.
    limits
        Of torque and entry angle.

    Returns
    -------
    Largest
        Linearly interpolated to where a limit is met; its cause is that of the first soil.
    """
    usable = within(balance, limits)
    row, last = np.arange(len(usable)), usable.shape[1] - 1
    best = np.where(usable, balance.pull, -np.inf).argmax(axis=1)
    after = np.minimum(best + 1, last)
    here, there = balance.columns[row, :, best], balance.columns[row, :, after]
    at, n_motors = balance.at, len(limits.torque)
    pull, next_pull, slip = here[:, at.pull], there[:, at.pull], balance.slip[best]
    more = balance.known[row, after] & (next_pull > pull)
    ends = [np.concatenate([limits.of_motors(end[:, at.torque]), end[:, at.angle]], axis=1) for end in (here, there)]
    by_limit = _shares_to_limits(ends[0], ends[1], limits)
    share = np.where(more, by_limit.min(axis=1), 0.0)
    pull = pull + share * (next_pull - pull)
    slip = slip + share * (balance.slip[after] - slip)
    none = ~usable[row, best]
    cause: Cause = "traction"
    if best[0] == last:
        cause = "slip"
    elif more[0]:
        cause = "torque" if by_limit[0, :n_motors].min() <= by_limit[0, n_motors:].min() else "sinkage"
    return Largest(np.where(none, np.nan, pull), np.where(none, np.nan, slip), cause)


def within(balance: Balance, limits: Limits) -> NDArray[np.bool_]:
    """Return which steady states (D, F) are within the limits."""
    usable = balance.known.copy()
    of_motors = limits.of_motors(balance.torque)
    for motor, torque in enumerate(limits.torque):
        usable &= of_motors[:, motor] <= torque
    for kind in range(balance.angle.shape[1]):
        usable &= balance.angle[:, kind] <= limits.angle[..., kind, None]
    return usable


def point_of_pull(balance: Balance, pull: float) -> BetweenSlips:
    """Return the least slip at which each soil gives this pull [N]: the first slip if it gives more, else none."""
    enough = balance.known & (balance.pull >= pull)
    first = enough.argmax(axis=1)
    before = np.maximum(first - 1, 0)
    row = np.arange(len(first))
    low, high = balance.pull[row, before], balance.pull[row, before + 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip((pull - low) / (high - low), 0.0, 1.0)
    share = np.where(balance.known[row, before], share, 1.0)
    return BetweenSlips(before, np.where(enough.any(axis=1), share, np.nan))


def slips_of_most(values: Array, balance: Balance, limits: Limits, top: Array) -> Array:
    """Return the slips at which quantities are largest within the limits.

    Parameters
    ----------
    values
        (Q, D, F), Q quantities over slip.
    balance, limits
        Steady states of D soils, and what is allowed.
    top
        (D,), slip at which the limits end.

    Returns
    -------
    Array
        (Q, D), at the vertex of the parabola through the largest value and its neighbours; nan where no value within
        the limits is above zero.
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
    """Return the sum over all wheels of some kinds (mask (A,)): values (D, A, F) to (D, F), times a factor (A, 1)."""
    share = (axles.count * each)[:, 0]
    return np.asarray(np.einsum("a,daf->df", share[kinds], values[:, kinds]))


def _columns(pull: Array, at: Iterable[Array]) -> Array:
    """Pull (..., D, S), then pulls, torques and entry angles by kind, each (..., D, A, S): (..., D, 1 + 3 A, S)."""
    return np.concatenate([pull[..., None, :], *at], axis=-2)


def _derivatives_by_slip(table: WheelTable) -> Array:
    """Derivatives by slip of the columns of the level table, with the loads following."""
    axles = table.axles
    loss = 1.0 - (axles.count * table.by_load[DRAWBAR] * axles.lever).sum(axis=1)
    pull_by_slip = (axles.count * table.by_slip[DRAWBAR]).sum(axis=1) / loss
    by_slip = table.by_slip + table.by_load * (axles.lever * pull_by_slip[:, None])
    return _columns(pull_by_slip, by_slip)


def _change_under(table: WheelTable, duty: Duty) -> tuple[Array, NDArray[np.bool_]]:
    """Change of the table's columns under another duty, and where there is a steady state (D, S).

    With several drafts (Q, 1, 1) both results have a leading axis Q.
    """
    axles, weight = table.axles, table.axles.weight
    level = pull = np.where(table.balanced, table.pull, 0.0)
    by_pull = axles.lever if duty.draft is None else axles.tilt / weight
    slope = (axles.count * table.by_load[DRAWBAR] * by_pull).sum(axis=1) - 1.0
    for _ in range(NEWTON_STEPS):
        load = axles.loads(*duty.split(pull, weight))
        pull = pull - (table.pull_at(load) - pull) / slope
    _, sine = duty.split(pull, weight)
    balanced = table.balanced & (load > 0.0).all(axis=-2) & (np.abs(sine) < MAX_SINE)
    change = _columns(pull - level, table.change_at(load))
    return np.where(balanced[..., None, :], change, np.nan), balanced


@cache
def _refinement(slips: tuple[float, ...]) -> tuple[Array, NDArray[np.intp], Array, Array, Array]:
    """The fine grid, and the matrices of cubic Hermite interpolation onto it.

    Returns the fine slips (F,), the step of the coarse grid in which each lies (F,), and matrices (S, F): of values, of
    slopes, and of values whose slopes are second-order differences.
    """
    slip = np.array(slips)
    step, part = np.divmod(np.arange(SUBDIVISIONS * (len(slip) - 1) + 1), SUBDIVISIONS)
    part = np.where(step == len(slip) - 1, SUBDIVISIONS, part) / SUBDIVISIONS
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


def _interpolated(columns: Array, matrix: Array) -> Array:
    """Columns (..., C, S), zero where not known, times an interpolation matrix (S, F): (..., C, F)."""
    known = np.where(np.isfinite(columns), columns, 0.0)
    return np.asarray(known.reshape(-1, len(matrix)) @ matrix).reshape(*columns.shape[:-1], -1)


def _between(balanced: NDArray[np.bool_], cell: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Where both ends of a step of the grid are balanced (D, F)."""
    return np.asarray((balanced[:, :-1] & balanced[:, 1:])[:, cell])


def _shares_to_limits(here: Array, there: Array, limits: Limits) -> Array:
    """Shares of the step from here to there at which each limit is met, 1 where it is not.

    All (D, G + A): of the torques by motor, then of the entry angles by kind of wheel.
    """
    limit = np.empty(here.shape)
    limit[:, : len(limits.torque)], limit[:, len(limits.torque) :] = limits.torque, limits.angle
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(there > limit, (limit - here) / (there - here), 1.0)
