"""Posterior, vehicle and present demand -> what the vehicle can do here, each figure with its standard deviation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from soilbus.arrays import Array
from soilbus.decision.balance import (
    PARTS,
    Balance,
    Cause,
    Duty,
    Largest,
    Limits,
    axle_sum,
    balance,
    climbing,
    largest_pull,
    place_of_pull,
    slips_of_most,
    within,
)
from soilbus.decision.sigma_points import SigmaPoints, estimates, likely, mean_and_std
from soilbus.decision.uncertain_model import ModelOfRows, UncertainModel
from soilbus.decision.wheels import Axles, WheelTable, wheel_table
from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.estimation.window import Rig
from soilbus.terra.effects.steady import CompletedModel, Wheel
from soilbus.terra.wheel import WheelModel

__all__ = ["Capability", "Demand", "Forecast", "OverSlip", "SetPoint", "assess", "slip_grid"]

MIN_SLIP = 0.02
GRID = 9
MAX_SKID = 0.3
SKID_GRID = 9
TOLERANCE = 3e-3
"""Last Newton step over the weight: it leaves less than interpolation between slips, some 5e-5 of the weight."""
LEVEL_SINE = 1e-3
"""Slopes below this sine change no load worth computing."""


@dataclass(frozen=True, slots=True)
class Demand:
    """Pull [N] asked of the wheels now, draft and slope together, with its uncertainty; sine is that of the slope."""

    pull: float
    std: float
    sine: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class OverSlip:
    """Steady level driving at some slips (S,): pull [N] and the wheels' summed torque [N m].

    Equation 22 and figure 13 of Xi et al. 2024, with load transfer and standard deviations.
    """

    slip: Array
    pull: Array
    pull_std: Array
    torque: Array
    torque_std: Array


@dataclass(frozen=True, slots=True)
class SetPoint:
    """Slips of one axle within the limits: of best traction efficiency, and of most pull.

    None where the axle most likely gives no pull.  Where pull over slip has two tops about as high, the
    mean lies between them: its std says so.
    """

    efficiency: Estimate | None
    pull: Estimate | None


@dataclass(frozen=True, slots=True)
class Forecast:
    """The present demand met in steady driving: slip, sinkage [m] by wheel, the deepest, summed torque [N m].

    likely_depth is the deepest to first order, for probabilities.  All on the condition that the demand can
    be met: soils where no slip does are left out.
    """

    slip: Estimate
    sinkage: Mapping[str, Estimate]
    deepest: Estimate
    torque: Estimate
    likely_depth: Estimate


@dataclass(frozen=True, slots=True)
class Capability:
    """What the vehicle can do on this soil; None where nothing can be said.

    max_draft [N] on the level; grades [rad], without draft and with the present one;
    max_pull [N] on the present slope, of draft and slope together, and max_draft_here of the
    draft alone; likely_pull is max_pull to first order, for probabilities; limit is what ends max_draft.
    forecast is None where most likely no slip meets the demand.
    """

    max_draft: Estimate
    max_draft_here: Estimate | None
    max_grade: Estimate | None
    max_grade_with_draft: Estimate | None
    max_pull: Estimate | None
    likely_pull: Estimate | None
    limit: Cause
    set_points: Mapping[str, SetPoint]
    forecast: Forecast | None
    over_slip: OverSlip


@cache
def slip_grid(max_slip: float) -> Array:
    """Slips at which the wheels are computed, closer where forces change fast."""
    least = min(MIN_SLIP, max_slip / 2.0)
    return np.asarray(np.linspace(np.sqrt(least), np.sqrt(max_slip), GRID) ** 2)


def assess(
    posterior: Posterior,
    rig: Rig,
    model: WheelModel | CompletedModel | UncertainModel,
    demand: Demand | None,
    torque_limit: Array,
    max_slip: float,
    max_sinkage: float,
    last: WheelTable | None = None,
) -> tuple[Capability | None, WheelTable]:
    """Capability on one soil, and the wheels' table to start the next window's from.

    torque_limit (W,) [N m] holds nan where a motor's limit is not known; a wheel whose limit is 0 rolls freely.
    max_sinkage [m].  None where no steady driving within slip and sinkage limits exists.  Raises ValueError
    for a rig without a chassis.
    """
    uncertain = UncertainModel.over(model)
    points = SigmaPoints.of(posterior, uncertain.shifts)
    driven = ~(torque_limit <= 0.0)
    completed = uncertain.of_rows(len(points.soils))
    table = wheel_table(points.soils, rig, uncertain, slip_grid(max_slip), last, TOLERANCE, driven)
    skids = np.linspace(-MAX_SKID, table.slip[0], SKID_GRID)
    skid = cache(lambda: wheel_table(points.soils, rig, uncertain, skids, driven=driven))
    of_points = balance(table)
    level = of_points.drawn(points)
    limits = Limits.of(table.axles, torque_limit, max_sinkage, completed)
    limits = limits._replace(angle=points.drawn(limits.angle))
    vehicle = _Vehicle(table, of_points, points, limits, skid)
    draft = vehicle.largest(Duty(), level)
    if draft is None:
        return None, table
    pull = forecast = None
    drafts = [0.0]
    if demand is not None:
        flat = abs(demand.sine) < LEVEL_SINE
        duty = Duty(None, demand.sine)
        here = of_points if flat else balance(table, duty, of_points)
        present = level if flat else here.drawn(points)
        pull = draft if flat else vehicle.largest(duty, present)
        drafts.append(demand.pull - table.axles.weight * demand.sine)
        forecast = _forecast(demand, here, present, table.axles, rig, completed, points)
    grade, *with_draft = vehicle.grades(drafts)
    max_draft, max_pull, max_grade, max_grade_with_draft = estimates(
        draft.pull, None if pull is None else pull.pull, grade, *(with_draft or [None])
    )
    if max_draft is None:
        return None, table
    max_draft_here = None
    if demand is not None and max_pull is not None:
        max_draft_here = Estimate(max_pull.value - table.axles.weight * demand.sine, max_pull.std)
    return Capability(
        max_draft=max_draft,
        max_draft_here=max_draft_here,
        max_grade=max_grade,
        max_grade_with_draft=max_grade_with_draft,
        max_pull=max_pull,
        likely_pull=likely(None if pull is None else pull.pull),
        limit=draft.cause,
        set_points=_set_points(table.axles, level, vehicle.limits, draft),
        forecast=forecast,
        over_slip=_over_slip(level, table),
    ), table


@dataclass(frozen=True, slots=True)
class _Vehicle:
    """The wheels where they drive and, asked for seldom, where they skid: of the points; limits are of their draws."""

    table: WheelTable
    level: Balance
    points: SigmaPoints
    limits: Limits
    skid: Callable[[], WheelTable]

    def largest(self, duty: Duty, driving: Balance) -> Largest | None:
        """Each draw's largest pull under a duty; None where nothing is within the limits.

        Where even the least slip asks for more torque than there is, the pull is that of
        wheels that skid: below zero, as only a push or a slope moves the vehicle.
        """
        found = largest_pull(driving, self.limits)
        if not self.table.axles.driven.any():
            return found._replace(cause="torque")
        lost = ~np.isfinite(found.pull)
        if not lost.any():
            return found
        no_torque = self.limits._replace(torque=np.full_like(self.limits.torque, np.inf))
        weak = lost & within(driving, no_torque).any(axis=1)
        if not weak.any():
            return None if lost[0] else found
        of_skid = self._skidding(duty)
        pull, slip = (np.where(weak, *each) for each in ((of_skid.pull, found.pull), (of_skid.slip, found.slip)))
        if not np.isfinite(pull[0]):
            return None
        return Largest(pull, slip, "torque" if weak[0] else found.cause)

    def _skidding(self, duty: Duty) -> Largest:
        """Largest pull of wheels that skid; the least where even that asks for too much torque."""
        skidding = balance(self.skid(), duty).drawn(self.points)
        found = largest_pull(skidding, self.limits)
        least = np.where(skidding.known, skidding.pull, np.inf).argmin(axis=1)
        pull = np.where(skidding.known.any(axis=1), skidding.pull[np.arange(len(least)), least], np.nan)
        none = ~np.isfinite(found.pull)
        return Largest(np.where(none, pull, found.pull), np.where(none, skidding.slip[least], found.slip), "torque")

    def grades(self, drafts: Sequence[float]) -> list[Array | None]:
        """Steepest slope [rad] (1 + N,) that each draw climbs with each of the drafts [N]."""
        slopes: list[Array | None] = []
        for draft, of_points in zip(drafts, climbing(self.table, drafts, self.level), strict=True):
            found = self.largest(Duty(draft, None), of_points.drawn(self.points))
            rise = None if found is None else (found.pull - draft) / self.table.axles.weight
            slopes.append(None if rise is None else np.arcsin(np.minimum(np.maximum(rise, -1.0), 1.0)))
        return slopes


def _set_points(axles: Axles, level: Balance, limits: Limits, draft: Largest) -> dict[str, SetPoint]:
    """Efficiency is drawbar power over the wheels' power, DP V/(T omega); an axle that is not driven has none."""
    of_axles = {"front": axles.front[:, 0], "rear": ~axles.front[:, 0]}
    names = {name: driven for name, kinds in of_axles.items() if (driven := kinds & axles.driven[:, 0]).any()}
    none = {name: SetPoint(None, None) for name, kinds in of_axles.items() if kinds.any()}
    if not names:
        return none
    values = np.empty((len(names), 2, *level.pull.shape))
    for (efficiency, pull), kinds in zip(values, names.values(), strict=True):
        force = axle_sum(level.torque, axles, kinds, 1.0 / axles.radius)
        pull[:] = axle_sum(level.drawbar, axles, kinds)
        np.divide(pull * (1.0 - level.slip), np.where(force > 0.0, force, -np.inf), out=efficiency)
    slips = estimates(*slips_of_most(values.reshape(-1, *level.pull.shape), level, limits, draft.slip))
    return none | {name: SetPoint(*slips[2 * i : 2 * i + 2]) for i, name in enumerate(names)}


