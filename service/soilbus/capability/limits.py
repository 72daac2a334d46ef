"""How far a balance may go: torque, sinkage and slip limits, the largest pull, and the best slips."""

from __future__ import annotations

from functools import reduce
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.capability.balance import Balance
from soilbus.capability.uncertain_model import ModelOfRows
from soilbus.capability.wheels import Axles
from soilbus.terra.wheel import MAX_ENTRY_ANGLE

Array = NDArray[np.float64]
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
