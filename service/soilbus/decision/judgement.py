"""Traversability: the probability that the vehicle can do what is asked of it, and the state that follows.

    P(pull)     = Phi((max_pull - demand - margin * max(demand, 0)) / sd)
    P(depth)    = Phi((max_sinkage - sinkage of the deepest wheel) / sd)
    P           = min(P(pull), P(depth)) -> go, caution or no_go by the configured thresholds

`judge` decides when a window ends.  `at_present` says what remains of that decision later, when its data have aged, the
vehicle has moved on, or the wheels show less pull than predicted.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.config.model import Config, NoiseOfChannels
from soilbus.config.model import Traversability as Settings
from soilbus.decision.capability import Capability, Demand, OverSlip, assess
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
    """Decide whether the vehicle can go on, on the ground of one window.

    Parameters
    ----------
    posterior, status
        Of the window's soil; None where there is no estimate.
    demand
        Draft and slope; None where not known.  Only a valid status and a known demand can give go.
    rig, model
        The vehicle and its wheel-soil model.
    torque_limit
        (W,) [N m], nan where not known.
    settings
        Limits of slip and sinkage, margin, thresholds.
    last
        The table of the window before, to start from.

    Returns
    -------
    decision, table
        The decision, and the table to start the next window from (None where there is none).
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
    spare = spare_pull(capability, demand, settings)
    pull = 0.0 if spare is None else _above(spare.value, spare.std)
    depth = probability_of_depth(capability, settings)
    forecast = capability.forecast
    return replace(
        decision,
        state=state_of(min(pull, depth), status, settings),
        probability=min(pull, depth),
        torque_required=None if forecast is None else forecast.torque.value,
        slip_needed=None if forecast is None else forecast.slip.value,
        limit=capability.limit if pull <= depth else "sinkage",
        spare=spare,
    ), table


def spare_pull(capability: Capability, demand: Demand, settings: Settings) -> Estimate | None:
    """Return the pull [N] on the present slope less the demand and its margin; None where no steady driving exists."""
    if capability.likely_pull is None:
        return None
    needed = demand.pull + settings.margin * max(demand.pull, 0.0)
    return Estimate(capability.likely_pull.value - needed, math.hypot(capability.likely_pull.std, demand.std))


def probability_of_depth(capability: Capability, settings: Settings) -> float:
    """Return the probability that the deepest wheel stays within max_sinkage; 1 where no slip gives the demand."""
    if capability.forecast is None:
        return 1.0
    deepest = capability.forecast.likely_depth
    return _above(settings.max_sinkage - deepest.value, deepest.std)


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

    A decision is valid for the time and place of its data, and is overruled by what the wheels show:

    - stuck: no_go, and no figure of the estimate;
    - with a wheel that spins, or while immobilisation is warned of: no better than caution;
    - data older than `max_age`, or on ground further back than the wheelbase: unknown;
    - wheels that pull less at their present slip than the estimate predicts: the spare pull is reduced by the miss;
    - wheels that slip more than the present pull needs by the estimate, or the forecast where that pull is not known:
      no better than caution;
    - with less than `min_share` of a window measured since a wheel last spun: no better than caution.

    Parameters
    ----------
    decision
        The decision when the window ended.
    basis
        Its data.
    watch
        As of now: what wheels and vehicle do, and whether immobilisation is warned of.
    now
        [s], the time of the data.
    config
        Of `max_age`, `min_share` and `contradiction`; of the wheelbase, after which rear wheels stand where front
        wheels stood; of the sensors' gain errors.
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
        missing = missing_pull(watch, decision.capability.over_slip, config.noise, settings.contradiction)
        left = _above(decision.spare.value - missing, decision.spare.std)
        if left < settings.go:
            return replace(decision, state=State.CAUTION, probability=left, contradicted="slip")
        forecast = decision.capability.forecast
        predicted = None if forecast is None else forecast.slip
        if math.isfinite(watch.pull):
            predicted = slip_needed(watch.pull, decision.capability.over_slip, config.noise)
        if predicted is not None and excess_slip(watch, predicted, config, settings.contradiction) > 0.0:
            return replace(decision, state=State.CAUTION, probability=None, contradicted="slip")
    measured = np.count_nonzero(basis.instants > watch.last) * basis.each
    if decision.state is State.GO and measured < settings.min_share * config.estimator.window:
        return replace(decision, state=State.CAUTION, probability=None)
    return decision


