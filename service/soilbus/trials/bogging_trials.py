"""Trials of the immobilisation warning on simulated drives: how early it comes, and how often it is false.

    lead = time at which slip passes its limit - time at which the last warning began

The warning is that of the service: by the known soil's curve (decision/immobilisation.py) or by what wheels and
vehicle do (decision/traction_loss.py). A drive into trouble (trials/boggings.py) counts as predictable if
MIN_LEAD_TIME + REACTION_TIME pass, or the distance that belongs to them is driven, between the first perceptible loss
of draft and the moment when slip passes its limit. On firm ground (trials/firm_drives.py) every warning is false.
Drives with even seeds are reported; thresholds are set on odd ones.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.decision.capability import OverSlip
from soilbus.decision.immobilisation import Alert, Moment, Watch, moments, watched, with_loss
from soilbus.decision.options import WATCH, WatchOptions
from soilbus.decision.traction_loss import NO_LOSS, TractionLoss, bins_of_a_moment, motions, slope_felt
from soilbus.decision.traction_loss import observed as loss_after
from soilbus.estimation.assembly import rig_of
from soilbus.estimation.instrumentation import completed
from soilbus.estimation.window import forward
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.drive import drive
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.scenario import Swing
from soilbus.trials.boggings import KINDS, BoggingDrive, bogging
from soilbus.trials.draws import Each
from soilbus.trials.firm_drives import DRIVE_TIME, EASY, FIRM_KINDS, HARD, firm_ground
from soilbus.trials.windows import bins_of, task_of, torque_limits

HALVES = ("report", "tune")
"""Drives by the parity of their seeds: even ones are reported, odd ones serve to set thresholds."""
MIN_LEAD_TIME, MIN_LEAD_DISTANCE = 3.0, 3.0
"""Lead of a warning that is early enough: [s], or [m] for the second one."""
REACTION_TIME = 1.0
"""Time [s] that a change needs to rise out of the noise."""
PERCEPTIBLE_DRAFT_LOSS = 0.05
"""Loss, as a share of the largest draft, that slip and pull show above their noise."""
MIN_DRIVE_TIME = 5.0
"""Time [s] after the first window within which slip may pass with no time for a warning: no such drive counts."""


class Task(NamedTuple):
    """One drive: a kind of boggings.KINDS or firm_drives.FIRM_KINDS."""

    config: Config
    kind: str
    seed: int


@dataclass(frozen=True, slots=True)
class WarningTrial:
    """One drive.

    Attributes
    ----------
    kind
        Of boggings.KINDS or firm_drives.FIRM_KINDS.
    seconds
        Time watched [s].
    warnings
        Warnings begun before slip passed its limit.
    lead, distance
        Of the last warning [s], [m]; nan where slip never passed, or passed before MIN_DRIVE_TIME; 0 without a warning.
    possible, possible_distance
        Time [s] and distance [m] from the first perceptible loss of draft, or the first window, until slip passed.
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
        """Whether slip passed too soon after the first sign for any warning to be early enough."""
        speed = self.possible_distance / self.possible if 0.0 < self.possible < np.inf else 0.0
        return (
            self.possible < MIN_LEAD_TIME + REACTION_TIME
            and self.possible_distance < MIN_LEAD_DISTANCE + REACTION_TIME * speed
        )


@dataclass(frozen=True, slots=True)
class WarningFigures:
    """Figures of one kind.

    Attributes
    ----------
    boggings, warned
        Predictable boggings, and those warned of early enough.
    lead, least
        Median and least lead [s].
    sudden, delay
        Boggings that were too sudden, and the median delay [s] of their warnings behind the first perceptible loss.
    hours, false
        On firm ground: hours and false warnings.
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


class Observation(NamedTuple):
    """One drive as the watch sees it.

    Attributes
    ----------
    moments
        What the watch reads at each look.
    curves
        Times [s] from which on a curve of pull over slip is known, and the curve.
    start, end
        Of the watched time [s]; it ends when slip passes its limit (`passed`), or with the drive.
    t, distance
        Times [s] and distances driven [m] (N,).
    felt
        Time [s] of the first perceptible loss of draft.
    losses
        What wheels and vehicle do at each look, without any soil; empty where it is not looked at.
    """

    moments: list[Moment]
    curves: list[tuple[float, OverSlip]]
    start: float
    end: float
    passed: bool
    t: Array
    distance: Array
    felt: float
    losses: Sequence[TractionLoss] = ()


def trial(task: Task) -> WarningTrial:
    """Simulate one drive, estimate every hop as the service does, and watch."""
    return judged(task.kind, observed(task))


def observed(task: Task) -> Observation:
    """Simulate one drive and estimate every hop."""
    config = task.config
    rng = np.random.default_rng([task.seed, 3])
    if task.kind in FIRM_KINDS:
        trouble = BoggingDrive(firm_ground(config, task.kind, rng))
    else:
        trouble = bogging(config, task.kind, rng)
    recording = simulate(config, trouble.scenario, task.seed, trouble.effects)
    truth = recording.truth
    slip = np.mean([truth[f"slip.{wheel.name}"] for wheel in config.wheel if wheel.driven], axis=0)
    start = config.estimator.window
    passed = truth["t"][(slip > config.traversability.max_slip) & (truth["t"] > start)]
    end = float(passed[0]) if len(passed) else float(truth["t"][-1])
    looks, losses, curves = _looks_and_curves(recording, config, end)
    felt = _first_perceptible(task, trouble, end) if len(passed) else end
    return Observation(
        looks, curves, start, end, len(passed) > 0, truth["t"], truth["distance"], felt, losses
    )  # fmt: skip


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


def judged(kind: str, observation: Observation, options: WatchOptions = WATCH) -> WarningTrial:
    """The trial's result from what the watch saw."""
    t, warned = watch(observation, options)
    begins = t[1:][warned[1:] & ~warned[:-1]]
    seconds = observation.end - observation.start
    if not observation.passed or seconds <= MIN_DRIVE_TIME:
        return WarningTrial(kind, seconds, len(begins), np.nan, np.nan)
    lead = observation.end - float(begins[-1]) if len(begins) and warned[-1] else 0.0
    possible = observation.end - min(max(observation.felt, observation.start), observation.end)
    distance, possible_distance = (_distance_since(observation, observation.end - s) for s in (lead, possible))
    return WarningTrial(kind, seconds, len(begins), lead, distance, possible, possible_distance)


