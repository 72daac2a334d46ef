"""Wheels that spin and a vehicle that does not move, as the sensors show them, whatever soil was estimated.

    slip velocity of a wheel   v_s = r omega - V
    it spins where             v_s > max(v_min, s_max r omega)
    the vehicle stalls where   V < v_min and no wheel turns, while the wheels' thrust sum(T / r) exceeds what draft,
                               slope and inertia ask by `stall_resistance`, or all motors give all they can

Slip 1 - V/(r omega) is not defined at standstill, its velocity is: so one rule holds from standstill to full speed.
What lasts for `spin_time` takes the word from any estimate that says go; a vehicle that spins or stalls without making
way for `stuck_time` is stuck.  It stays stuck until it has moved, for the ground is the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.config.model import NoiseOfChannels
from soilbus.config.model import Traversability as Settings
from soilbus.estimation.window import Rig, Window, pull_given
from soilbus.sensors.consistency import NO_TRACTION, TRACTION
from soilbus.terra.vehicle import GRAVITY

if TYPE_CHECKING:
    from soilbus.decision.capability import OverSlip

LONGEST_GAP = 1.0
"""Silence [s] after which nothing is known of what lasts."""


class Motion(NamedTuple):
    """One moment: time [s], ground speed [m/s], rim speeds [m/s] of the wheels, and whether thrust moves nothing.

    nan is what is not known.  slip: mean of the driving wheels, by their torques; pull [N]: of draft, slope and
    inertia, nan where the acceleration is not measured.  resistance: thrust beyond what these three ask, as a share of
    the weight.  at_limit: every motor whose limit is known gives all it can, and at least one is known.
    """

    t: float
    ground: float
    rim: Sequence[float]
    resistance: float
    at_limit: bool
    slip: float = math.nan
    pull: float = math.nan


@dataclass(frozen=True, slots=True)
class TractionLoss:
    """What is remembered from one moment to the next; `observed` makes the next one.  All times in s.

    t: the last moment.  spins, sticks, moves: since when a wheel spins or the vehicle stalls, it makes no way under
    thrust, it moves without spinning; inf where it does not.  stuck: it was, and has not moved since.  last: when any
    of it was last seen to last; what was measured before then says nothing of the ground under the wheels.
    slip, pull: of late, with `spin_time` as time constant; nan where not known.
    """

    t: float = -math.inf
    spins: float = math.inf
    sticks: float = math.inf
    moves: float = math.inf
    spinning: bool = False
    stuck: bool = False
    last: float = -math.inf
    slip: float = math.nan
    pull: float = math.nan

    @property
    def present(self) -> bool:
        """Whether a wheel spins, or the vehicle is stuck."""
        return self.spinning or self.stuck


NO_LOSS = TractionLoss()


def observed(before: TractionLoss, motion: Motion, min_speed: float, settings: Settings) -> TractionLoss:
    """What is lost after one more moment; moments in their order, at any rate.

    Parameters
    ----------
    before
        What the moment before left; nothing of it counts after LONGEST_GAP, or when time goes back.
    motion
        The wheels and the vehicle now.
    min_speed
        Least speed [m/s] above which the vehicle moves.
    settings
        `max_slip`, `spin_time`, `stuck_time`, `standstill`, `stall_resistance`.

    Returns
    -------
    TractionLoss
        With `spinning` and `stuck` as of now.
    """
    if not 0.0 <= motion.t - before.t <= LONGEST_GAP:
        before = replace(before, spins=math.inf, sticks=math.inf, moves=math.inf) if motion.t > before.t else NO_LOSS
    known = [rim for rim in motion.rim if math.isfinite(rim)]
    if not known or not math.isfinite(motion.ground):
        return replace(before, t=motion.t, slip=math.nan, pull=math.nan)
    spinning = sum(rim - motion.ground > max(min_speed, settings.max_slip * rim) for rim in known)
    stands = motion.ground < min_speed
    forced = motion.at_limit or motion.resistance > settings.stall_resistance  # nan: not known
    stalls = stands and forced and max(known) < settings.standstill
    no_way = stalls or (spinning > 0 and stands) or 2 * spinning >= len(known)
    t = motion.t
    spins = min(before.spins, t) if spinning or stalls else math.inf
    sticks = min(before.sticks, t) if no_way else math.inf
    moves = min(before.moves, t) if not stands and not spinning else math.inf
    stuck = t - sticks >= settings.stuck_time or (before.stuck and t - moves < settings.spin_time)
    lasting = t - spins >= settings.spin_time
    kept = math.exp(-(t - before.t) / settings.spin_time) if math.isfinite(before.slip + before.pull) else 0.0
    slip, pull = (
        now + kept * (late - now) if kept else now
        for now, late in ((motion.slip, before.slip), (motion.pull, before.pull))
    )
    last = t if lasting or stuck else before.last
    return TractionLoss(t, spins, sticks, moves, lasting, stuck, last, slip, pull)


def missing_pull(loss: TractionLoss, curve: OverSlip, noise: NoiseOfChannels, deviations: float) -> float:
    """Pull [N] that the estimate predicts at the present slip and the wheels surely do not give; 0 where nothing is.

    The innovation P(s) - P, less these standard deviations of it: of the curve, of the slip by the gain errors of
    both speeds, and of the draft's gain error.
    """
    known = np.isfinite(curve.pull)
    if not known.any() or not math.isfinite(loss.slip + loss.pull) or loss.slip < curve.slip[0]:
        return 0.0
    slips, pulls, stds = curve.slip[known], curve.pull[known], curve.pull_std[known]
    predicted, std = float(np.interp(loss.slip, slips, pulls)), float(np.interp(loss.slip, slips, stds))
    slope = float(np.interp(loss.slip, slips, np.gradient(pulls, slips))) if len(slips) > 1 else 0.0
    of_slip = slope * (1.0 - loss.slip) * math.hypot(noise.speed.gain, noise.ground_speed.gain)
    sd = math.hypot(std, of_slip, noise.draft.gain * loss.pull)
    return max(predicted - loss.pull - deviations * sd, 0.0)


def idle(window: Window, rig: Rig, since: float, before: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which wheels (W,) do not drive: without torque while another one pulls, for most of the time after `since` [s].

    Whatever limit is reported for its motor, such a wheel rolls.  Where no wheel pulls, or a torque is not known, it is
    as `before` (W,).
    """
    recent = window.t > since
    with np.errstate(invalid="ignore", divide="ignore"):
        traction = window.torque[recent] / (rig.radius * window.load[recent])
        pulls = (traction > TRACTION).any(axis=1)
        still = np.abs(traction[pulls]) < NO_TRACTION
    known = np.isfinite(traction[pulls])
    if 2 * pulls.sum() <= len(traction):
        return before
    return np.where(2 * known.sum(axis=0) > len(known), 2 * still.sum(axis=0) > known.sum(axis=0), before)


