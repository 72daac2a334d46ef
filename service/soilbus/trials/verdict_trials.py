"""Trials of the decision: the probability that the present demand can be met, beside whether it truly can.

    Brier score = mean((probability - outcome)^2)
    expected    = mean(p (1 - p))  if calls of p come true with frequency p

Each drive has its own soil near one of the table, its own slips and limits, and ends in one call of the service from
one window. The truth is solved by the simulator's equilibrium. Three drives in four ask for a margin drawn from the
estimate, which makes all probabilities about equally frequent; calibrated calls of p still come true with frequency p.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri
from scipy.stats import binomtest

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.decision.capability import Demand
from soilbus.decision.traversability import State, Traversability
from soilbus.estimation.assembly import prior_of, rig_of
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.drivetrain import drivetrain_of
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import KINDS
from soilbus.terra.wheel import Soil, WheelModel
from soilbus.trials.draft_trials import true_largest_draft
from soilbus.trials.draws import Each, drawn_soil, first_drive, prior_about, seeds_of, with_prior
from soilbus.trials.windows import first_window, torque_limits

SOIL_LOG_SD = 0.2
"""Standard deviation of the logarithms of a drive's soil parameters about the table's soil."""
LOW_SLIP, HIGH_SLIP = (0.03, 0.12), (0.15, 0.55)
"""Between which the lowest and the highest slip of a drive lie."""
TORQUE_LIMIT_RANGE, SINKAGE_LIMIT_RANGE = (400.0, 1600.0), (0.02, 0.15)
"""Ranges of a motor's torque limit at the wheel [N m] and of a sinkage limit [m]."""
NEAR_LIMIT_SHARE = 0.75
"""Share of drives that ask for a margin near the limit."""
MIN_PROBABILITY = 1e-3
"""Least and, from 1, greatest probability that a margin near the limit is drawn for."""
BINS = 10
"""Equal intervals of probability."""


class Ground(NamedTuple):
    """Ground of a drive: soil, torque limits (W,) [N m] (nan: none) and a sinkage limit [m]."""

    name: str
    soil: Soil
    torque_limit: Array
    max_sinkage: float


@dataclass(frozen=True, slots=True)
class Call:
    """Verdict on one drive: probability, state, limiting cause, and whether the demand can truly be met."""

    soil: str
    probability: float
    state: State
    limit: str | None
    true: bool


@dataclass(frozen=True, slots=True)
class Bin:
    """Verdicts with a probability of low to high: count, mean, share that came true, and its 95 % interval."""

    low: float
    high: float
    calls: int
    mean: float
    true: float
    least: float
    most: float


@dataclass(frozen=True, slots=True)
class Reliability:
    """Figures of all verdicts.

    brier is the mean square of probability less outcome, brier_expected and brier_std its mean and sd if calls of p
    come true with frequency p; excess is outcomes less the sum of the probabilities, over its sd; wrong_go counts
    drives called go that cannot meet the demand, wrong_go_expected is their number by the probabilities.
    """

    drives: int
    failed: int
    brier: float
    brier_expected: float
    brier_std: float
    excess: float
    go: int
    wrong_go: int
    wrong_go_expected: float
    bins: tuple[Bin, ...]


def verdict_trials(config: Config, drives: int, seed: int, each: Each = map) -> Reliability:
    """Return the figures of `drives` simulated verdicts; SimulationError where the vehicle cannot drive."""
    return reliability(list(each(partial(trial, config), seeds_of(seed, "verdicts", drives))))


def trial(config: Config, seed: int) -> Call:
    """Simulate one drive, estimate, call, and solve for the truth."""
    rng = np.random.default_rng([seed, 4])

    def draw() -> tuple[Ground, Scenario]:
        ground = _ground(config, rng)
        slip = Swing(rng.uniform(*LOW_SLIP), rng.uniform(*HIGH_SLIP))
        return ground, Scenario(config.estimator.window, (Patch(0.0, ground.name, ground.soil),), slip=slip)

    ground, recording = first_drive(config, draw, seed)
    prior = prior_about(prior_of(config), ground.soil, np.random.default_rng([seed, 1]))
    estimating = _with_settings(with_prior(config, prior), max_sinkage=ground.max_sinkage)
    limit = np.fmin(ground.torque_limit, torque_limits(config, rig_of(config)))
    window = WindowEstimator(estimating).estimate(first_window(config, recording, limit))

    def decided(by: Config) -> Traversability:
        return WindowEstimator(by).decide(window).traversability

    decision = decided(estimating)
    if decision.probability is None or window.demand is None:
        return Call(ground.name, math.nan, State.UNKNOWN, None, False)
    if rng.random() < NEAR_LIMIT_SHARE and (margin := _margin(decision, window.demand, rng)) is not None:
        estimating = _with_settings(estimating, margin=margin)
        decision = decided(estimating)
    probability = math.nan if decision.probability is None else decision.probability
    return Call(ground.name, probability, decision.state, decision.limit, _can(estimating, ground, recording))


