"""A model with some effects, fitted to the recordings of one vehicle.

The vehicle's gain errors and the parameters of its effects are the same in all recordings;
the soil is each recording's own, and so is what an effect says of one record only.  So one
recording after the other is fitted, each with what those before it told of gains and
effects; the evidences of the parts add up to that of the whole, as do those of the blocks
learned from and of the blocks held out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from soilbus.arrays import Array
from soilbus.diagnosis.damped_descent import descended
from soilbus.diagnosis.evidence import OwnParameters, correction, own_parameters
from soilbus.diagnosis.records import Record
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.multistart import DEFAULT_OPTIONS, DescentOptions, Fit, Start, fit_from, fit_window
from soilbus.estimation.nuisance_parameters import Free, parameters_of
from soilbus.estimation.observation_model import Latents, Linearisation, ObservationModelWithEffects
from soilbus.estimation.parametrization import at_bounds
from soilbus.estimation.posterior import PARAMETERS, Estimate, SoilPrior
from soilbus.estimation.solver import Iterate, Objective
from soilbus.terra.effects.effect import Effect
from soilbus.terra.wheel import Soil

_SOIL = len(PARAMETERS)
CHECK_ROUNDS, CHECK_AGAIN = 3, 2
"""Linearisations that bring the latents of held-out blocks to their values under a model: from what was measured,
and from what they were under a model much like it."""


@dataclass(frozen=True, slots=True)
class Checked:
    """Held-out blocks of one recording under a fitted model: the problem, its latents and residuals there.

    chi2 weighs the residuals by what the fit leaves open of soil, gains and effects besides
    the noise: with a dozen rows learned from that is no less than the noise itself.
    """

    problem: ObservationModelWithEffects
    latents: Latents
    at: Linearisation
    neg2_log_evidence: float
    chi2: float

    @property
    def rows(self) -> int:
        """Residuals that count."""
        return self.problem.n_rows


@dataclass(frozen=True, slots=True)
class FittedModel:
    """A model with effects as fitted: one Fit and one Checked for each recording.

    free are the parameters as fitted, those held at the edge of their ranges without a
    deviation; beforehand the same as nothing was held yet.  before holds what was known when
    each recording's turn came; reported are parameters by effect and name whose posterior is no
    Gaussian about the fit; sizes what it changes of the evidence that nobody knows how
    great effects are (see `sizes`).
    """

    effects: tuple[Effect, ...]
    free: tuple[Free, ...]
    beforehand: tuple[Free, ...]
    joint_prior: tuple[Gaussian, ...]
    fits: tuple[Fit, ...]
    checks: tuple[Checked, ...]
    sizes: float = 0.0
    reported: Mapping[tuple[str, str], Estimate] = field(default_factory=dict)

    @property
    def neg2_log_evidence(self) -> float:
        """-2 log of the likelihood of all data, whatever soils, gains and parameters may be, up to a constant."""
        return sum(fit.neg2_log_evidence for fit in self.fits) + self.predicted + self.sizes

    def foreseen(self, rows: int) -> float:
        """The evidence from so many residuals like these: what the model leaves of them grows with them alone."""
        left = self.neg2_log_posterior + self.gap * self.checked_rows
        return self.neg2_log_evidence + (rows / self.rows - 1.0) * left

    @property
    def predicted(self) -> float:
        """-2 log of the likelihood of the held-out blocks after the others, up to the same."""
        return sum(check.neg2_log_evidence for check in self.checks)

    @property
    def neg2_log_posterior(self) -> float:
        """-2 log posterior of what was learned from, up to a constant."""
        return sum(fit.neg2_log_posterior for fit in self.fits)

    @property
    def gap(self) -> float:
        """Reduced chi-square of the held-out blocks."""
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
        """Whether every fit ended at its optimum."""
        return all(fit.converged for fit in self.fits)

    def as_starts(self, effects: Sequence[Effect] | None = None) -> tuple[Start, ...]:
        """Where these fits ended, for fits that hold nothing yet; of other effects those they had not are absent."""
        starts = [_start(fit, check.latents) for fit, check in zip(self.fits, self.checks, strict=True)]
        problem = self.checks[0].problem
        told = self.effects if effects is None else effects
        return tuple(s._replace(gains=self._of_effects(self.unheld(s.gains), told, problem.n_wheels)) for s in starts)

    def _of_effects(self, gains: Array, effects: Sequence[Effect], n_wheels: int) -> Array:
        """Gains (G,) of the sensors and of these effects."""
        n_sensors = len(gains) - len(self.free)
        parts = [gains[:n_sensors]]
        for effect in effects:
            own = [n_sensors + i for i, f in enumerate(self.free) if f.effect == effect.name]
            parts.append(gains[own] if own else np.zeros(len(parameters_of(effect, n_wheels))))
        return np.concatenate(parts)

    def unheld(self, gains: Array) -> Array:
        """Gains (G,) of these fits by the prior deviations that the parameters have beforehand."""
        n_sensors = len(gains) - len(self.free)
        pulls = [
            first.pull_at(f.at(u)) if f.std < first.std else u
            for f, first, u in zip(self.free, self.beforehand, gains[n_sensors:].tolist(), strict=True)
        ]
        return np.concatenate([gains[:n_sensors], pulls])

    def further_parameters(self, effect: Effect, times: float = 1.0) -> tuple[OwnParameters, ...]:
        """What each recording after the first tells of its own values of an effect of the record.

        As of so many times the data.  A zero that wanders in each recording is not meant: without a wander it is
        the same effect.
        """
        own = [i for i in _members(effect, self.free) if effect.own_in_each_record(self.free[i].parameter)]
        if not own or not effect.of_record:
            return ()
        n_sensors, free = self.checks[0].problem.n_sensors, [self.free[i] for i in own]
        return tuple(own_parameters(*_of_parameters(fit, n_sensors, own), free, times) for fit in self.fits[1:])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(effect.name for effect in self.effects)

    def parameters(self) -> dict[str, dict[str, Estimate]]:
        """Value and std of each parameter by effect, as the last recording leaves them; wheels' own as name_WHEEL."""
        gaussian, problem = self.fits[-1].mode, self.checks[-1].problem
        std = np.sqrt(np.diag(gaussian.covariance))[_SOIL + problem.n_sensors :]
        out: dict[str, dict[str, Estimate]] = {name: {} for name in self.names}
        for free, pull, spread in zip(
            self.free, gaussian.gains[problem.n_sensors :].tolist(), std.tolist(), strict=True
        ):
            name = free.parameter.name + ("" if free.wheel is None else f"_{problem.rig.wheels[free.wheel]}")
            out[free.effect][name] = Estimate(free.at(pull), free.std * spread)
        for (effect, name), estimate in self.reported.items():
            out[effect][name] = estimate
        return out


