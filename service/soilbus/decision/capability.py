"""What the vehicle can do on a soil: draft, grade, slip, sinkage, torque, each with its standard deviation.

    max draft        max over s of sum(P_w(s))            within torque, sinkage and slip limits, on the level
    max grade        sine = (max pull - draft) / weight   without draft and with the present one
    forecast         the least slip with pull(s) = demand, its sinkage and torque
    efficiency       eta(s) = P (1 - s) / (T / r)         drawbar power over axle power, the set point of each axle

The wheels over slip (`wheels`, `balance`) and each quantity are computed at the posterior's sigma points;
`sigma_points` gives mean and std.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.decision.balance import (
    SUBDIVISIONS,
    Balance,
    Cause,
    Duty,
    Largest,
    Limits,
    at_pull,
    balance,
    largest_pull,
    slips_of_most,
)
from soilbus.decision.sigma_points import SigmaPoints
from soilbus.decision.uncertain_model import UncertainModel
from soilbus.decision.wheels import Axles, WheelTable, wheel_table
from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.estimation.window import Rig
from soilbus.terra.effects.steady import CompletedModel, Wheel
from soilbus.terra.wheel import WheelModel

__all__ = ["Capability", "Demand", "Forecast", "OverSlip", "SetPoint", "assess", "slip_grid"]

MIN_SLIP, MAX_SKID = 0.02, 0.3
"""Least slip of driving wheels, and largest skid (minus slip) of wheels that are pushed.  No evidence recorded."""
GRID_SLIPS = 9
"""Number of slips at which wheels are computed."""
LEVEL_SINE = 1e-3
"""Sine of a slope below which the ground counts as level."""


@dataclass(frozen=True, slots=True)
class Demand:
    """Pull [N] asked by draft and slope together, its standard deviation [N], and the slope's sine, positive uphill."""

    pull: float
    std: float
    sine: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class OverSlip:
    """Steady level driving at some slips (S,): pull [N] and the wheels' summed torque [N m], with their std.

    engaged: which of all wheels drive; empty where not known.

    Equation 22 and figure 13 of Xi et al. 2024, with load transfer; nan where by the most likely soil, or by most soils
    of the posterior, no wheel loads and sinkages are in balance.
    """

    slip: Array
    pull: Array
    pull_std: Array
    torque: Array
    torque_std: Array
    engaged: tuple[bool, ...] = ()


@dataclass(frozen=True, slots=True)
class SetPoint:
    """Slips of one axle within the limits, of best traction efficiency and of largest pull; None without a pull."""

    efficiency: Estimate | None
    pull: Estimate | None


@dataclass(frozen=True, slots=True)
class Forecast:
    """Steady driving under the present demand, on the soils on which some slip gives it.

    slip: of the driven wheels.  sinkage, deepest [m]: by wheel, and of the deepest wheel.  torque [N m]: sum over the
    wheels.  likely_depth [m]: the deepest sinkage to first order, for probabilities.
    """

    slip: Estimate
    sinkage: Mapping[str, Estimate]
    deepest: Estimate
    torque: Estimate
    likely_depth: Estimate


