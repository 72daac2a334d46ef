"""The vehicle over slip under a duty: steady states, the largest pull within the limits, and the best slips.

    pull balance      sum(P_w(s, N_w)) = draft + weight * sine        P_w: drawbar pull of a wheel [N], s: slip
    load transfer     N_w = level_w * cosine + tilt_w * sine + lever_w * draft
    largest pull      max over s of the pull, subject to T_w <= T_max, entry angle <= its limit, s <= s_max

A duty is a draft, a slope, or both.  The wheels' table (`wheels.wheel_table`) holds the steady states on the level at a
few slips, with their derivatives by load and slip.  Other duties follow by Newton steps on the pull; the slips between
by cubic Hermite interpolation.  Everything is computed for all soils of a posterior's sigma points at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.decision.sigma_points import SigmaPoints
from soilbus.decision.uncertain_model import UncertainModel
from soilbus.decision.wheels import DRAWBAR, MAX_SINE, Axles, WheelTable
from soilbus.terra.wheel import MAX_ENTRY_ANGLE

SUBDIVISIONS = 5
"""Parts into which each step of the slip grid is divided."""
NEWTON_STEPS = 3
"""Newton steps on the pull, all with the slope at the start, which is nearly that at the end."""
Cause = Literal["torque", "traction", "sinkage", "slip"]
"""What ends the pull: a motor, the soil's strength, the sinkage limit, the slip limit."""


class Duty(NamedTuple):
    """Use of the pull: a draft [N] and a slope (its sine); the one that is None takes the rest."""

    draft: float | None = None
    sine: float | None = 0.0

    def split(self, pull: Any, weight: float) -> tuple[Any, Any]:
        """Return the draft [N] and the sine of the slope that use this pull [N] of a vehicle of this weight [N]."""
        if self.draft is None:
            return pull - weight * (self.sine or 0.0), self.sine
        return self.draft, (pull - self.draft) / weight


LEVEL = Duty()


@dataclass(frozen=True)
class Balance:
    """The steady states of D soils at F slips, for A kinds of wheels.

    slip (F,).  known (D, F): where a steady state exists.  columns (D, 1 + 3 A, F): pull of the vehicle [N], then
    drawbar pull [N], torque [N m] and entry angle [rad] of one wheel of each kind; the properties read them.
    """

    slip: Array
    known: NDArray[np.bool_]
    columns: Array

    def _of_kinds(self, place: int) -> Array:
        kinds = self.columns.shape[1] // 3
        return self.columns[:, 1 + place * kinds : 1 + (place + 1) * kinds]

    @cached_property
    def pull(self) -> Array:
        """Pull of the vehicle [N] (D, F)."""
        return self.columns[:, 0]

    @cached_property
    def drawbar(self) -> Array:
        """Drawbar pull of one wheel [N] (D, A, F)."""
        return self._of_kinds(0)

    @cached_property
    def torque(self) -> Array:
        """Torque of one wheel [N m] (D, A, F)."""
        return self._of_kinds(1)

    @cached_property
    def angle(self) -> Array:
        """Entry angle [rad] (D, A, F)."""
        return self._of_kinds(2)

    def filled(self, points: SigmaPoints) -> Balance:
        """Return the balance at a posterior's sigma points with unknown states mirrored about the mode's."""
        known = np.broadcast_to(self.known[0], self.known.shape)
        return Balance(self.slip, known, points.filled(self.columns, self.known[:, None]))