def motion_of(window: Window, rig: Rig, torque_limit: NDArray[np.float64], settings: Settings) -> Motion | None:
    """The mean motion over the few bins of a forward window; None without a bin, or for a rig without a chassis.

    torque_limit (W,) [N m] is nan where a motor's is not known.
    """
    if not len(window.t) or rig.chassis is None:
        return None
    columns = np.column_stack(
        [window.ground_speed, pull_given(window, rig.chassis), rig.radius * window.speed, window.torque]
    )
    known = np.isfinite(columns)
    with np.errstate(invalid="ignore"):
        ground, asked, *wheels = np.where(known, columns, 0.0).sum(axis=0) / known.sum(axis=0)
    rim, torque = np.split(np.array(wheels), 2)
    limited = np.isfinite(torque_limit)
    at_limit = limited.any() and (torque[limited] >= settings.full_torque * torque_limit[limited]).all()
    resistance = ((torque / rig.radius).sum() - asked) / (rig.chassis.mass * GRAVITY)
    weights = np.where((torque > 0.0) & (rim > 0.0), torque, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        slip = np.where(weights > 0.0, weights * (1.0 - ground / rim), 0.0).sum() / weights.sum()
    pull = asked if np.isfinite(window.acceleration).any() else math.nan
    return Motion(
        float(window.t[-1]), float(ground), rim.tolist(), float(resistance), bool(at_limit), float(slip), float(pull)
    )
