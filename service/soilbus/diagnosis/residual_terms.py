"""What no effect of the catalogue explains, described as simply as the data allow.

For each channel a sparse regression of the residuals on a library of plain terms: forward
selection, each term chosen and counted by what it does on the blocks learned from (BIC),
judged by what it does on those held out.  A description, not a mechanism: it holds for the
vehicle, the ground and the range of driving of these recordings and may mean nothing beyond.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import Checked, FittedModel
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.where import channels
from soilbus.estimation.observation_model import Latents, Linearisation, ObservationModelWithEffects
from soilbus.terra.wheel import sinkage

MAX_TERMS = 3
HARMONICS = (1, 2)
WORTH = 0.1
"""Share of a channel's held-out excess that a description must explain to be told."""
WARNING = (
    "learned from these recordings alone: a description within the range driven, not a mechanism; "
    "do not rely on it on other ground or outside that range"
)


@dataclass(frozen=True, slots=True)
class Term:
    """coefficient [SI unit of the channel] times a regressor of no unit."""

    regressor: str
    coefficient: float


@dataclass(frozen=True, slots=True)
class Correction:
    """Reading less model of one channel as a sum of terms; explained: share of the held-out excess."""

    channel: str
    wheel: str
    terms: tuple[Term, ...]
    explained: float

    @property
    def formula(self) -> str:
        """The sum as text."""
        parts = [f"{t.coefficient:+.4g}" + ("" if t.regressor == "1" else f" {t.regressor}") for t in self.terms]
        return " ".join(parts)


class _Sample(NamedTuple):
    """Standardised residuals (n,), their std in SI (n,), and regressors (n,) by name."""

    z: Array
    std: Array
    regressors: dict[str, Array]


def corrections(records: list[Record], completion: FittedModel) -> list[Correction]:
    """Descriptions of what the model leaves, channel by channel, the one that explains most first."""
    found = []
    names = channels(records[0].learned.rig.wheels, records[0].learned.with_sinkage)
    for place, (channel, wheel) in enumerate(names):
        learned, checked = (_joined(list(part)) for part in zip(*_samples(records, completion, place), strict=True))
        if not len(learned.z) or not len(checked.z):  # a channel that is not there
            continue
        terms = _selected(learned)
        explained = _explained(checked, terms)
        if terms and explained > WORTH:
            found.append(Correction(channel, wheel, tuple(terms), explained))
    return sorted(found, key=lambda correction: -correction.explained)


def _samples(records: list[Record], completion: FittedModel, place: int) -> Iterator[tuple[_Sample, _Sample]]:
    for record, fit, check in zip(records, completion.fits, completion.checks, strict=True):
        learned = record.learned.with_effects(completion.effects, completion.free)
        of_fit = _sample(learned, fit.optimum.at, fit.optimum.latents, fit.optimum.gains, place)
        yield of_fit, _of_check(check, fit.mode.gains, place)


def _of_check(check: Checked, gains: Array, place: int) -> _Sample:
    return _sample(check.problem, check.at, check.latents, gains, place)


def _sample(
    problem: ObservationModelWithEffects, at: Linearisation, latents: Latents, gains: Array, place: int
) -> _Sample:
    z, _ = problem.standardised(at, gains)
    W, r = problem.n_wheels, problem.rig.radius
    known = np.isfinite(z[:, place])
    raw = at.rows[:, 0].reshape(z.shape)[:, place]
    scale = np.abs(raw[known]).sum() / max(float(np.abs(z[known, place]).sum()), 1e-12)
    own = None if place == W else place % (W + 1)
    slip = 1.0 - latents.ground_speed[:, None] / (r * latents.speed)
    wheels = {"slip": slip, "load": latents.load / latents.load.mean(0), "sinkage": sinkage(latents.entry_angle, r)}
    by = {name: (v.mean(1) if own is None else v[:, own]) for name, v in wheels.items()}
    by["sinkage"] = by["sinkage"] / by["sinkage"].mean()
    by["load"] = by["load"] - 1.0
    by["speed"] = latents.ground_speed / latents.ground_speed.mean() - 1.0
    by["time"] = problem.since / max(problem.duration, 1e-9)
    by["acceleration"] = problem.acceleration
    by["draft"] = problem.draft / max(float(np.abs(problem.draft).mean()), 1e-9)
    products = {f"{a} {b}": by[a] * by[b] for a, b in (("slip", "slip"), ("slip", "load"), ("slip", "speed"))}
    angle = problem.wheel_angle.mean(1) if own is None else problem.wheel_angle[:, own]
    waves = {f"{f.__name__}({k} wheel angle)": f(k * angle) for k in HARMONICS for f in (np.sin, np.cos)}
    regressors = {"1": np.ones(len(z))} | by | products | waves
    return _Sample(z[known, place], np.full(int(known.sum()), scale), {n: v[known] for n, v in regressors.items()})


def _joined(parts: list[_Sample]) -> _Sample:
    names = parts[0].regressors
    return _Sample(
        np.concatenate([p.z for p in parts]),
        np.concatenate([p.std for p in parts]),
        {name: np.concatenate([p.regressors[name] for p in parts]) for name in names},
    )


def _selected(sample: _Sample) -> list[Term]:
    """Terms by forward selection while BIC falls."""
    chosen: list[str] = []
    left, n = float(sample.z @ sample.z), len(sample.z)
    while len(chosen) < MAX_TERMS and n > 20:
        trials = {name: _rest(sample, [*chosen, name]) for name in sample.regressors if name not in chosen}
        best = min(trials, key=lambda name: trials[name])
        if left - trials[best] < 2.0 * math.log(n) + 2.0 * math.log(len(trials)):
            break
        chosen.append(best)
        left = trials[best]
    return [Term(n, float(c)) for n, c in zip(chosen, _solution(sample, chosen), strict=True)] if chosen else []


def _design(sample: _Sample, names: list[str]) -> Array:
    return np.column_stack([sample.regressors[name] / sample.std for name in names])


def _solution(sample: _Sample, names: list[str]) -> Array:
    return np.asarray(np.linalg.lstsq(_design(sample, names), sample.z, rcond=None)[0])


def _rest(sample: _Sample, names: list[str]) -> float:
    miss = sample.z - _design(sample, names) @ _solution(sample, names)
    return float(miss @ miss)


def _explained(sample: _Sample, terms: list[Term]) -> float:
    """Share of the excess of chi-square over noise that terms explain where they were not learned."""
    if not terms:
        return 0.0
    before = float(sample.z @ sample.z)
    miss = sample.z - _design(sample, [t.regressor for t in terms]) @ np.array([t.coefficient for t in terms])
    return (before - float(miss @ miss)) / max(before - len(sample.z), 1e-9) if before > len(sample.z) else 0.0
