"""Posterior -> traversability: what the vehicle can do here, against what is asked of it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.config.model import Config
from soilbus.config.model import Traversability as Settings
from soilbus.decision.capability import Capability, Demand, assess
from soilbus.decision.traction_loss import TractionLoss, missing_pull
from soilbus.decision.traversability import State, Status, Traversability, state_of
from soilbus.decision.uncertain_model import UncertainModel
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
    """Traversability of the ground of one window, and the wheels' table to start the next one from.

    torque_limit (W,) [N m] holds nan where a motor's limit is not known.  Only a valid
    posterior and a known demand can lead to go.
    """
    available = float(torque_limit.sum()) if np.isfinite(torque_limit).all() and len(torque_limit) else None
    if posterior is None or status is Status.INVALID or rig.chassis is None:
        return Traversability(torque_available=available), None
    able, table = assess(
        posterior, rig, model, demand, torque_limit, settings.max_slip, settings.max_sinkage, last
    )  # fmt: skip
    if able is None:
        return Traversability(State.NO_GO, 0.0, torque_available=available, limit="sinkage"), None
    way = Traversability(
        torque_available=available,
        max_draft=able.max_draft,
        max_grade=able.max_grade,
        limit=able.limit,
        capability=able,
    )
    if demand is None:
        return way, table
    spare = spare_pull(able, demand, settings)
    pull = 0.0 if spare is None else _above(spare.value, spare.std)
    depth = probability_of_depth(able, settings)
    forecast = able.forecast
    return replace(
        way,
        state=state_of(min(pull, depth), status, settings),
        probability=min(pull, depth),
        torque_required=None if forecast is None else forecast.torque.value,
        slip_needed=None if forecast is None else forecast.slip.value,
        limit=able.limit if pull <= depth else "sinkage",
        spare=spare,
    ), table


def spare_pull(able: Capability, demand: Demand, settings: Settings) -> Estimate | None:
    """Pull [N] on the present slope beyond the demand and its margin; None where there is no steady driving."""
    if able.likely_pull is None:
        return None
    needed = demand.pull + settings.margin * max(demand.pull, 0.0)
    return Estimate(able.likely_pull.value - needed, math.hypot(able.likely_pull.std, demand.std))


def probability_of_depth(able: Capability, settings: Settings) -> float:
    """That the deepest wheel stays within the sinkage limit under the demand; 1 where no slip gives the demand."""
    if able.forecast is None:
        return 1.0
    deepest = able.forecast.likely_depth
    return _above(settings.max_sinkage - deepest.value, deepest.std)


class Basis(NamedTuple):
    """What a decision rests on: the instants (N,) [s] that were fitted, each so long [s], and the ground left behind.

    unseen [m]: way driven since the last of them, until the window's end; late [s]: by so much what they tell is older
    than its stamps, where channels wait for one that is late.
    """

    instants: NDArray[np.float64] = np.empty(0)
    each: float = 0.0
    unseen: float = 0.0
    late: float = 0.0

    @property
    def end(self) -> float:
        """When the last instant was measured [s]; minus infinity without any."""
        return float(self.instants[-1]) - self.late if len(self.instants) else -math.inf


def at_present(way: Traversability, basis: Basis, loss: TractionLoss, now: float, config: Config) -> Traversability:
    """What is left of a window's decision at a later time.

    A decision has the time and the place of the data that it rests on, and none against what the wheels show:

    - stuck: no_go, and nothing of what the estimate promises;
    - with a wheel that spins: no better than caution;
    - resting on data older than `max_age`, or on ground that lies further back than the vehicle is long: unknown;
    - where the wheels pull less at their present slip than the estimate predicts: only what is left of the spare pull;
    - with less than `min_share` of a window measured since a wheel last spun: no better than caution.

    Parameters
    ----------
    way
        The decision when the window ended.
    basis
        What it rests on.
    loss
        Loss of traction as of now.
    now
        [s], the time of the data.
    config
        Of `max_age`, `min_share` and `contradiction`; of the wheelbase, after which rear wheels stand where front
        wheels stood; of the sensors' gain errors.
    """
    settings, length = config.traversability, 0.0 if config.vehicle is None else config.vehicle.wheelbase
    if loss.stuck:
        return Traversability(
            State.NO_GO, 0.0, torque_available=way.torque_available, limit="slip", since_valid=way.since_valid
        )
    if loss.spinning and way.state is not State.NO_GO:
        return replace(way, state=State.CAUTION, probability=None)
    if way.state is State.UNKNOWN:
        return way
    if not (now - basis.end <= settings.max_age and basis.unseen <= length):  # nor nan
        return replace(way, state=State.UNKNOWN, probability=None)
    if way.state is State.GO and way.capability is not None and way.spare is not None:
        missing = missing_pull(loss, way.capability.over_slip, config.noise, settings.contradiction)
        left = _above(way.spare.value - missing, way.spare.std)
        if left < settings.go:
            return replace(way, state=State.CAUTION, probability=left)
    measured = np.count_nonzero(basis.instants > loss.last) * basis.each
    if way.state is State.GO and measured < settings.min_share * config.estimator.window:
        return replace(way, state=State.CAUTION, probability=None)
    return way


def _above(margin: float, std: float) -> float:
    """Probability that a Gaussian with this mean and std is above zero."""
    return 0.5 * math.erfc(-margin / (max(std, 1e-9) * math.sqrt(2.0)))
