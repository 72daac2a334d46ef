"""Trials of the immobilisation warning on simulated drives: how early it comes, and how often it is false.

    lead = time at which slip passes its limit - time at which the last warning began

The warning is that of the service (`WindowEstimator.solve`). A drive into trouble (trials/boggings.py) counts as
predictable if MIN_LEAD_TIME + REACTION_TIME pass, or the distance that belongs to them is driven, between the first
perceptible loss of draft and the moment when slip passes its limit. On firm ground (trials/firm_drives.py) every
warning is false. Seeds are even; thresholds are set on drives with odd ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.estimation.assembly import rig_of
from soilbus.estimation.instrumentation import completed
from soilbus.estimation.window import forward
from soilbus.grouping import grouped
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.drive import drive
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.scenario import Swing
from soilbus.trials.boggings import KINDS, BoggingDrive, bogging
from soilbus.trials.draws import Each, seeds_of
from soilbus.trials.firm_drives import DRIVE_TIME, EASY, FIRM_KINDS, HARD, firm_ground
from soilbus.trials.windows import bins_of, task_of, torque_limits

MIN_LEAD_TIME, MIN_LEAD_DISTANCE = 3.0, 3.0
"""Lead of a warning that is early enough: [s], or [m] for the second one."""
REACTION_TIME = 1.0
"""Time [s] that a change needs to rise out of the noise."""
PERCEPTIBLE_DRAFT_LOSS = 0.05
"""Loss, as a share of the largest draft, that slip and pull show above their noise."""
MIN_DRIVE_TIME = 5.0
"""Time [s] after the first window within which slip may pass with no time for a warning: no such drive counts."""


class Task(NamedTuple):
    """Task to simulate one drive: a kind of boggings.KINDS or firm_drives.FIRM_KINDS."""

    config: Config
    kind: str
    seed: int


@dataclass(frozen=True, slots=True)
class WarningTrial:
    """Result of one drive: seconds watched and warnings begun before slip passed its limit.

    lead [s] and distance [m] are of the last warning: nan where slip never passed, or within MIN_DRIVE_TIME; 0 without
    a warning. possible and possible_distance are those from the first perceptible loss of draft, or the first window.
    """

    kind: str
    seconds: float
    warnings: int
    lead: float
    distance: float
    possible: float = np.inf
    possible_distance: float = np.inf

    @property
    def in_time(self) -> bool:
        """Whether the warning was early enough."""
        return self.lead >= MIN_LEAD_TIME or self.distance >= MIN_LEAD_DISTANCE

    @property
    def sudden(self) -> bool:
        """Whether slip passed its limit too soon for any warning to be early enough."""
        speed = self.possible_distance / self.possible if 0.0 < self.possible < np.inf else 0.0
        is_short = self.possible_distance < MIN_LEAD_DISTANCE + REACTION_TIME * speed
        return self.possible < MIN_LEAD_TIME + REACTION_TIME and is_short


@dataclass(frozen=True, slots=True)
class WarningFigures:
    """Figures of one kind: predictable boggings, how many were warned of in time, median and least lead [s].

    `sudden` boggings leave no time, and `delay` is the median time [s] of their warnings after the first perceptible
    loss. On firm ground: hours and false warnings.
    """

    kind: str
    boggings: int
    warned: int
    lead: float
    least: float
    sudden: int
    delay: float
    hours: float
    false: int


class Drive(NamedTuple):
    """Start and end [s] of the time watched, and whether slip passed its limit at the end.

    t [s] and distance driven [m] (N,); `felt` is the time [s] of the first perceptible loss of draft.
    """

    start: float
    end: float
    passed: bool
    t: Array
    distance: Array
    felt: float


def trial(task: Task) -> WarningTrial:
    """Simulate one drive, estimate every hop as the service does, and rate its warnings."""
    recording, seen = driven(task)
    return rated(task.kind, seen, *_warnings(recording, task.config, seen.end))


def driven(task: Task) -> tuple[Recording, Drive]:
    """Simulate one drive."""
    config, rng = task.config, np.random.default_rng([task.seed, 3])
    is_firm = task.kind in FIRM_KINDS
    trouble = BoggingDrive(firm_ground(config, task.kind, rng)) if is_firm else bogging(config, task.kind, rng)
    recording = simulate(config, trouble.scenario, task.seed, trouble.effects)
    truth, start = recording.truth, config.estimator.window
    t = truth["t"]
    slip = np.mean([truth[f"slip.{wheel.name}"] for wheel in config.wheel if wheel.driven], axis=0)
    passed = t[(slip > config.traversability.max_slip) & (t > start)]
    end = float(passed[0]) if len(passed) else float(t[-1])
    felt = _first_perceptible(task, trouble, end) if len(passed) else end
    return recording, Drive(start, end, len(passed) > 0, t, truth["distance"], felt)


def _first_perceptible(task: Task, trouble: BoggingDrive, end: float) -> float:
    """Time [s] of the first perceptible loss: the ground's largest draft has fallen by PERCEPTIBLE_DRAFT_LOSS for good.

    0 where it is not: then the demand is what grows.
    """
    limit = task.config.traversability.max_slip
    even = replace(trouble.scenario, draft=None, slip=Swing(limit, limit), slip_spread=0.0, side_shift=Swing(0.0, 0.0))
    truth = drive(task.config, even, task.seed, trouble.effects).columns
    mass = task.config.vehicle.mass if task.config.vehicle else 0.0
    held, t = truth["draft"] + mass * truth["acceleration"], truth["t"]
    firm = t[(held >= (1.0 - PERCEPTIBLE_DRAFT_LOSS) * held[0]) & (t <= end)]
    return float(firm[-1]) if len(firm) and firm[-1] < t[t <= end][-1] else 0.0


def _warnings(recording: Recording, config: Config, end: float) -> tuple[list[float], bool]:
    """When the service's warnings begin [s] until `end` [s], and whether one holds there."""
    rig, settings = rig_of(config), config.estimator
    estimator, limit = WindowEstimator(config), torque_limits(config, rig)
    store, begins, holds = bins_of(config, recording.channels), list[float](), False
    for due in np.arange(settings.window, end + settings.hop, settings.hop).tolist():
        window = completed(forward(store.window(due - settings.window, due)), rig)
        found = estimator.solve(task_of(window, due, config, limit, fresh=due == settings.window)).warnings
        begins += [t for t in found.begun if t < end]
        holds = found.since is not None and found.since < end
    return begins, holds