def missing_pull(watch: Watch, curve: OverSlip, noise: NoiseOfChannels, deviations: float) -> float:
    """Return the pull [N] by which the wheels give significantly less than predicted at their slip; else 0.

    Parameters
    ----------
    watch
        With the present slip and pull.
    curve
        Predicted pull over slip.
    noise
        Gain errors of the speed, ground speed and draft sensors.
    deviations
        Standard deviations of the innovation that are subtracted.

    Notes
    -----
    The innovation is P(s) - P.  Its variance is that of the curve, of the slip (gain errors of both speeds) and of the
    draft's gain error.
    """
    known = np.isfinite(curve.pull)
    if not known.any() or not math.isfinite(watch.slip + watch.pull) or watch.slip < curve.slip[0]:
        return 0.0
    slips, pulls, stds = curve.slip[known], curve.pull[known], curve.pull_std[known]
    predicted, std = float(np.interp(watch.slip, slips, pulls)), float(np.interp(watch.slip, slips, stds))
    slope = float(np.interp(watch.slip, slips, np.gradient(pulls, slips))) if len(slips) > 1 else 0.0
    of_slip = slope * (1.0 - watch.slip) * math.hypot(noise.speed.gain, noise.ground_speed.gain)
    sd = math.hypot(std, of_slip, noise.draft.gain * watch.pull)
    return max(predicted - watch.pull - deviations * sd, 0.0)


def excess_slip(watch: Watch, predicted: Estimate, config: Config, deviations: float) -> float:
    """Return the slip by which the wheels slip significantly more than predicted; else 0.

    Parameters
    ----------
    watch
        With the present slip.
    predicted
        Slip that the present pull needs (`slip_needed`), or where that is not known the present demand.
    config
        Gain errors of both speeds; slip by uneven ground.
    deviations
        Standard deviations of the innovation that are subtracted.
    """
    if not math.isfinite(watch.slip):
        return 0.0
    of_gains = (1.0 - watch.slip) * math.hypot(config.noise.speed.gain, config.noise.ground_speed.gain)
    sd = math.hypot(predicted.std, of_gains, config.warning.slip_noise)
    return max(watch.slip - predicted.value - deviations * sd, 0.0)


def slip_needed(pull: float, curve: OverSlip, noise: NoiseOfChannels) -> Estimate | None:
    """Return the least slip that gives a pull [N]; None where none does, or where slip hardly changes the pull.

    Notes
    -----
    ds = dP / (dP/ds), with the curve's std and the draft's gain error in dP.
    """
    known = np.isfinite(curve.pull)
    slips, pulls, stds = curve.slip[known], curve.pull[known], curve.pull_std[known]
    if len(slips) < 2 or not pull < pulls.max():
        return None
    i = max(int(np.argmax(pulls > pull)), 1)
    slope = float((pulls[i] - pulls[i - 1]) / (slips[i] - slips[i - 1]))
    if slope <= 0.0:
        return None
    slip = max(float(slips[i] - (pulls[i] - pull) / slope), 0.0)
    return Estimate(slip, math.hypot(float(np.interp(slip, slips, stds)), noise.draft.gain * pull) / slope)


def _above(margin: float, std: float) -> float:
    """Probability that a Gaussian with this mean and std is above zero."""
    return 0.5 * math.erfc(-margin / (max(std, 1e-9) * math.sqrt(2.0)))
