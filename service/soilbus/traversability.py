"""Posterior -> go, caution, no_go or unknown, with a probability and the limiting cause."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from soilbus.capability import PullCurve, largest_pull, pull_curve, slip_for_pull, slip_grid
from soilbus.config import Traversability as Settings
from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.estimation.window import Rig
from soilbus.terra.effects.steady import CompletedModel
from soilbus.terra.vehicle import GRAVITY
from soilbus.terra.wheel import WheelModel


class State(StrEnum):
    """May the vehicle go on?"""

    GO = "go"
    CAUTION = "caution"
    NO_GO = "no_go"
    UNKNOWN = "unknown"


class Status(StrEnum):
    """What a window's estimate is worth."""

    VALID = "valid"
    DEGRADED = "degraded"
    NOT_EXCITED = "not_excited"
    INVALID = "invalid"


@dataclass(frozen=True, slots=True)
class Demand:
    """Pull [N] asked of the wheels now (draft and slope), with its uncertainty."""

    pull: float
    std: float


@dataclass(frozen=True, slots=True)
class Traversability:
    """The decision and what it rests on; None where nothing can be said.

    Torques are sums over the wheels [N m]; max_draft [N] on the level; max_grade [rad]
    without draft; slip_needed gives the present demand.
    """

    state: State = State.UNKNOWN
    probability: float | None = None
    torque_required: float | None = None
    torque_available: float | None = None
    max_draft: Estimate | None = None
    max_grade: Estimate | None = None
    slip_needed: float | None = None
    limit: str | None = None


def judge(
    posterior: Posterior | None,
    status: Status,
    demand: Demand | None,
    rig: Rig,
    model: WheelModel | CompletedModel,
    torque_limit: NDArray[np.float64],
    settings: Settings,
    last: PullCurve | None = None,
) -> tuple[Traversability, PullCurve | None]:
    """Traversability of the ground of one window, and the pull curve to start the next one from.

    torque_limit (W,) [N m] holds nan where a motor's limit is not known.  Only a valid
    posterior and a known demand can lead to go.
    """
    available = float(torque_limit.sum()) if np.isfinite(torque_limit).all() and len(torque_limit) else None
    if posterior is None or status is Status.INVALID or rig.chassis is None:
        return Traversability(torque_available=available), None
    grid = slip_grid(settings.max_slip)
    on_grade = np.arange(2 * len(grid)) >= len(grid)
    curve = pull_curve(posterior.soil, rig, model, np.tile(grid, 2), on_grade, last)
    level = curve.part(on_grade=False)
    draft = largest_pull(level, torque_limit, posterior.soil, rig, model)
    grade = largest_pull(curve.part(on_grade=True), torque_limit, posterior.soil, rig, model)
    if draft is None:
        return Traversability(State.NO_GO, 0.0, torque_available=available, limit="sinkage"), None
    max_draft = Estimate(draft.pull, posterior.propagate(draft.gradient))
    weight = rig.chassis.mass * GRAVITY
    max_grade = None
    if grade is not None:
        sine = min(max(grade.pull / weight, -1.0), 1.0)
        cosine = max(math.sqrt(1.0 - sine**2), 1e-3)
        max_grade = Estimate(math.asin(sine), posterior.propagate(grade.gradient) / weight / cosine)
    if demand is None:
        partial = Traversability(
            max_draft=max_draft, max_grade=max_grade, torque_available=available, limit=draft.limit
        )
        return partial, curve
    needed = demand.pull + settings.margin * max(demand.pull, 0.0)
    probability = _above(max_draft.value - needed, math.hypot(max_draft.std, demand.std))
    slip, torque = slip_for_pull(level, demand.pull) or (None, None)
    decided = Traversability(
        state=_state(probability, status, settings),
        probability=probability,
        torque_required=torque,
        torque_available=available,
        max_draft=max_draft,
        max_grade=max_grade,
        slip_needed=slip,
        limit=draft.limit,
    )
    return decided, curve


def _above(margin: float, std: float) -> float:
    """Probability that a Gaussian with this mean and std is above zero."""
    return 0.5 * math.erfc(-margin / (max(std, 1e-9) * math.sqrt(2.0)))


def _state(probability: float, status: Status, settings: Settings) -> State:
    if probability < settings.no_go:
        return State.NO_GO
    if probability >= settings.go and status is Status.VALID:
        return State.GO
    return State.CAUTION
