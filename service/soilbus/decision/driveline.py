"""Which wheels drive, and how a motor's torque limit is shared out among them.

disengaged   wheels of a shaft to both axles that turn slower than the other axle and no faster than the ground
idle         those, and wheels without torque while another one pulls
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.window import Rig, Window
from soilbus.sensors.options import CONSISTENCY


def idle(window: Window, rig: Rig, since: float, before: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which wheels (W,) do not drive: without torque while another pulls, for most of the time after `since`.

    The result before is kept where no wheel pulls or a torque is not known.  Such a wheel rolls, even if its motor
    reports a torque limit.  Behind a shaft that drives both axles no torque of one axle is measured: there speeds say
    whether it is engaged.
    """
    window = window.rows(np.flatnonzero(window.t > since))
    of_shaft, apart = _disengaged(window, rig, before)
    return np.where(of_shaft, apart, _without_torque(window, rig, before))


def shared_out(limit: NDArray[np.float64], apart: NDArray[np.bool_], rig: Rig) -> NDArray[np.float64]:
    """Return the torque limits (W,) [N m] where motors turn no wheels that are `apart` (disengaged)."""
    if rig.instrumentation is None or not apart.any():
        return limit
    limit = limit.copy()
    for motor in rig.instrumentation.motors:
        wheels, weight = np.array(motor.wheels), np.array(motor.weight)
        on = ~apart[wheels]
        whole, left = float(weight @ limit[wheels]), float((weight * limit[wheels])[on].sum())
        if left > 0.0:
            limit[wheels[on]] *= whole / left
    limit[apart] = 0.0
    return limit


def _without_torque(window: Window, rig: Rig, before: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which wheels (W,) have no torque while another one pulls, most of the time; else as before."""
    with np.errstate(invalid="ignore", divide="ignore"):
        traction = window.torque / (rig.radius * window.load)
        pulls = (traction > CONSISTENCY.driving_traction).any(axis=1)
        still = np.abs(traction[pulls]) < CONSISTENCY.idle_traction
    known = np.isfinite(traction[pulls])
    if 2 * pulls.sum() <= len(traction):
        return before
    return np.where(2 * known.sum(axis=0) > len(known), 2 * still.sum(axis=0) > known.sum(axis=0), before)


def disengaged(window: Window, rig: Rig, since: float, before: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which wheels (W,) a shaft of both axles does not turn after `since` [s], by speeds; else as before."""
    of_shaft, apart = _disengaged(window.rows(np.flatnonzero(window.t > since)), rig, before)
    return of_shaft & apart


def _disengaged(window: Window, rig: Rig, before: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Wheels (W,) on a locked shaft to both axles, and which of them it does not turn; as before where it drives none.

    A shaft that drives turns both axles alike.  The axle that it does not turn is slower, and not faster than the
    ground, for it is pushed.
    """
    of_shaft, apart = np.zeros(len(rig.wheels), bool), before.copy()
    given = rig.instrumentation
    if given is None:
        return of_shaft, apart
    turns = np.where(given.without_speed, np.nan, given.ratio * window.speed)
    rolls = rig.radius * window.speed - window.ground_speed[:, None]
    for coupling in given.couplings:
        wheels = [*coupling.one, *coupling.other]
        if coupling.of_axle or not coupling.locked or not any(set(wheels) <= set(m.wheels) for m in given.motors):
            continue
        of_shaft[wheels] = True
        one, other = (turns[:, list(part)].mean(axis=1) for part in (coupling.one, coupling.other))
        drives = np.isfinite(one + other) & (window.torque[:, wheels].sum(axis=1) > 0.0)
        if 2 * drives.sum() <= len(drives):
            continue
        for part, own, others in ((coupling.one, one, other), (coupling.other, other, one)):
            pushed = rolls[:, list(part)].mean(axis=1) <= 0.0
            slower = own < (1.0 - CONSISTENCY.gear_slack) * others
            apart[list(part)] = 2 * (pushed & slower & drives).sum() > drives.sum()
    return of_shaft, apart
