"""A model with effects, fitted to the recordings of one vehicle.

    score = sum over recordings and blocks of -2 log p(block | all other blocks)        (`blocks`)

Sensor gain errors and parameters of effects belong to the vehicle and are the same in all recordings.  The soil
belongs to a recording, and so do the parameters of an effect of the record (see terra.effects.effect).  `joint_fit`
finds the optimum of all recordings together.  FittedModel.held_out_chi2, the reduced chi-square of the held-out
blocks, says how well the model predicts data that it was not fitted to; `gap` compares it with what the sensors' noise
alone leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.diagnosis.blocks import BlockScores, Part, block_scores
from soilbus.diagnosis.joint_fit import Start, fit_jointly, own_gains, priors_of
from soilbus.diagnosis.options import DEFAULT, DiagnosisOptions
from soilbus.diagnosis.records import Record
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.linearisation import RESIDUAL, Latents, Linearisation
from soilbus.estimation.multistart import Fit
from soilbus.estimation.nuisance_parameters import Free, parameters_of
from soilbus.estimation.observation_with_effects import ObservationModelWithEffects
from soilbus.estimation.options import SolverOptions
from soilbus.estimation.parametrization import at_bounds
from soilbus.estimation.posterior import PARAMETERS, Estimate, SoilPrior
from soilbus.estimation.solver import Iterate, Objective
from soilbus.terra.effects.effect import Effect
from soilbus.terra.wheel import Soil

_SOIL = len(PARAMETERS)


@dataclass(frozen=True, slots=True)
class HeldOutCheck:
    """Held-out blocks of one recording under a fitted model: the problem, its latents and the linearisation there.

    chi2 is the weighed square of the residuals, with what the fit leaves uncertain of soil, gains and effects besides
    the noise: with a dozen training rows that is no less than the noise itself.
    """

    problem: ObservationModelWithEffects
    latents: Latents
    at: Linearisation
    chi2: float

    @property
    def rows(self) -> int:
        """Residuals that count."""
        return self.problem.n_rows


class Series(NamedTuple):
    """Held-out readings of one channel beside the model's, in SI, each (M,).

    Attributes
    ----------
    channel, wheel
        torque, draft or sinkage, and wheel or axle; empty for a channel of the vehicle.
    measured, modelled
        The reading, and the reading less the residual: what the model and the other sensors make of it.
    standardised
        The residual given the others of its instant, over its sd; standard normal where nothing is missing.
    slip, load, speed, since
        Of the wheel, of a channel of the vehicle the mean over its wheels; load [N], ground speed [m/s], time [s].
    """

    channel: str
    wheel: str
    measured: Array
    modelled: Array
    standardised: Array
    slip: Array
    load: Array
    speed: Array
    since: Array


class SizeLikelihood(NamedTuple):
    """Likelihood of an effect's parameters (P,) about their neutral values, Gaussian around a fit.

    Attributes
    ----------
    information : (P, P)
        In units of the prior std.
    vector : (P,)
        Gradient of the log likelihood where the effect is absent.
    free
        The parameters.
    """

    information: Array
    vector: Array
    free: tuple[Free, ...]


@dataclass(frozen=True, slots=True)
class FittedModel:
    """A model with effects as fitted: one Fit (training blocks) and one HeldOutCheck for each recording.

    Attributes
    ----------
    effects
        Those of the model.
    free
        Parameters of the effects; one that is held at the edge of its range has std 0.
    free_unheld
        The same before any was held.
    priors
        Of soil, gains and parameters of each recording, with its part of the prior of what all share.
    fits, checks
        Of each recording.
    blocks
        Scores of all blocks of all recordings, in the order of these.
    """

    effects: tuple[Effect, ...]
    free: tuple[Free, ...]
    free_unheld: tuple[Free, ...]
    priors: tuple[Gaussian, ...]
    fits: tuple[Fit, ...]
    checks: tuple[HeldOutCheck, ...]
    blocks: BlockScores

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(effect.name for effect in self.effects)

    @property
    def at_limits(self) -> tuple[Free, ...]:
        """Sizes, which are zero where their effect is absent, that are held at the edge of their range."""
        of_edge = (f for f in self.free if f.std == 0.0 and f.value in (f.parameter.low, f.parameter.high))
        return tuple(f for f in of_edge if f.parameter.neutral == 0.0 and f.value != 0.0)

    @property
    def held(self) -> dict[str, list[str]]:
        """Parameters by effect that the prior holds; without those that it cannot free, each recording's own."""
        by_name, out = {effect.name: effect for effect in self.effects}, dict[str, list[str]]()
        for f in self.free_unheld:
            names = out.setdefault(f.effect, [])
            if f.std == 0.0 and f.parameter.name not in names and not by_name[f.effect].own_in_each_record(f.parameter):
                names.append(f.parameter.name)
        return {effect: names for effect, names in out.items() if names}

    @property
    def score(self) -> float:
        """-2 log predictive likelihood of all blocks, each given the others, up to a constant."""
        score = float(self.blocks.neg2_log.sum())
        return score if np.isfinite(score) else np.inf

    @property
    def neg2_log_posterior(self) -> float:
        """-2 log posterior of the training blocks at the optimum, up to a constant."""
        return sum(fit.neg2_log_posterior for fit in self.fits)

    @property
    def held_out_chi2(self) -> float:
        """Reduced chi-square of the held-out blocks, by the covariance that has what computed loads leave open too."""
        return sum(check.chi2 for check in self.checks) / max(self.checked_rows, 1)

    @property
    def checked_rows(self) -> int:
        """Residuals of the held-out blocks."""
        return sum(check.rows for check in self.checks)

    @property
    def rows(self) -> int:
        """Residuals of all blocks."""
        return self.checked_rows + sum(fit.rows for fit in self.fits)

    @property
    def converged(self) -> bool:
        """Whether the fit of every recording ended at an optimum."""
        return all(fit.converged for fit in self.fits)

    def parameters(self) -> dict[str, dict[str, Estimate]]:
        """Value and std of each parameter by effect, after the last recording; a wheel's own is named name_WHEEL."""
        gaussian, problem = self.fits[-1].mode, self.checks[-1].problem
        std = np.sqrt(np.diag(gaussian.covariance))[_SOIL + problem.n_sensors :]
        out: dict[str, dict[str, Estimate]] = {name: {} for name in self.names}
        for free, name, standardised, spread in zip(
            self.free, self.parameter_names(), gaussian.gains[problem.n_sensors :].tolist(), std.tolist(), strict=True
        ):
            out[free.effect][name] = Estimate(free.at(standardised), free.std * spread)
        return out

    def prior_parameters(self) -> dict[str, dict[str, Estimate]]:
        """The same before any recording; the std of one that is held is 0."""
        out: dict[str, dict[str, Estimate]] = {name: {} for name in self.names}
        for free, name in zip(self.free_unheld, self.parameter_names(), strict=True):
            out[free.effect][name] = Estimate(free.value, free.std)
        return out

    def parameter_names(self) -> list[str]:
        """Name of each of `free`; a wheel's own is named name_WHEEL."""
        wheels = self.checks[-1].problem.rig.wheels
        return [f.parameter.name + ("" if f.wheel is None else f"_{wheels[f.wheel]}") for f in self.free]

    def as_starts(self, effects: Sequence[Effect] | None = None) -> tuple[Start, ...]:
        """A start at each optimum, for fits in which no parameter is held yet.

        With `effects`, for a model with these effects; those that this model has not start absent.
        """
        starts = [_start(fit, check.latents) for fit, check in zip(self.fits, self.checks, strict=True)]
        n_wheels = self.checks[0].problem.n_wheels
        wanted = self.effects if effects is None else effects
        return tuple(s._replace(gains=self._of_effects(self.unheld(s.gains), wanted, n_wheels)) for s in starts)

    def _of_effects(self, gains: Array, effects: Sequence[Effect], n_wheels: int) -> Array:
        """Sensor gains and standardised parameters (G,) of these effects."""
        n_sensors = len(gains) - len(self.free)
        parts = [gains[:n_sensors]]
        for effect in effects:
            own = [n_sensors + i for i, f in enumerate(self.free) if f.effect == effect.name]
            parts.append(gains[own] if own else np.zeros(len(parameters_of(effect, n_wheels))))
        return np.concatenate(parts)

    def unheld(self, gains: Array) -> Array:
        """Sensor gains and parameters (G,) of these fits, standardised by the priors before any was held."""
        n_sensors = len(gains) - len(self.free)
        standardised = [
            first.standardised(f.at(u)) if f.std < first.std else u
            for f, first, u in zip(self.free, self.free_unheld, gains[n_sensors:].tolist(), strict=True)
        ]
        return np.concatenate([gains[:n_sensors], standardised])

    def held_out_series(self) -> list[Series]:
        """The held-out readings of each channel and wheel beside the model's, over all recordings.

        Channels without a held-out reading are left out.
        """
        parts: dict[tuple[str, str], list[Series]] = {}
        for held_out, fit in zip(self.checks, self.fits, strict=True):
            for series in _series(held_out, fit):
                parts.setdefault((series.channel, series.wheel), []).append(series)
        return [
            Series(*name, *(np.concatenate(columns) for columns in zip(*(part[2:] for part in of), strict=True)))
            for name, of in parts.items()
        ]

    def size_likelihood(self, effect: Effect) -> SizeLikelihood:
        """Likelihood, by all recordings, of an effect's parameters that are the vehicle's; without held ones."""
        own = [i for i, f in enumerate(self.free) if f.effect == effect.name and f.std > 0.0]
        shared = [i for i in own if not effect.own_in_each_record(self.free[i].parameter)]
        at, mode = self.checks[0].problem.n_sensors + np.array(shared, int), self.fits[-1].mode
        precision = np.linalg.inv(mode.covariance[np.ix_(_SOIL + at, _SOIL + at)])
        information, vector = precision - np.eye(len(at)), precision @ mode.gains[at]
        return SizeLikelihood(information, vector, tuple(self.free[i] for i in shared))