def rated(kind: str, seen: Drive, begins: Sequence[float], holds: bool) -> WarningTrial:
    """Return the trial's result from the times [s] at which warnings began, and whether the last held."""
    seconds = seen.end - seen.start
    if not seen.passed or seconds <= MIN_DRIVE_TIME:
        return WarningTrial(kind, seconds, len(begins), np.nan, np.nan)
    lead = seen.end - begins[-1] if holds and begins else 0.0
    possible = seen.end - min(max(seen.felt, seen.start), seen.end)
    at_end, at_lead, at_possible = np.interp(seen.end - np.array([0.0, lead, possible]), seen.t, seen.distance).tolist()
    return WarningTrial(kind, seconds, len(begins), lead, at_end - at_lead, possible, at_end - at_possible)


def warning_trials(
    config: Config, boggings: int, hours: float, seed: int, each: Each = map
) -> tuple[WarningFigures, ...]:
    """Return the figures of drives into trouble of all kinds, and of hours on firm ground.

    Raises SimulationError where the vehicle cannot be driven.
    """
    firm = math.ceil(3600.0 * hours / (DRIVE_TIME - config.estimator.window))
    kinds = [KINDS[i % len(KINDS)] for i in range(boggings)]
    kinds += [HARD[i // 2 % len(HARD)] if i % 2 else EASY for i in range(firm)]
    seeds = [s // 2 * 2 for s in seeds_of(seed, "warnings", len(kinds))]
    trials = list(each(trial, [Task(config, kind, s) for kind, s in zip(kinds, seeds, strict=True)]))
    of_kind = grouped(trials, lambda t: t.kind)
    return tuple(figures(kind, of_kind[kind]) for kind in (*KINDS, *FIRM_KINDS) if kind in of_kind)


def figures(kind: str, trials: Sequence[WarningTrial]) -> WarningFigures:
    """Return the figures of trials of one kind; those whose slip passed are boggings."""
    bogged = [t for t in trials if np.isfinite(t.lead)]
    asked = [t for t in bogged if not t.sudden]
    rest = [t for t in trials if t.kind in FIRM_KINDS]
    leads = np.array([t.lead for t in asked])
    delays = [t.possible - t.lead for t in bogged if t.sudden]
    lead, least = (float(of(leads)) if len(asked) else math.nan for of in (np.median, np.min))
    delay = float(np.median(delays)) if delays else math.nan
    hours, false = sum(t.seconds for t in rest) / 3600.0, sum(t.warnings for t in rest)
    warned = sum(t.in_time for t in asked)
    return WarningFigures(kind, len(asked), warned, lead, least, len(delays), delay, hours, false)