def fit_model(
    records: Sequence[Record],
    prior: SoilPrior,
    effects: Sequence[Effect],
    starts: Sequence[Start] | None = None,
    effort: DescentOptions = DEFAULT_OPTIONS,
) -> FittedModel | None:
    """A model with these effects fitted to all recordings; None where a fit fails, or is given up.

    Parameters of effects that the records' model has already keep the prior they have
    there; one that would leave its range is held at the edge.
    """
    present = records[0].learned
    known = {e.name: [f for f in present.free if f.effect == e.name] for e in present.effects}
    beforehand = tuple(
        f for effect in effects for f in known.get(effect.name) or parameters_of(effect, present.n_wheels)
    )
    free = beforehand
    near = None if starts is None else [start.checked for start in starts]
    fitted = _fits(records, prior, effects, free, starts, effort)
    for _ in range(len(free)):
        inside = (
            None if fitted is None else _held_at_edges(records[0].learned.completed(effects, free), fitted[1], free)
        )
        if fitted is None or inside is None:
            break
        free, starts = inside, [_start(fit) for fit in fitted[1]]
        fitted = _fits(records, prior, effects, free, starts, effort)
    if fitted is None:
        return None
    joint_priors, fits = fitted
    checks = [
        check(record.checked.completed(effects, free), prior, fit, None if near is None else near[i])
        for i, (record, fit) in enumerate(zip(records, fits, strict=True))
    ]
    added = [effect for effect in effects if effect not in present.effects]
    sizes = sum(_sizes(effect, free, fits, checks) for effect in added)
    return FittedModel(tuple(effects), free, beforehand, tuple(joint_priors), tuple(fits), tuple(checks), sizes)


def _fits(
    records: Sequence[Record],
    prior: SoilPrior,
    effects: Sequence[Effect],
    free: tuple[Free, ...],
    starts: Sequence[Start] | None,
    effort: DescentOptions,
) -> tuple[list[Gaussian], list[Fit]] | None:
    """What was known before each recording, and its fit."""
    joint_priors: list[Gaussian] = []
    fits: list[Fit] = []
    for i, record in enumerate(records):
        problem = record.learned.completed(effects, free)
        joint_prior = _of_next(fits[-1].mode, prior, problem, effects) if fits else _of_first(record, prior, problem)
        fit = _fitted(problem, prior, joint_prior, None if starts is None else starts[i], effort)
        if fit is None:
            return None
        joint_priors.append(joint_prior)
        fits.append(fit)
    return joint_priors, fits


def _held_at_edges(
    problem: ObservationModelWithEffects, fits: Sequence[Fit], free: tuple[Free, ...]
) -> tuple[Free, ...] | None:
    """The parameters with those held that would leave their range; None where none would, or fits did not converge."""
    gains = fits[-1].mode.gains
    edges = at_bounds(gains, *problem.gain_bounds())[problem.n_sensors :].tolist()
    leaves = [f.std > 0.0 and edge != 0.0 for f, edge in zip(free, edges, strict=True)]
    if not any(leaves) or not all(fit.converged for fit in fits):
        return None
    pulls = gains[problem.n_sensors :].tolist()
    return tuple(
        replace(f, value=f.at(u), std=0.0) if leaving else f for f, u, leaving in zip(free, pulls, leaves, strict=True)
    )