def _series(held_out: HeldOutCheck, fit: Fit) -> list[Series]:
    """The readings of one recording by channel and wheel."""
    problem, latents = held_out.problem, held_out.latents
    standardised, _ = problem.standardised(held_out.at)
    measured = problem.readings
    modelled = measured - held_out.at.rows[:, RESIDUAL].reshape(measured.shape)
    slip = 1.0 - latents.ground_speed[:, None] / (problem.rig.radius * latents.speed)
    found = []
    for i, ((channel, wheel), wheels) in enumerate(zip(problem.row_channels, problem.row_wheels, strict=True)):
        known = np.isfinite(standardised[:, i])
        of_slip, of_load = (values[:, wheels].mean(1) for values in (slip, latents.load))
        of_row = measured[:, i], modelled[:, i], standardised[:, i]
        columns = *of_row, of_slip, of_load, latents.ground_speed, problem.since
        if known.any():
            found.append(Series(channel, wheel, *(column[known] for column in columns)))
    return found


def fit_model(
    records: Sequence[Record],
    prior: SoilPrior,
    effects: Sequence[Effect],
    starts: Sequence[Start] | None = None,
    options: SolverOptions | None = None,
) -> FittedModel | None:
    """A model with these effects fitted to all recordings.

    Parameters
    ----------
    records
        Recordings of one vehicle.
    prior
        Of the soil, the same for each recording.
    effects
        Those that the records' model has already keep the prior that their parameters have there.
    starts
        One for each recording; None searches from several.
    options
        When a descent stops or is given up; by default as DiagnosisOptions says.

    Returns
    -------
    FittedModel or None
        None where a fit fails or is given up.  A parameter that would leave its range is held at the edge.
    """
    present = records[0].training
    options = records[0].options.compared if options is None else options
    known = {e.name: [f for f in present.free if f.effect == e.name] for e in present.effects}
    free = free_unheld = tuple(f for e in effects for f in known.get(e.name) or parameters_of(e, present.n_wheels))
    near = [None] * len(records) if starts is None else [start.checked for start in starts]
    fitted = _fits(records, prior, effects, free, starts, options)
    for _ in range(len(free)):
        if fitted is None or (held := _held_at_edges(present.with_effects(effects, free), fitted[1], free)) is None:
            break
        free, starts = held, [_start(fit) for fit in fitted[1]]
        fitted = _fits(records, prior, effects, free, starts, options)
    if fitted is None:
        return None
    priors, fits = fitted
    checks = [
        check(record.held_out.with_effects(effects, free), prior, fit, latents, record.options)
        for record, fit, latents in zip(records, fits, near, strict=True)
    ]
    parts = [
        _parts(record, record.training.with_effects(effects, free), fit, held_out)
        for record, fit, held_out in zip(records, fits, checks, strict=True)
    ]
    n_sensors = records[0].training.n_sensors
    own = own_gains(n_sensors, effects, free)
    with np.errstate(all="ignore"):
        blocks = block_scores(parts, priors, [fit.mode for fit in fits], own, n_sensors, options=records[0].options)
    return FittedModel(tuple(effects), free, free_unheld, priors, tuple(fits), tuple(checks), blocks)


