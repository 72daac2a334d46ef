"""Which wheels drive, and how a motor's torque limit is shared out among them.

disengaged   wheels of a shaft to both axles that turn slower than the other axle and no faster than the ground
idle         those, and wheels without torque while another one pulls
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.instrumentation import Coupling
from soilbus.estimation.window import Rig, Window
from soilbus.sensors.options import CONSISTENCY


def idle(window: Window, rig: Rig, since: float, before: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which wheels (W,) do not drive: without torque while another pulls, for most of the time after `since`.

    The result before is kept where no wheel pulls or a torque is not known.  On a shaft that drives both axles, where
    no torque of one axle is measured, speeds say it.
    """
    window = window.rows(np.flatnonzero(window.t > since))
    return np.where(on_shaft(rig), _disengaged(window, rig, before), _without_torque(window, rig, before))


def on_shaft(rig: Rig) -> NDArray[np.bool_]:
    """Return which wheels (W,) are on a locked shaft to both axles; one that is idle there is disengaged."""
    found = np.zeros(len(rig.wheels), bool)
    for coupling in _shafts(rig):
        found[[*coupling.one, *coupling.other]] = True
    return found


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


def _shafts(rig: Rig) -> list[Coupling]:
    """Locked couplings between the axles that one motor drives."""
    given = rig.instrumentation
    if given is None:
        return []
    driven = [set(motor.wheels) for motor in given.motors]
    between = [coupling for coupling in given.couplings if coupling.locked and not coupling.of_axle]
    return [each for each in between if any({*each.one, *each.other} <= wheels for wheels in driven)]


def _disengaged(window: Window, rig: Rig, before: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which wheels (W,) a shaft does not turn: slower than the other axle's, and pushed; else as before."""
    apart = before.copy()
    if rig.instrumentation is None:
        return apart
    turns = np.where(rig.instrumentation.without_speed, np.nan, rig.instrumentation.ratio * window.speed)
    rolls = rig.radius * window.speed - window.ground_speed[:, None]
    for coupling in _shafts(rig):
        one, other = (turns[:, list(part)].mean(axis=1) for part in (coupling.one, coupling.other))
        torque = window.torque[:, [*coupling.one, *coupling.other]].sum(axis=1)
        drives = np.isfinite(one + other) & (torque > 0.0)
        if 2 * drives.sum() <= len(drives):
            continue
        for part, own, others in ((coupling.one, one, other), (coupling.other, other, one)):
            pushed = rolls[:, list(part)].mean(axis=1) <= 0.0
            slower = own < (1.0 - CONSISTENCY.gear_slack) * others
            apart[list(part)] = 2 * (pushed & slower & drives).sum() > drives.sum()
    return apart