def _with_settings(config: Config, **settings: float) -> Config:
    """The configuration with other settings of the decision."""
    return config.model_copy(update={"traversability": config.traversability.model_copy(update=settings)})


def _margin(decision: Traversability, demand: Demand, rng: np.random.Generator) -> float | None:
    """A margin with which the pull suffices with a probability drawn from all; None where no pull does."""
    if decision.capability is None or (most := decision.capability.likely_pull) is None or demand.pull <= 0.0:
        return None
    sure = float(ndtri(rng.uniform(MIN_PROBABILITY, 1.0 - MIN_PROBABILITY)))
    return (most.value - sure * math.hypot(most.std, demand.std)) / demand.pull - 1.0


def _can(config: Config, ground: Ground, recording: Recording) -> bool:
    """Whether the soil truly holds the draft on the level and its margin within all limits.

    The draft is the true mean over the last hop or the window, whichever is larger.
    """
    settings, t, draft = config.traversability, recording.truth["t"], recording.truth["draft"]
    end = min(config.estimator.window, float(t[-1]))
    asked = float(max(draft[(t > end - length) & (t <= end)].mean() for length in (end, config.estimator.hop)))
    most = true_largest_draft(
        ground.soil, rig_of(config), ground.torque_limit, settings.max_slip,
        WheelModel(shear_law=config.model.shear_law), ground.max_sinkage, drivetrain_of(config),
    )  # fmt: skip
    return most >= asked + settings.margin * max(asked, 0.0)


def _ground(config: Config, rng: np.random.Generator) -> Ground:
    name = str(rng.choice(KINDS))
    soil = drawn_soil(name, SOIL_LOG_SD, rng)
    torque_limit = np.array([wheel.max_torque or np.nan for wheel in config.wheel])
    max_sinkage, kind = config.traversability.max_sinkage, rng.integers(3)
    if kind == 1:
        torque_limit = np.full(len(torque_limit), rng.uniform(*TORQUE_LIMIT_RANGE))
    if kind == 2:
        max_sinkage = rng.uniform(*SINKAGE_LIMIT_RANGE)
    return Ground(name, soil, torque_limit, max_sinkage)


def reliability(calls: Sequence[Call]) -> Reliability:
    """Return the figures of some verdicts; nan where there is none."""
    made = [c for c in calls if math.isfinite(c.probability)]
    p, true = np.array([c.probability for c in made]), np.array([c.true for c in made], float)
    go = np.array([c.state is State.GO for c in made], bool)
    n, spread = max(len(made), 1), p * (1.0 - p)
    brier = float(np.mean((p - true) ** 2)) if made else math.nan
    total_std = math.sqrt(float(spread.sum()))
    expected = float(spread.mean()) if made else math.nan
    return Reliability(
        len(calls), len(calls) - len(made), brier, expected,
        brier_std=math.sqrt(float((spread * (1.0 - 2.0 * p) ** 2).sum())) / n,
        excess=float((true - p).sum()) / total_std if total_std > 0.0 else math.nan,
        go=int(go.sum()), wrong_go=int((go & (true < 0.5)).sum()), wrong_go_expected=float((1.0 - p)[go].sum()),
        bins=tuple(_bin(i, p, true) for i in range(BINS)),
    )  # fmt: skip


def _bin(i: int, p: Array, true: Array) -> Bin:
    inside = np.minimum((p * BINS).astype(int), BINS - 1) == i
    n, hits = int(inside.sum()), int(true[inside].sum())
    least, most = wilson(hits, n)
    mean, share = (float(p[inside].mean()), hits / n) if n else (math.nan, math.nan)
    return Bin(i / BINS, (i + 1) / BINS, n, mean, share, least, most)


def wilson(hits: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a binomial frequency (Wilson 1927); 0 to 1 for no trials."""
    if n == 0:
        return 0.0, 1.0
    interval = binomtest(hits, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)