def _distance_since(observation: Observation, since: float) -> float:
    """Distance [m] driven from a time [s] until the end."""
    return float(
        np.interp(observation.end, observation.t, observation.distance)
        - np.interp(since, observation.t, observation.distance)
    )


def watch(observation: Observation, options: WatchOptions = WATCH) -> tuple[Array, NDArray[np.bool_]]:
    """Times [s] (N,) of the looks, and whether each warned."""
    state, curve, curves, out = Watch(), None, iter(observation.curves), []
    due = next(curves, None)
    losses = observation.losses or [NO_LOSS] * len(observation.moments)
    for moment, loss in zip(observation.moments, losses, strict=True):
        while due is not None and moment.t >= due[0]:
            curve, due = due[1], next(curves, None)
        state = watched(state, moment.t, moment.slip, moment.pull, curve, moment.inertia, options)
        out.append((moment.t, with_loss(state, loss).warning is Alert.IMMOBILISATION))
    t, warned = np.array(out, float).reshape(-1, 2).T
    return t, warned > 0.5


def _looks_and_curves(
    recording: Recording, config: Config, end: float
) -> tuple[list[Moment], list[TractionLoss], list[tuple[float, OverSlip]]]:
    """What is seen until the end [s], and from their times on the curves of windows."""
    rig, settings = rig_of(config), config.estimator
    estimator, limit = WindowEstimator(config), torque_limits(config, rig)
    store = bins_of(config, recording.channels)
    curves = []
    for due in np.arange(settings.window, end, settings.hop).tolist():
        window = completed(forward(store.window(due - settings.window, due)), rig)
        result = estimator.solve_unwatched(task_of(window, due, config, limit, fresh=due == settings.window))
        if result.curve is not None:
            curves.append((due, result.curve))
    seen = completed(forward(store.window(0.0, end)), rig)
    losses, loss, bins, ends = [], NO_LOSS, bins_of_a_moment(settings.bin), np.arange(len(seen.t))
    for motion in motions(seen, rig, limit, config.traversability, ends, bins):
        loss = loss_after(loss, motion, config)
        losses.append(loss)
    looks = [
        moment._replace(inertia=moment.inertia - slope_felt(loss, rig))
        for moment, loss in zip(moments(seen, rig, ends, bins, settings.min_speed), losses, strict=True)
    ]
    return looks, losses, curves


def half_of(seed: int) -> str:
    """The half of all drives that one with this seed is in: thresholds may be set by "tune" drives alone."""
    return "tune" if seed % 2 else "report"


def warning_trials(
    config: Config, boggings: int, hours: float, seed: int, each: Each = map, half: str = "report"
) -> tuple[WarningFigures, ...]:
    """Figures of simulated boggings and of hours without one.

    Parameters
    ----------
    config
        The vehicle.
    boggings
        Number of drives into trouble, evenly of all kinds.
    hours
        Hours on firm ground, half of them on hard drives.
    seed
        The same seed gives the same drives.
    each
        The built-in map, or that of draws.processes.
    half
        The half of all drives that these belong to (half_of).

    Raises
    ------
    SimulationError
        The vehicle cannot be driven.
    ValueError
        Another half.
    """
    if half not in HALVES:
        raise ValueError(f"no half of the drives is called {half}; known: {', '.join(HALVES)}")
    firm = math.ceil(3600.0 * hours / (DRIVE_TIME - config.estimator.window))
    kinds = [KINDS[i % len(KINDS)] for i in range(boggings)] + [
        HARD[i // 2 % len(HARD)] if i % 2 else EASY for i in range(firm)
    ]
    key = np.random.SeedSequence([seed, zlib.crc32(b"warnings")])
    seeds = [int(s) // 2 * 2 + HALVES.index(half) for s in key.generate_state(len(kinds))]
    trials = list(each(trial, [Task(config, kind, s) for kind, s in zip(kinds, seeds, strict=True)]))
    return tuple(
        figures(kind, found)
        for kind in (*KINDS, *FIRM_KINDS)
        if (found := [t for t in trials if t.kind == kind])
    )  # fmt: skip


def figures(kind: str, trials: Sequence[WarningTrial]) -> WarningFigures:
    """Figures of trials of one kind; those whose slip passed are boggings."""
    bogged = [t for t in trials if np.isfinite(t.lead)]
    asked = [t for t in bogged if not t.sudden]
    rest = [t for t in trials if t.kind in FIRM_KINDS]
    leads = np.array([t.lead for t in asked])
    delays = [t.possible - t.lead for t in bogged if t.sudden]
    return WarningFigures(
        kind=kind,
        boggings=len(asked),
        warned=sum(t.in_time for t in asked),
        lead=float(np.median(leads)) if len(asked) else float("nan"),
        least=float(leads.min()) if len(asked) else float("nan"),
        sudden=len(delays),
        delay=float(np.median(delays)) if delays else float("nan"),
        hours=sum(t.seconds for t in rest) / 3600.0,
        false=sum(t.warnings for t in rest),
    )
