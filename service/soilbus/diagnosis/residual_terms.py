"""Residual terms: what no effect of the catalogue explains, described by a sparse regression.

    residual = sum over terms of coefficient * regressor(slip, load, speed, time, ...)

For each channel, terms are chosen by forward selection on the training blocks while BIC falls, and judged by the
share of the held-out blocks' excess chi-square that they explain.  This is a description, not a mechanism: it holds
for the vehicle, the ground and the range of driving of these recordings and may mean nothing beyond.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.diagnosis.options import DiagnosisOptions
from soilbus.diagnosis.records import Record
from soilbus.estimation.linearisation import Latents, Linearisation
from soilbus.estimation.observation_with_effects import ObservationModelWithEffects
from soilbus.terra.wheel import sinkage

__all__ = ["WARNING", "ResidualTerms", "Term", "residual_terms"]

WARNING = (
    "learned from these recordings alone: a description within the range driven, not a mechanism; "
    "do not rely on it on other ground or outside that range"
)


@dataclass(frozen=True, slots=True)
class Term:
    """A coefficient [SI unit of the channel] and its regressor, which has no unit."""

    regressor: str
    coefficient: float


@dataclass(frozen=True, slots=True)
class ResidualTerms:
    """Residual (reading less model) of one channel as a sum of terms; explained: share of the held-out excess."""

    channel: str
    wheel: str
    terms: tuple[Term, ...]
    explained: float

    @property
    def formula(self) -> str:
        """The sum as text."""
        parts = [f"{t.coefficient:+.4g}" + ("" if t.regressor == "1" else f" {t.regressor}") for t in self.terms]
        return " ".join(parts)


def residual_terms(records: Sequence[Record], fitted: FittedModel) -> list[ResidualTerms]:
    """Descriptions of what a fitted model leaves, one a channel, the one that explains most first."""
    found, options = [], records[0].options
    for channel, wheel in dict.fromkeys(name for record in records for name in record.training.row_channels):
        samples = _samples(records, fitted, (channel, wheel))
        training, held_out = (_joined(list(part)) for part in zip(*samples, strict=True))
        if not len(training.z) or not len(held_out.z):  # a channel that is not there
            continue
        terms = _selected(training, options)
        explained = _explained(held_out, terms)
        if terms and explained > 0.0:
            found.append(ResidualTerms(channel, wheel, tuple(terms), explained))
    return sorted(found, key=lambda description: -description.explained)


class _Sample(NamedTuple):
    """Standardised residuals (n,), their std (n,) [SI], and regressors (n,) by name."""

    z: Array
    std: Array
    regressors: dict[str, Array]


def _samples(
    records: Sequence[Record], fitted: FittedModel, channel: tuple[str, str]
) -> Iterator[tuple[_Sample, _Sample]]:
    """Training and held-out sample of one channel of a wheel, for each recording that has it."""
    for record, fit, check in zip(records, fitted.fits, fitted.checks, strict=True):
        if channel not in record.training.row_channels:
            continue
        column = record.training.row_channels.index(channel)
        training = record.training.with_effects(fitted.effects, fitted.free)
        yield (
            _sample(training, fit.optimum.at, fit.optimum.latents, column),
            _sample(check.problem, check.at, check.latents, column),
        )


def _sample(problem: ObservationModelWithEffects, at: Linearisation, latents: Latents, column: int) -> _Sample:
    """Residuals of one column with the regressors of its wheels, their means where it has several."""
    z, _ = problem.standardised(at)
    r, own = problem.rig.radius, problem.row_wheels[column]
    known = np.isfinite(z[:, column])
    raw = at.rows[:, 0].reshape(z.shape)[:, column]
    scale = np.abs(raw[known]).sum() / max(float(np.abs(z[known, column]).sum()), 1e-12)
    slip = 1.0 - latents.ground_speed[:, None] / (r * latents.speed)
    wheels = {"slip": slip, "load": latents.load / latents.load.mean(0), "sinkage": sinkage(latents.entry_angle, r)}
    by = {name: v[:, own].mean(1) for name, v in wheels.items()}
    by["sinkage"] = by["sinkage"] / by["sinkage"].mean()
    by["load"] = by["load"] - 1.0
    by["speed"] = latents.ground_speed / latents.ground_speed.mean() - 1.0
    by["time"] = problem.since / max(problem.duration, 1e-9)
    by["acceleration"] = problem.acceleration
    by["draft"] = problem.draft / max(float(np.abs(problem.draft).mean()), 1e-9)
    products = {f"{a} {b}": by[a] * by[b] for a, b in (("slip", "slip"), ("slip", "load"), ("slip", "speed"))}
    angle = problem.wheel_angle[:, own].mean(1)
    waves = {f"{f.__name__}({k} wheel angle)": f(k * angle) for k in (1, 2) for f in (np.sin, np.cos)}
    regressors = {"1": np.ones(len(z))} | by | products | waves
    return _Sample(z[known, column], np.full(int(known.sum()), scale), {n: v[known] for n, v in regressors.items()})


def _joined(parts: list[_Sample]) -> _Sample:
    names = parts[0].regressors
    return _Sample(
        np.concatenate([p.z for p in parts]),
        np.concatenate([p.std for p in parts]),
        {name: np.concatenate([p.regressors[name] for p in parts]) for name in names},
    )


def _selected(sample: _Sample, options: DiagnosisOptions) -> list[Term]:
    """Terms by forward selection while BIC, with the choice among candidates counted, falls."""
    chosen: list[str] = []
    chi2, n = float(sample.z @ sample.z), len(sample.z)
    while len(chosen) < options.max_effects and n > options.min_sample:
        trials = {name: _chi2_after(sample, [*chosen, name]) for name in sample.regressors if name not in chosen}
        best = min(trials, key=lambda name: trials[name])
        if chi2 - trials[best] < 2.0 * math.log(n) + 2.0 * math.log(len(trials)):
            break
        chosen.append(best)
        chi2 = trials[best]
    return [Term(n, float(c)) for n, c in zip(chosen, _solution(sample, chosen), strict=True)] if chosen else []


def _design(sample: _Sample, names: list[str]) -> Array:
    """Regressors (n, K) over the residuals' std."""
    return np.column_stack([sample.regressors[name] / sample.std for name in names])


def _solution(sample: _Sample, names: list[str]) -> Array:
    """Least-squares coefficients (K,) [SI]."""
    return np.asarray(np.linalg.lstsq(_design(sample, names), sample.z, rcond=None)[0])


def _chi2_after(sample: _Sample, names: list[str]) -> float:
    """Chi-square that the terms leave, fitted to this sample."""
    rest = sample.z - _design(sample, names) @ _solution(sample, names)
    return float(rest @ rest)


def _explained(sample: _Sample, terms: list[Term]) -> float:
    """Share of the excess of chi-square over noise that terms fitted to another sample explain in this one."""
    if not terms:
        return 0.0
    before = float(sample.z @ sample.z)
    rest = sample.z - _design(sample, [t.regressor for t in terms]) @ np.array([t.coefficient for t in terms])
    return (before - float(rest @ rest)) / max(before - len(sample.z), 1e-9) if before > len(sample.z) else 0.0
