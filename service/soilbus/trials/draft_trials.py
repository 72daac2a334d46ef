"""Trials of the largest draft: predicted from one window, beside the true one, on simulated drives.

    relative error = predicted / true - 1,    covered if |predicted - true| < 1.96 std

Each drive has its own soil near a named one and is estimated from one window. The true largest draft is solved by the
simulator's equilibrium at 50 slips.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.estimation.assembly import prior_of, rig_of
from soilbus.estimation.posterior import NORMAL_95
from soilbus.estimation.window import Rig, pairs
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.drivetrain import Drivetrain, drivetrain_of, own_motors
from soilbus.simulator.equilibrium import Mechanics, Situation, solve
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.vehicle import wheel_loads
from soilbus.terra.wheel import Soil, WheelModel, sinkage
from soilbus.trials.draws import Each, drawn_soil, first_drive, prior_about, seeds_of, with_prior
from soilbus.trials.windows import first_window, torque_limits

__all__ = ["SOILS", "DraftFigures", "DraftTrial", "draft_trials", "figures", "trial", "true_largest_draft"]

SOILS = ("rubicon_sandy_loam_43", "north_gower_clayey_loam_46", "upland_sandy_loam_51")
SOIL_LOG_SD = 0.1
"""Standard deviation of the logarithms of a drive's soil parameters about the named soil."""
LOW_SLIP, HIGH_SLIP = (0.04, 0.10), (0.20, 0.40)
"""Ranges of the lowest and of the highest slip of a drive."""
SLIP_SHARES = np.linspace(0.02, 1.0, 50)
"""Slips at which the true draft is solved, over the greatest slip allowed."""


@dataclass(frozen=True, slots=True)
class DraftTrial:
    """Largest draft on the level [N]: predicted with its std, and true; nan where the fit failed."""

    soil: str
    predicted: float
    std: float
    true: float


@dataclass(frozen=True, slots=True)
class DraftFigures:
    """Figures of all drives on one soil: errors, and the share of 95 % intervals that hold the truth."""

    soil: str
    drives: int
    failed: int
    error: float
    bias: float
    coverage: float
    true: float


def draft_trials(config: Config, drives: int, seed: int, each: Each = map) -> Iterator[DraftFigures]:
    """Yield the figures of drives on each of SOILS, then of all; SimulationError where none can drive."""
    everything: list[DraftTrial] = []
    for name in SOILS:
        everything += (of_soil := list(each(partial(trial, config, name), seeds_of(seed, name, drives))))
        yield figures(name, of_soil)
    yield figures("all", everything)


def trial(config: Config, name: str, seed: int) -> DraftTrial:
    """Simulate one drive on a soil of this name, estimate, predict, and solve for the true draft."""
    rig, rng = rig_of(config), np.random.default_rng([seed, 2])

    def draw() -> tuple[Soil, Scenario]:
        soil, slip = drawn_soil(name, SOIL_LOG_SD, rng), Swing(rng.uniform(*LOW_SLIP), rng.uniform(*HIGH_SLIP))
        return soil, Scenario(config.estimator.window, (Patch(0.0, name, soil),), slip=slip)

    soil, recording = first_drive(config, draw, seed)
    prior = prior_about(prior_of(config), soil, np.random.default_rng([seed, 1]))
    window = first_window(config, recording, torque_limits(config, rig))
    limit = np.array([wheel.max_torque or np.nan for wheel in config.wheel])
    model = WheelModel(shear_law=config.model.shear_law)
    max_slip = config.traversability.max_slip
    truth = true_largest_draft(soil, rig, limit, max_slip, model, drivetrain=drivetrain_of(config))
    predicted = WindowEstimator(with_prior(config, prior)).solve(window).traversability.max_draft
    if predicted is None:
        return DraftTrial(name, np.nan, np.nan, truth)
    return DraftTrial(name, predicted.value, predicted.std, truth)


def true_largest_draft(
    soil: Soil, rig: Rig, torque_limit: Array, max_slip: float, model: WheelModel, max_sinkage: float = np.inf,
    drivetrain: Drivetrain | None = None, side_shift: float = 0.0,
) -> float:  # fmt: skip
    """Return the largest draft [N] held steadily on level ground; nan where there is none.

    Torque limits of the wheels (W,) are in N m, nan for none; without a drivetrain each wheel has a motor. A side slope
    moves `side_shift` of each axle's load to its left wheel. ValueError where the rig has no chassis.
    """
    if rig.chassis is None:
        raise ValueError("a draft needs the vehicle's mass and geometry")
    slips = max_slip * SLIP_SHARES
    shape = (len(rig.radius), len(slips))
    share = np.ones(len(rig.radius))
    left, right = pairs(rig)
    share[left], share[right] = 1.0 + side_shift, 1.0 - side_shift
    free, drawn = (wheel_loads(rig.chassis, rig.ahead, draft, 0.0, 0.0) * share for draft in (0.0, 1.0))
    none = np.zeros(len(slips))
    limit = np.where(np.isfinite(torque_limit), torque_limit, np.inf)
    drivetrain = own_motors(limit) if drivetrain is None else drivetrain
    limits = np.concatenate([limit, drivetrain.limit[len(limit) :]])

    def each_wheel(values: Any) -> Array:
        return np.broadcast_to(np.asarray(values, float)[:, None], shape)

    found = solve(
        Situation(
            t=none, distance=none, ground_speed=none + 1.0, acceleration=none, resistance=none,
            level_load=each_wheel(free), load_per_draft=each_wheel(drawn - free),
            upright_load=np.zeros(shape), deviation=np.zeros(shape),
            radius=each_wheel(rig.radius), width=each_wheel(rig.width),
            length=each_wheel(np.zeros(len(rig.wheels)) if rig.lengths is None else rig.lengths),
            soil=np.broadcast_to(np.asarray(soil)[:, None, None], (6, *shape)),
            demand=none + np.inf, slip_limit=slips, least_draft=none - np.inf,
            torque_limit=np.broadcast_to(limits[:, None], (len(limits), len(slips))),
        ),
        Mechanics(model, ~rig.front, rig.chassis.mass, 0.0, 0.0, drivetrain),
    )  # fmt: skip
    usable = found.found & (sinkage(found.entry_angle, rig.radius[:, None]) <= max_sinkage).all(axis=0)
    return float(found.draft[usable].max()) if usable.any() else float("nan")


def figures(soil: str, trials: Sequence[DraftTrial]) -> DraftFigures:
    """Return the figures of some trials; nan where all failed."""
    good = [t for t in trials if np.isfinite(t.predicted)]
    predicted, std, true = (np.array([getattr(t, of) for t in good]) for of in ("predicted", "std", "true"))
    if not good:
        return DraftFigures(soil, len(trials), len(trials), *[float("nan")] * 4)
    error, held = predicted / true - 1.0, np.abs(predicted - true) < NORMAL_95 * std
    middle = float(np.median(np.abs(error))), float(np.median(error)), float(np.mean(held)), float(np.median(true))
    return DraftFigures(soil, len(trials), len(trials) - len(good), *middle)
