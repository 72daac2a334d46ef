"""Simulated boggings and firm ground: how long before slip passes its limit soilbus warns, and how often in vain."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.assembly import model_of, prior_of, rig_of
from soilbus.capability.assessment import OverSlip, assess
from soilbus.capability.immobilisation import Alert, Watch, moments, watched
from soilbus.config import Config
from soilbus.estimation.tracker import Ground, Settings, Tracker
from soilbus.estimation.window import BinStore, Rig
from soilbus.simulator.draft_trials import true_largest_draft
from soilbus.simulator.monte_carlo import Each
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import WheelModel

Array = NDArray[np.float64]

FIRM = ("rubicon_sandy_loam_43", "north_gower_clayey_loam_46", "upland_sandy_loam_51", "loam")
SOFT = ("wet_clay", "clayey_soil_38", "lean_clay_32", "heavy_clay_40")
LOOK = 0.1
"""Time [s] between two looks, as in the service."""
ENOUGH_TIME, ENOUGH_WAY = 3.0, 3.0
"""Warning ahead that is enough: [s] or [m]."""
EARLIEST = 10.0
"""Slip that passes within this time [s] of the first window cannot be foreseen: no drive to judge by."""
BOGGING, FIRM_DRIVE = 60.0, 300.0
"""Length of a drive [s]."""
EASY = (0.2, 0.65)
"""Draft on firm ground, in units of the largest."""


class Task(NamedTuple):
    """One drive; a bogging or on firm ground."""

    config: Config
    bogging: bool
    seed: int


@dataclass(frozen=True, slots=True)
class WarningTrial:
    """One drive: seconds watched, warnings begun before slip passed, and where it did the lead of the last one.

    lead [s] and way [m] are nan where slip never passed, or at once (EARLIEST), and 0 where
    it passed unwarned.
    """

    bogging: bool
    seconds: float
    warnings: int
    lead: float
    way: float


@dataclass(frozen=True, slots=True)
class WarningFigures:
    """Boggings: how many, warned early enough, median and least lead [s]; firm ground: hours and false warnings."""

    boggings: int
    warned: int
    lead: float
    least: float
    hours: float
    false: int


def scenario_of(task: Task) -> Scenario:
    """Firm soil that turns soft, or a draft that outgrows firm soil; or firm soil and an easy draft."""
    rng = np.random.default_rng([task.seed, 3])
    rig, settings = rig_of(task.config), task.config.traversability
    firm = str(rng.choice(FIRM))
    limit = np.full(len(rig.radius), np.nan)
    most = true_largest_draft(soil_named(firm), rig, limit, settings.max_slip, WheelModel())
    if not task.bogging:
        low, high = (share * most for share in EASY)
        return Scenario(FIRM_DRIVE, (Patch(0.0, firm),), draft=Swing(low, high), lift_slip=Swing(0.9, 0.9))
    if rng.random() < 0.5:
        length, start = rng.uniform(15.0, 40.0), rng.uniform(15.0, 25.0)
        soils = (Patch(0.0, firm), Patch(start, str(rng.choice(SOFT))))
        share = rng.uniform(0.35, 0.55)
        draft = Swing((share - 0.05) * most, (share + 0.05) * most)
        return Scenario(BOGGING, soils, draft=draft, lift_slip=Swing(0.9, 0.9), transition=length)
    draft = Swing(0.3 * most, rng.uniform(1.1, 1.3) * most, slowest=0.008, fastest=0.02)
    return Scenario(BOGGING, (Patch(0.0, firm),), draft=draft, lift_slip=Swing(0.9, 0.9))


def trial(task: Task) -> WarningTrial:
    """Drive, estimate every hop as the service does, and watch."""
    config, rig = task.config, rig_of(task.config)
    recording = simulate(config, scenario_of(task), task.seed)
    truth = recording.truth
    slip = np.mean([truth[f"slip.{wheel}"] for wheel in rig.wheels], axis=0)
    start, last = config.estimator.window, float(truth["t"][-1])
    passed = truth["t"][(slip > config.traversability.max_slip) & (truth["t"] > start)]
    end = float(passed[0]) if len(passed) else last
    t, warned = watch(recording, config, end)
    begins = t[1:][warned[1:] & ~warned[:-1]]
    lead, way = np.nan, np.nan
    if len(passed) and end - start > EARLIEST:
        lead = end - float(begins[-1]) if len(begins) and warned[-1] else 0.0
        way = float(
            np.interp(end, truth["t"], truth["distance"]) - np.interp(end - lead, truth["t"], truth["distance"])
        )
    return WarningTrial(task.bogging, end - start, len(begins), lead, way)


def watch(recording: Recording, config: Config, end: float) -> tuple[Array, NDArray[np.bool_]]:
    """Times [s] (N,) of the looks from the start to the end [s], and whether each warned."""
    rig, settings = rig_of(config), config.estimator
    tracker = Tracker(
        rig, prior_of(config), model_of(config),
        Settings(settings.window, settings.min_speed, settings.max_turn, settings.max_chi2, settings.soil_drift),
    )  # fmt: skip
    store = BinStore(rig, LOOK, 0.0)
    store.add({n: (c.t, c.value) for n in rig.channels if (c := recording.channels.get(n)) is not None})
    state, curve, due, out = Watch(), None, settings.window, []
    for moment in moments(store.window(0.0, end), rig, 0.0, settings.min_speed):
        if moment.t >= due:
            curve = _curve(tracker, store, due, config, rig) or curve
            due += settings.hop
        state = watched(state, *moment, curve)
        out.append((moment.t, state.warning is Alert.IMMOBILISATION))
    t, warned = np.array(out, float).reshape(-1, 2).T
    return t, warned > 0.5


def _curve(tracker: Tracker, store: BinStore, end: float, config: Config, rig: Rig) -> OverSlip | None:
    """Pull over slip of one window, None where the service would not call it valid."""
    tracked = tracker.estimate(store.window(end - config.estimator.window, end), end)
    fit = tracked.fit
    if fit is None or tracked.mismatch or not fit.converged or tracked.ground is Ground.CHANGING:
        return None
    way = config.traversability
    limit = np.full(len(rig.radius), np.nan)
    able, _ = assess(fit.posterior, rig, model_of(config), None, limit, way.max_slip, way.max_sinkage)
    return None if able is None else able.over_slip


def warning_trials(config: Config, boggings: int, firm: int, seed: int, each: Each = map) -> WarningFigures:
    """Figures of so many boggings and drives on firm ground (FIRM_DRIVE each); the same seed gives the same drives.

    Raises SimulationError where the vehicle cannot be driven.
    """
    key = np.random.SeedSequence([seed, zlib.crc32(b"warnings")])
    seeds = iter(key.generate_state(boggings + firm).tolist())
    tasks = [Task(config, i < boggings, next(seeds)) for i in range(boggings + firm)]
    return figures(list(each(trial, tasks)))


def figures(trials: Sequence[WarningTrial]) -> WarningFigures:
    """The figures of some trials: boggings are those whose slip passed."""
    bogged = [t for t in trials if np.isfinite(t.lead)]
    rest = [t for t in trials if not t.bogging]
    leads = np.array([t.lead for t in bogged])
    return WarningFigures(
        boggings=len(bogged),
        warned=sum(t.lead >= ENOUGH_TIME or t.way >= ENOUGH_WAY for t in bogged),
        lead=float(np.median(leads)) if len(bogged) else float("nan"),
        least=float(leads.min()) if len(bogged) else float("nan"),
        hours=sum(t.seconds for t in rest) / 3600.0,
        false=sum(t.warnings for t in rest),
    )