@dataclass(frozen=True, slots=True)
class Capability:
    """What the vehicle can do on this soil; None where a quantity is not known.

    Attributes
    ----------
    max_draft, max_draft_here
        [N], on the level and on the present slope.
    max_grade, max_grade_with_draft
        [rad], without draft and with the present one.
    max_pull, likely_pull
        [N], on the present slope, draft and slope together; the same to first order, for probabilities.
    limit
        What ends max_draft.
    set_points
        Of the front axle, and of all axles behind it together.
    forecast
        None where most likely no slip gives the demand.
    over_slip
        Steady level driving over slip.
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
    """Return the slips (GRID_SLIPS,) at which the wheels are computed, quadratically spaced: closer at small slips."""
    least = min(MIN_SLIP, max_slip / 2.0)
    return np.asarray(np.linspace(np.sqrt(least), np.sqrt(max_slip), GRID_SLIPS) ** 2)


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
    """Return the capability on one soil, None where no steady driving is within the limits, and the wheels' table.

    Parameters
    ----------
    posterior, rig, model
        Of the soil; a rig with a chassis, else ValueError; the wheel-soil model.
    demand
        Present draft and slope; None where not known.
    torque_limit
        (W,) [N m], nan where not known; a wheel with limit 0 rolls freely.
    max_slip, max_sinkage
        Limits of slip and of sinkage [m].
    last
        The table of the window before, to start from.
    """
    uncertain = UncertainModel.over(model)
    points = SigmaPoints.of(posterior, uncertain.shifts, float(rig.width.mean()))
    driven, grid = ~(torque_limit <= 0.0), slip_grid(max_slip)
    table = wheel_table(points.soils, rig, uncertain, grid, last, driven=driven)
    skids = np.linspace(-MAX_SKID, grid[0], GRID_SLIPS)
    axles = table.axles
    limits = Limits.of(axles, torque_limit, max_sinkage, uncertain, len(points.soils))
    level = balance(table)
    skidding = cache(lambda: wheel_table(points.soils, rig, uncertain, skids, driven=driven))
    vehicle = _Vehicle(table, level, points, limits, skidding)
    level = level.filled(points)
    draft = vehicle.largest(Duty(), level)
    if draft is None:
        return None, table
    pull = with_draft = forecast = None
    if demand is not None:
        flat = abs(demand.sine) < LEVEL_SINE
        duty = Duty(None, demand.sine)
        present = level if flat else balance(table, duty, vehicle.level).filled(points)
        pull = draft if flat else vehicle.largest(duty, present)
        with_draft = vehicle.grade(demand.pull - axles.weight * demand.sine)
        forecast = _forecast(demand, present, axles, rig, uncertain, points)
    pulls = None if pull is None else pull.pull
    max_draft, max_pull, max_grade, max_grade_with_draft = points.estimates(
        draft.pull, pulls, vehicle.grade(0.0), with_draft
    )
    if max_draft is None:
        return None, table
    likely_pull, max_draft_here = points.likely(pulls), None
    max_pull = max_pull and _with_mass_error(max_pull, rig)
    if demand is not None and max_pull is not None:
        max_draft_here = Estimate(max_pull.value - axles.weight * demand.sine, max_pull.std)
    return Capability(
        max_draft=_with_mass_error(max_draft, rig),
        max_draft_here=max_draft_here,
        max_grade=max_grade,
        max_grade_with_draft=max_grade_with_draft,
        max_pull=max_pull,
        likely_pull=likely_pull and _with_mass_error(likely_pull, rig),
        limit=draft.cause,
        set_points=_set_points(axles, level, points, limits, draft),
        forecast=forecast,
        over_slip=_over_slip(level, table, points, rig.drives & driven),
    ), table


def _with_mass_error(pull: Estimate, rig: Rig) -> Estimate:
    """A pull [N] with the std of the mass: it grows with the weight, at most in proportion."""
    return Estimate(pull.value, math.hypot(pull.std, rig.mass_std * pull.value)) if rig.mass_std else pull


class _Vehicle(NamedTuple):
    """Table, level balance and limits of driving wheels at the sigma points; (lazily) table of skidding wheels."""

    table: WheelTable
    level: Balance
    points: SigmaPoints
    limits: Limits
    skid: Callable[[], WheelTable]

    def largest(self, duty: Duty, driving: Balance) -> Largest | None:
        """Largest pull on each soil under a duty, skidding where motors are weak; None if the mode has none."""
        found = largest_pull(driving, self.limits)
        if not self.table.axles.driven.any():
            return found._replace(cause="torque")
        lost = ~np.isfinite(found.pull)
        if not lost.any():
            return found
        no_torque = self.limits._replace(torque=np.full_like(self.limits.torque, np.inf))
        weak = lost & no_torque.allow(driving).any(axis=1)
        if not weak[0] and lost[0]:
            return None
        if not weak.any():
            return found
        skidding = balance(self.skid(), duty).filled(self.points)
        pushed = largest_pull(skidding, self.limits)
        pulls = np.where(skidding.known, skidding.pull, np.inf)
        none = ~np.isfinite(pushed.pull) & skidding.known.any(axis=1)
        pull = np.where(none, pulls.min(axis=1), pushed.pull)
        slip = np.where(none, skidding.slip[pulls.argmin(axis=1)], pushed.slip)
        if weak[0] and not np.isfinite(pull[0]):
            return None
        cause: Cause = "torque" if weak[0] else found.cause
        return Largest(np.where(weak, pull, found.pull), np.where(weak, slip, found.slip), cause)

    def grade(self, draft: float) -> Array | None:
        """Steepest slope [rad] (D,) that the vehicle climbs with a draft [N], on each soil."""
        duty = Duty(draft, None)
        found = self.largest(duty, balance(self.table, duty, self.level).filled(self.points))
        if found is None:
            return None
        return np.arcsin(np.clip((found.pull - draft) / self.table.axles.weight, -1.0, 1.0))


def _set_points(
    axles: Axles, level: Balance, points: SigmaPoints, limits: Limits, draft: Largest
) -> dict[str, SetPoint]:
    """Slips of best efficiency P V / (T omega) and of largest pull, by axle; None for an axle that is not driven."""
    of_axles = {"front": axles.front[:, 0], "rear": ~axles.front[:, 0]}
    names = {name: driven for name, kinds in of_axles.items() if (driven := kinds & axles.driven[:, 0]).any()}
    none = {name: SetPoint(None, None) for name, kinds in of_axles.items() if kinds.any()}
    if not names:
        return none
    values = []
    for kinds in names.values():
        force = (axles.count[kinds] / axles.radius[kinds] * level.torque[:, kinds]).sum(axis=1)
        pull = (axles.count[kinds] * level.drawbar[:, kinds]).sum(axis=1)
        values += [pull * (1.0 - level.slip) / np.where(force > 0.0, force, -np.inf), pull]
    slips = points.estimates(*slips_of_most(np.stack(values), level, limits, draft.slip))
    return none | {name: SetPoint(*slips[2 * i : 2 * i + 2]) for i, name in enumerate(names)}


def _forecast(
    demand: Demand, present: Balance, axles: Axles, rig: Rig, model: UncertainModel, points: SigmaPoints
) -> Forecast | None:
    """Slip, sinkage and torque at the least slip that gives the demand; None where most likely no slip does."""
    on = at_pull(present, demand.pull)
    torque = (on(present.torque) * axles.count[:, 0]).sum(axis=1)
    slip = on(np.broadcast_to(present.slip, present.pull.shape))
    load = axles.loads(*Duty(None, demand.sine).split(present.pull, axles.weight))
    depth = on(model.sinkage(present.angle, Wheel(axles.radius, axles.width, ~axles.front, load)))
    slip_needed, required, *depths = points.estimates(slip, torque, *depth.T)
    likely_depth = points.likely(depth[:, int(np.argmax(depth[0]))])
    if slip_needed is None or required is None or likely_depth is None:
        return None
    by_kind = [each for each in depths if each is not None]
    by_wheel = {name: by_kind[kind] for name, kind in zip(rig.wheels, axles.of_wheel, strict=True)}
    return Forecast(slip_needed, by_wheel, max(by_kind, key=lambda depth: depth.value), required, likely_depth)


def _over_slip(level: Balance, table: WheelTable, points: SigmaPoints, engaged: NDArray[np.bool_]) -> OverSlip:
    """Mean and std of pull and torque at the slips of the coarse grid, with those wheels engaged (W,)."""
    known = level.known[:, ::SUBDIVISIONS].copy()
    known[:, 1:] |= level.known[:, SUBDIVISIONS - 1 :: SUBDIVISIONS]
    torque = (level.torque[..., ::SUBDIVISIONS] * table.axles.count).sum(axis=1)
    both = np.where(known[:, None], np.stack([level.pull[:, ::SUBDIVISIONS], torque], axis=1), np.nan)
    (pull, torque), (pull_std, torque_std) = points.mean_and_std(both)
    return OverSlip(table.slip, pull, pull_std, torque, torque_std, tuple(engaged.tolist()))