def _forecast(
    demand: Demand, here: Balance, present: Balance, axles: Axles, rig: Rig, model: ModelOfRows, points: SigmaPoints
) -> Forecast | None:
    place = place_of_pull(present, demand.pull)
    torque = (place.on(present.torque) * axles.count[:, 0]).sum(axis=1)
    slip = place.on(np.broadcast_to(present.slip, present.pull.shape))
    load = axles.loads(*Duty(None, demand.sine).split(here.pull, axles.weight))
    depth = model.sinkage(here.angle, Wheel(axles.radius, axles.width, ~axles.front, load))
    depth = place.on(points.drawn(depth, here.known[:, None]))
    slip_needed, required, *depths = estimates(slip, torque, *depth.T)
    likely_depth = likely(depth[:, int(np.argmax(depth[0]))])
    if slip_needed is None or required is None or likely_depth is None:
        return None
    by_kind = [each for each in depths if each is not None]
    by_wheel = {name: by_kind[kind] for name, kind in zip(rig.wheels, axles.of_wheel, strict=True)}
    return Forecast(slip_needed, by_wheel, max(by_kind, key=lambda depth: depth.value), required, likely_depth)


def _over_slip(level: Balance, table: WheelTable) -> OverSlip:
    known = level.known[:, ::PARTS].copy()
    known[:, 1:] |= level.known[:, PARTS - 1 :: PARTS]
    torque = (level.torque[..., ::PARTS] * table.axles.count).sum(axis=1)
    both = np.where(known[:, None], np.stack([level.pull[:, ::PARTS], torque], axis=1), np.nan)
    (pull, torque), (pull_std, torque_std) = mean_and_std(both)
    return OverSlip(table.slip, pull, pull_std, torque, torque_std)