def _parts(
    record: Record, training: ObservationModelWithEffects, fit: Fit, held_out: HeldOutCheck
) -> tuple[Part, Part]:
    """The training blocks and the held-out blocks of a recording, linearised where it was fitted."""
    problem, number, end, mode = held_out.problem, record.block_numbers, fit.optimum, fit.mode
    return (
        Part(end.soil, end.gains, end.at, number(training, False), training.known),
        Part(mode.soil, mode.gains, held_out.at, number(problem, True), problem.known),
    )


def check(
    problem: ObservationModelWithEffects,
    prior: SoilPrior,
    fit: Fit,
    near: Latents | None = None,
    options: DiagnosisOptions = DEFAULT,
) -> HeldOutCheck:
    """Held-out blocks under a model fitted to the others.

    near: their latents under a model much like it.  chi2 is infinite where the model is not finite.
    """
    soil, gains = Soil(*fit.mode.soil.tolist()), fit.mode.gains
    objective = Objective(problem, prior, fit.mode)
    with np.errstate(all="ignore"):
        latents = objective.start(fit.mode.soil, gains, near).latents
        latents = problem.with_entry_angles(latents, soil, gains)
        at = problem.linearise(soil, gains, latents)
        for _ in range(options.check_rounds - 1):
            latents = problem.updated(at, latents, np.zeros(_SOIL), np.zeros(len(gains)))
            at = problem.linearise(soil, gains, latents)
        quadratic = objective.with_prior(Iterate(fit.mode.soil, gains, latents), at)
        step = None if quadratic is None else quadratic.step()
    if quadratic is None or step is None:
        return HeldOutCheck(problem, latents, at, np.inf)
    return HeldOutCheck(problem, latents, at, quadratic.neg2_log_posterior - quadratic.squared_length(step))