def _start(fit: Fit, checked: Latents | None = None) -> Start:
    """Where a fit ended."""
    if not fit.converged:
        return Start(fit.mode.soil, fit.mode.gains)
    return Start(fit.mode.soil, fit.mode.gains, True, fit.optimum.latents, checked)


def _sizes(effect: Effect, free: Sequence[Free], fits: Sequence[Fit], checks: Sequence[Checked]) -> float:
    """Correction of the evidence for one effect of unknown size: once, or for each recording where it is its own.

    What all recordings share of it counts with the last one, which knows what all of them told.
    """
    n_sensors, told = checks[0].problem.n_sensors, 0.0
    for fit in fits if effect.of_record else fits[-1:]:
        members = [f for f in _members(effect, free) if fit is fits[-1] or effect.own_in_each_record(free[f].parameter)]
        if members:
            told += correction(*_of_parameters(fit, n_sensors, members), [free[i] for i in members])
    return told


def _members(effect: Effect, free: Sequence[Free]) -> list[int]:
    """Places of an effect's parameters that are not held."""
    return [i for i, f in enumerate(free) if f.effect == effect.name and f.std > 0.0]


def _of_parameters(fit: Fit, n_sensors: int, members: Sequence[int]) -> tuple[Array, Array]:
    """Pulls (P,) and covariance (P, P) of some of the effects' parameters."""
    gains = n_sensors + np.array(members)
    return fit.mode.gains[gains], fit.mode.covariance[np.ix_(_SOIL + gains, _SOIL + gains)]


def _of_first(record: Record, prior: SoilPrior, problem: ObservationModelWithEffects) -> Gaussian:
    """What is known before the first recording; nothing yet of effects that its model had not."""
    joint_prior = Gaussian.of(prior, problem.gain_std)
    if record.known is None:
        return joint_prior
    gains, covariance = joint_prior.gains.copy(), joint_prior.covariance.copy()
    n = len(record.known.gains)
    gains[:n], covariance[: _SOIL + n, : _SOIL + n] = record.known.gains, record.known.covariance
    return Gaussian(record.known.soil, gains, covariance)


def _fitted(
    problem: ObservationModelWithEffects,
    prior: SoilPrior,
    joint_prior: Gaussian,
    start: Start | None,
    effort: DescentOptions,
) -> Fit | None:
    """From the given start, or from anywhere; a fit that has not converged goes on from where it is, slowly."""
    if start is None:
        fit = fit_window(problem, prior, joint_prior)
        if fit is None or fit.converged:
            return fit
        start = Start(fit.mode.soil, fit.mode.gains)
    fit = fit_from(problem, prior, joint_prior, start, problem.n_sensors, effort)
    if fit is None or fit.converged:
        return fit
    slow = descended(Objective(problem, prior, joint_prior), fit, effort)
    return None if (slow or fit).neg2_log_posterior > effort.give_up_above else slow or fit


def _of_next(
    known: Gaussian, prior: SoilPrior, problem: ObservationModelWithEffects, effects: Sequence[Effect]
) -> Gaussian:
    """What one recording tells of the next: all but the soil and what belongs to one recording only."""
    after = known.with_prior_soil(prior)
    by_name = {effect.name: effect for effect in effects}
    gone = [
        problem.n_sensors + i
        for i, free in enumerate(problem.free)
        if by_name[free.effect].own_in_each_record(free.parameter)
    ]
    gains, covariance = after.gains.copy(), after.covariance.copy()
    for i in gone:
        covariance[_SOIL + i] = covariance[:, _SOIL + i] = 0.0
        covariance[_SOIL + i, _SOIL + i] = problem.gain_std[i] ** 2
        gains[i] = 0.0
    return Gaussian(after.soil, gains, covariance)


def check(problem: ObservationModelWithEffects, prior: SoilPrior, fit: Fit, near: Latents | None = None) -> Checked:
    """Held-out blocks under a model fitted to the others; near are their latents under a model much like it."""
    soil, gains = Soil(*fit.mode.soil.tolist()), fit.mode.gains
    fitting = Objective(problem, prior, fit.mode)
    rounds = CHECK_ROUNDS if near is None or len(near.load) != problem.n else CHECK_AGAIN
    with np.errstate(all="ignore"):
        latents = fitting.start_near(fit.mode.soil, gains, near).latents
        latents = problem.with_entry_angles(latents, soil, gains)
        at = problem.linearise(soil, gains, latents)
        for _ in range(rounds - 1):
            latents = problem.updated(at, latents, np.zeros(_SOIL), np.zeros(len(gains)))
            at = problem.linearise(soil, gains, latents)
        point = fitting.with_prior(Iterate(fit.mode.soil, gains, latents, np.inf, 0), at)
        step = None if point is None else point.step()
    if point is None or step is None:
        return Checked(problem, latents, at, np.inf, np.inf)
    length = point.squared_length(step)
    return Checked(problem, latents, at, point.neg2_log_evidence - length, point.neg2_log_posterior - length)