class Limits(NamedTuple):
    """Limits: torque [N m] (G,) of each motor, and entry angle [rad] on each soil (D, A) of each kind of wheel.

    motors (G, A): torque of a motor for one unit of each kind of wheel's; where each wheel has its own, G = A and it is
    the unit matrix.
    """

    torque: Array
    angle: Array
    motors: Array

    @classmethod
    def of(cls, axles: Axles, torque_limit: Array, max_sinkage: float, model: UncertainModel, n: int) -> Limits:
        """Return the limits of each kind of wheel on n soils, the last of which belong to the perturbed models.

        torque_limit: (W,) [N m], nan where not known; max_sinkage [m], converted to an entry angle at the wheels' loads
        on the level.
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
        deepest = model.angle_of_sinkage(max_sinkage, axles.wheel(axles.level[:, 0]), n)
        return cls(torque, np.minimum(deepest, MAX_ENTRY_ANGLE), motors)

    def all(self) -> Array:
        """Return the limits (D, G + A) of what `used` returns."""
        return np.concatenate(
            [np.broadcast_to(self.torque, (*self.angle.shape[:-1], len(self.torque))), self.angle], axis=-1
        )

    def used(self, balance: Balance) -> Array:
        """Return the torques by motor and entry angles by kind (D, G + A, F) of steady states."""
        torque = balance.torque
        if len(self.motors) > torque.shape[1]:
            torque = np.einsum("ga,da...->dg...", self.motors, torque)
        return np.concatenate([torque, balance.angle], axis=1)

    def allow(self, balance: Balance) -> NDArray[np.bool_]:
        """Return which steady states (D, F) are within the limits."""
        return np.asarray(balance.known & (self.used(balance) <= self.all()[..., None]).all(axis=1))


class Largest(NamedTuple):
    """Largest pull [N] and its slip for each soil (D,), nan where no slip is within the limits, and what limits it."""

    pull: Array
    slip: Array
    cause: Cause


def balance(table: WheelTable, duty: Duty = LEVEL, level: Balance | None = None) -> Balance:
    """Return the steady states under a duty, on a slip grid SUBDIVISIONS times as fine as the table's.

    level: the table's balance on the level, where it is already computed.
    """
    slip, cell, of_values, of_slopes, of_changes = _refinement(tuple(table.slip.tolist()))
    axles, weight, balanced = table.axles, table.axles.weight, table.balanced
    if level is None:
        loss = 1.0 - (axles.count * table.by_load[DRAWBAR] * axles.lever).sum(axis=1)
        pull_by_slip = (axles.count * table.by_slip[DRAWBAR]).sum(axis=1) / loss
        by_slip = table.by_slip + table.by_load * (axles.lever * pull_by_slip[:, None])
        columns = _columns(table.pull, table.at) @ of_values + _columns(pull_by_slip, by_slip) @ of_slopes
        level = Balance(slip, (balanced[:, :-1] & balanced[:, 1:])[:, cell], columns)
    if duty == LEVEL:
        return level
    start = pull = np.where(balanced, table.pull, 0.0)
    by_pull = axles.lever if duty.draft is None else axles.tilt / weight
    slope = (axles.count * table.by_load[DRAWBAR] * by_pull).sum(axis=1) - 1.0
    for _ in range(NEWTON_STEPS):
        load = axles.loads(*duty.split(pull, weight))
        change = table.change_at(load)
        pull = pull - ((axles.count * (table.at[DRAWBAR] + change[DRAWBAR])).sum(axis=1) - pull) / slope
    _, sine = duty.split(pull, weight)
    balanced = balanced & (load > 0.0).all(axis=1) & (np.abs(sine) < MAX_SINE)
    changes = np.where(balanced[:, None], _columns(pull - start, change), 0.0)
    return Balance(slip, (balanced[:, :-1] & balanced[:, 1:])[:, cell], level.columns + changes @ of_changes)


def largest_pull(balance: Balance, limits: Limits) -> Largest:
    """Return the largest pull over slip within the limits.

    It is interpolated linearly to where a limit is met; its cause is that of the first soil.
    """
    used, limit = limits.used(balance), limits.all()
    usable = balance.known & (used <= limit[..., None]).all(axis=1)
    row, last = np.arange(len(usable)), usable.shape[1] - 1
    best = np.where(usable, balance.pull, -np.inf).argmax(axis=1)
    after = np.minimum(best + 1, last)
    pull, next_pull, slip = balance.pull[row, best], balance.pull[row, after], balance.slip[best]
    more = balance.known[row, after] & (next_pull > pull)
    here, there = used[row, :, best], used[row, :, after]
    with np.errstate(divide="ignore", invalid="ignore"):
        by_limit = np.where(there > limit, (limit - here) / (there - here), 1.0)
    share = np.where(more, by_limit.min(axis=1), 0.0)
    pull = pull + share * (next_pull - pull)
    slip = slip + share * (balance.slip[after] - slip)
    none = ~usable[row, best]
    cause: Cause = "traction"
    if best[0] == last:
        cause = "slip"
    elif more[0]:
        cause = "torque" if by_limit[0].argmin() < len(limits.torque) else "sinkage"
    return Largest(np.where(none, np.nan, pull), np.where(none, np.nan, slip), cause)


def at_pull(balance: Balance, pull: float) -> Callable[[Array], Array]:
    """Return a function that interpolates values (D, ..., F) to the least slip at which each soil gives a pull [N].

    That is the first slip where it gives more; where none does, the values are nan.
    """
    enough = balance.known & (balance.pull >= pull)
    row, before = np.arange(len(enough)), np.maximum(enough.argmax(axis=1) - 1, 0)
    low, high = balance.pull[row, before], balance.pull[row, before + 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip((pull - low) / (high - low), 0.0, 1.0)
    share = np.where(balance.known[row, before], share, 1.0)
    share = np.where(enough.any(axis=1), share, np.nan)

    def on(values: Array) -> Array:
        here, there = values[row, ..., before], values[row, ..., before + 1]
        return np.asarray(here + share.reshape(-1, *(1,) * (here.ndim - 1)) * (there - here))

    return on


def slips_of_most(values: Array, balance: Balance, limits: Limits, top: Array) -> Array:
    """Return the slips (Q, D) at which Q quantities over slip (Q, D, F) are largest within the limits.

    They are the vertices of parabolas through the largest values and their neighbours, up to the slip `top` (D,) at
    which the limits end; nan where no value within the limits is above zero.
    """
    slip, last = balance.slip, len(balance.slip) - 1
    usable = limits.allow(balance) & (values > 0.0)
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


def _columns(pull: Array, at: Array) -> Array:
    """Pull (D, S), then pulls, torques and entry angles by kind (3, D, A, S): (D, 1 + 3 A, S), 0 where not known."""
    columns = np.concatenate([pull[:, None], *at], axis=1)
    return np.where(np.isfinite(columns), columns, 0.0)


@cache
def _refinement(slips: tuple[float, ...]) -> tuple[Array, NDArray[np.intp], Array, Array, Array]:
    """Fine slips (F,), the step of each, and matrices (S, F) that interpolate by values, by slopes, by values alone."""
    slip = np.array(slips)
    place = np.arange(SUBDIVISIONS * (len(slip) - 1) + 1) / SUBDIVISIONS
    cell = np.minimum(place.astype(int), len(slip) - 2)
    part, width, unit = place - cell, np.diff(slip)[cell], np.eye(len(slip))
    here, there = unit[:, cell], unit[:, cell + 1]
    of_values = here * (1.0 + 2.0 * part) * (1.0 - part) ** 2 + there * part**2 * (3.0 - 2.0 * part)
    of_slopes = width * (here * part * (1.0 - part) ** 2 + there * part**2 * (part - 1.0))
    differences = np.gradient(unit, slip, axis=1)
    return slip[cell] + width * part, cell, of_values, of_slopes, of_values + differences @ of_slopes