def _fits(
    records: Sequence[Record],
    prior: SoilPrior,
    effects: Sequence[Effect],
    free: tuple[Free, ...],
    starts: Sequence[Start] | None,
    options: SolverOptions,
) -> tuple[tuple[Gaussian, ...], list[Fit]] | None:
    """The prior of each recording, and its fit; None where one fails."""
    problems = [record.training.with_effects(effects, free) for record in records]
    own = own_gains(problems[0].n_sensors, effects, free)
    priors = priors_of(problems, prior, own, records[0].joint_prior)
    fits = fit_jointly(problems, prior, priors, own, starts, options)
    return None if fits is None else (priors, fits)


def _held_at_edges(
    problem: ObservationModelWithEffects, fits: Sequence[Fit], free: tuple[Free, ...]
) -> tuple[Free, ...] | None:
    """The parameters with those held that would leave their range; None where none would, or fits did not converge."""
    gains = fits[-1].mode.gains
    edges = at_bounds(gains, *problem.gain_bounds)[problem.n_sensors :].tolist()
    leaves = [f.std > 0.0 and edge != 0.0 for f, edge in zip(free, edges, strict=True)]
    if not any(leaves) or not all(fit.converged for fit in fits):
        return None
    return tuple(
        replace(f, value=f.parameter.high if edge > 0.0 else f.parameter.low, std=0.0) if leaving else f
        for f, edge, leaving in zip(free, edges, leaves, strict=True)
    )


def _start(fit: Fit, held_out: Latents | None = None) -> Start:
    """A start where a fit ended, with its latents."""
    return Start(fit.mode.soil, fit.mode.gains, True, fit.optimum.latents, held_out)
