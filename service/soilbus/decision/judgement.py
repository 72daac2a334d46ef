"""Traversability: the probability that the vehicle can do what is asked of it, and the state that follows.

    P(pull)     = Phi((max_pull - demand - margin * max(demand, 0)) / sd)
    P(depth)    = Phi((max_sinkage - sinkage of the deepest wheel) / sd)
    P           = min(P(pull), P(depth)) -> go, caution or no_go by the configured thresholds

`judge` decides when a window ends; `at_present` says what remains of it later.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.config.model import Config, NoiseOfChannels
from soilbus.config.model import Traversability as Settings
from soilbus.decision.capability import Demand, OverSlip, assess
from soilbus.decision.margin import above_zero
from soilbus.decision.traversability import State, Status, Traversability, state_of
from soilbus.decision.uncertain_model import UncertainModel
from soilbus.decision.watch import Watch
from soilbus.decision.wheels import WheelTable
from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.estimation.window import Rig
from soilbus.terra.effects.steady import CompletedModel
from soilbus.terra.wheel import WheelModel


def judge(
    posterior: Posterior | None,
    status: Status,
    demand: Demand | None,
    rig: Rig,
    model: WheelModel | CompletedModel | UncertainModel,
    torque_limit: NDArray[np.float64],
    settings: Settings,
    last: WheelTable | None = None,
) -> tuple[Traversability, WheelTable | None]:
    """Return whether the vehicle can go on, on the ground of one window, and the table to start the next one from.

    Parameters
    ----------
    posterior, status
        Of the window's soil; None where there is no estimate.
    demand
        Draft and slope, None where not known; only a valid status and a known demand can give go.
    torque_limit
        (W,) [N m], nan where not known.
    settings
        Limits of slip and sinkage, margin, thresholds.
    last
        The table of the window before, to start from.
    """
    available = float(torque_limit.sum()) if np.isfinite(torque_limit).all() and len(torque_limit) else None
    if posterior is None or status is Status.INVALID or rig.chassis is None:
        return Traversability(torque_available=available), None
    capability, table = assess(
        posterior, rig, model, demand, torque_limit, settings.max_slip, settings.max_sinkage, last
    )  # fmt: skip
    if capability is None:
        return Traversability(State.NO_GO, 0.0, torque_available=available, limit="sinkage"), None
    decision = Traversability(
        torque_available=available,
        max_draft=capability.max_draft,
        max_grade=capability.max_grade,
        limit=capability.limit,
        capability=capability,
    )
    if demand is None:
        return decision, table
    spare, pull, depth, forecast = None, 0.0, 1.0, capability.forecast
    if (likely := capability.likely_pull) is not None:  # some steady driving exists
        needed = demand.pull + settings.margin * max(demand.pull, 0.0)
        spare = Estimate(likely.value - needed, math.hypot(likely.std, demand.std))
        pull = above_zero(spare.value, spare.std)
    if forecast is not None:  # some slip gives the demand
        depth = above_zero(settings.max_sinkage - forecast.likely_depth.value, forecast.likely_depth.std)
    return replace(
        decision,
        state=state_of(min(pull, depth), status, settings),
        probability=min(pull, depth),
        torque_required=None if forecast is None else forecast.torque.value,
        slip_needed=None if forecast is None else forecast.slip.value,
        limit=capability.limit if pull <= depth else "sinkage",
        spare=spare,
    ), table


class Basis(NamedTuple):
    """The data that a decision rests on.

    instants (N,) [s]: times that were fitted; each [s]: length of a bin; unseen [m]: distance driven from the last of
    them to the window's end; late [s]: age of the data beyond their stamps, where channels wait for a delayed one.
    """

    instants: NDArray[np.float64] = np.empty(0)
    each: float = 0.0
    unseen: float = 0.0
    late: float = 0.0

    @property
    def end(self) -> float:
        """When the last instant was measured [s]; minus infinity without any."""
        return float(self.instants[-1]) - self.late if len(self.instants) else -math.inf


def at_present(decision: Traversability, basis: Basis, watch: Watch, now: float, config: Config) -> Traversability:
    """Return a window's decision as far as it holds at a later time.

    - stuck: no_go, and no figure of the estimate; - with a wheel that spins, or while immobilisation is warned of: no
    better than caution; - data older than `max_age`, or on ground further back than the wheelbase, behind which the
    rear wheels stand: unknown; - wheels that pull less at their present slip than the estimate predicts: the spare pull
    is reduced by the miss; - wheels that slip more than the present pull needs, or the forecast where it is not known:
    no better than caution; - with less than `min_share` of a window measured since a wheel last spun: no better than
    caution.

    now [s]: the time of the data.  watch: as of then.
    """
    settings, length = config.traversability, 0.0 if config.vehicle is None else config.vehicle.wheelbase
    if watch.stuck:
        return Traversability(
            State.NO_GO, 0.0, torque_available=decision.torque_available, limit="slip", since_valid=decision.since_valid
        )
    if watch.spinning and decision.state is not State.NO_GO:
        return replace(decision, state=State.CAUTION, probability=None)
    if watch.is_caused and decision.state is State.GO:
        return replace(decision, state=State.CAUTION, probability=None, contradicted="warning")
    if decision.state is State.UNKNOWN:
        return decision
    if not (now - basis.end <= settings.max_age and basis.unseen <= length):  # nor nan
        return replace(decision, state=State.UNKNOWN, probability=None)
    if decision.state is State.GO and decision.capability is not None and decision.spare is not None:
        curve = _Curve.of(decision.capability.over_slip, config.noise)
        missing = curve.missing_pull(watch.slip, watch.pull, settings.contradiction)
        left = above_zero(decision.spare.value - missing, decision.spare.std)
        if left < settings.go:
            return replace(decision, state=State.CAUTION, probability=left, contradicted="slip")
        forecast = decision.capability.forecast
        predicted = None if forecast is None else forecast.slip
        if math.isfinite(watch.pull):
            predicted = curve.slip_needed(watch.pull)
        if predicted is not None:
            sd = math.hypot(predicted.std, (1.0 - watch.slip) * curve.slip_gain, config.warning.slip_noise)
            if watch.slip - predicted.value > settings.contradiction * sd:  # nor nan
                return replace(decision, state=State.CAUTION, probability=None, contradicted="slip")
    measured = np.count_nonzero(basis.instants > watch.last) * basis.each
    if decision.state is State.GO and measured < settings.min_share * config.estimator.window:
        return replace(decision, state=State.CAUTION, probability=None)
    return decision


class _Curve(NamedTuple):
    """Pull over slip where it is known, its std, and the gain errors of slip (of both speeds) and draft."""

    slip: NDArray[np.float64]
    pull: NDArray[np.float64]
    std: NDArray[np.float64]
    slip_gain: float
    draft_gain: float

    @classmethod
    def of(cls, curve: OverSlip, noise: NoiseOfChannels) -> _Curve:
        known = np.isfinite(curve.pull)
        gain = math.hypot(noise.speed.gain, noise.ground_speed.gain)
        return cls(curve.slip[known], curve.pull[known], curve.pull_std[known], gain, noise.draft.gain)

    def missing_pull(self, slip: float, pull: float, deviations: float) -> float:
        """Return the pull [N] missing at this slip: predicted less given, less `deviations` sd of that difference."""
        if not len(self.slip) or not math.isfinite(slip + pull) or slip < self.slip[0]:
            return 0.0
        predicted, std = float(np.interp(slip, self.slip, self.pull)), float(np.interp(slip, self.slip, self.std))
        slope = float(np.interp(slip, self.slip, np.gradient(self.pull, self.slip))) if len(self.slip) > 1 else 0.0
        sd = math.hypot(std, slope * (1.0 - slip) * self.slip_gain, self.draft_gain * pull)
        return max(predicted - pull - deviations * sd, 0.0)

    def slip_needed(self, pull: float) -> Estimate | None:
        """Least slip that gives a pull [N], ds = dP / (dP/ds); None where none does, or it hardly changes the pull."""
        if len(self.slip) < 2 or not pull < self.pull.max():
            return None
        i = max(int(np.argmax(self.pull > pull)), 1)
        slope = float((self.pull[i] - self.pull[i - 1]) / (self.slip[i] - self.slip[i - 1]))
        if slope <= 0.0:
            return None
        slip = max(float(self.slip[i] - (self.pull[i] - pull) / slope), 0.0)
        return Estimate(slip, math.hypot(float(np.interp(slip, self.slip, self.std)), self.draft_gain * pull) / slope)
