"""How late a channel is: joint posterior of the dead time d and the time constant tau of its low pass.

    p(d, tau) ~ exp(-cost(d, tau) / 2),  cost = squared prior terms + sum over recordings of min -2 log posterior
    E[x] = integral over tau and d + tau of  exp(-cost / 2) x            on a grid along the ridge

Evenly driven recordings determine the sum d + tau well and its parts hardly: the effect of tau beyond the sum goes
with tau^2.  The likelihood is a curved ridge, of which a Gaussian at the top is too wide where tau is 0 and too narrow
elsewhere.  So -2 log posterior, minimised over soil, gains and other effects (in which it is taken as quadratic about
the fit), is followed along the ridge and integrated numerically about it: curves through samples make it uneven over
a sample time, so that its local curvature says little.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import softmax

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.joint_fit import JointObjective, Start, own_gains
from soilbus.diagnosis.options import DiagnosisOptions
from soilbus.diagnosis.records import Record
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.multistart import Fit
from soilbus.estimation.nuisance_parameters import Free
from soilbus.estimation.observation_model import inverse_covariance
from soilbus.estimation.posterior import PARAMETERS, Estimate, SoilPrior
from soilbus.estimation.solver import Iterate, Objective
from soilbus.terra.effects.effect import Effect, Late

Cost = Callable[[float, float], float]
"""-2 log posterior of dead time [s] and time constant [s]."""

_SOIL = len(PARAMETERS)


class DelayPosterior(NamedTuple):
    """Mean and sd [s] of dead time, time constant and their sum.

    best: dead time and time constant [s] of the least -2 log posterior; fall: by how much that is below the fit's.
    """

    delay: Estimate
    time_constant: Estimate
    total: Estimate
    best: tuple[float, float]
    fall: float


def with_delays(records: Sequence[Record], prior: SoilPrior, fitted: FittedModel) -> FittedModel:
    """A fitted model that reports delays by their joint posteriors.

    Fitted again from the best delays where these lower -2 log posterior by more than `negligible_fall`.

    Parameters
    ----------
    records, prior
        Those of the fit.
    fitted
        The model.
    """
    found = delay_posteriors(records, prior, fitted)
    if any(posterior.fall > records[0].options.negligible_fall for posterior in found.values()):
        better = fit_model(records, prior, fitted.effects, _starts(fitted, found))
        if better is not None and better.score < fitted.score:
            fitted, found = better, delay_posteriors(records, prior, better)
    reported: dict[tuple[str, str], Estimate] = {}
    for (name, late), posterior in found.items():
        reported |= {
            (name, late.delay): posterior.delay,
            (name, late.time_constant): posterior.time_constant,
            (name, late.total): posterior.total,
        }
    return replace(fitted, reported=reported)


def total_delays(fitted: FittedModel, effect: Effect) -> dict[str, Estimate]:
    """Return dead time and time constant together [s] of each channel that an effect delays, by the Gaussian fit."""
    mode, first = fitted.fits[-1].mode, fitted.checks[-1].problem.n_sensors
    totals = {}
    for quantity, names in effect.late.items():
        own = [i for i, f in enumerate(fitted.free) if f.effect == effect.name and f.parameter.name in names]
        value = sum(fitted.free[i].at(float(mode.gains[first + i])) for i in own)
        std, at = np.array([fitted.free[i].std for i in own]), _SOIL + first + np.array(own)
        totals[quantity] = Estimate(value, float(np.sqrt(std @ mode.covariance[np.ix_(at, at)] @ std)))
    return totals


def _starts(fitted: FittedModel, found: Mapping[tuple[str, Late], DelayPosterior]) -> list[Start]:
    """Where these fits ended, with the best delays."""
    starts = []
    n_sensors = fitted.checks[0].problem.n_sensors
    for start in fitted.as_starts():
        gains = start.gains.copy()
        for i, free in enumerate(fitted.free_unheld):
            for (name, late), posterior in found.items():
                if free.effect == name and free.parameter.name in (late.delay, late.time_constant):
                    best = posterior.best[free.parameter.name == late.time_constant]
                    gains[n_sensors + i] = free.standardised(best)
        starts.append(start._replace(gains=gains))
    return starts


def delay_posteriors(
    records: Sequence[Record], prior: SoilPrior, fitted: FittedModel
) -> dict[tuple[str, Late], DelayPosterior]:
    """The posterior of each channel that a fitted model lets be late, by effect and names of its parameters.

    Parameters as of with_delays().
    """
    found: dict[tuple[str, Late], DelayPosterior] = {}
    for effect in fitted.effects:
        for late in effect.late.values():
            names = [(f.effect, f.parameter.name) for f in fitted.free_unheld]
            at = names.index((effect.name, late.delay)), names.index((effect.name, late.time_constant))
            if all(fitted.free_unheld[i].std > 0.0 for i in at):
                found[effect.name, late] = _posterior(records, prior, fitted, at)
    return found


def _posterior(records: Sequence[Record], prior: SoilPrior, fitted: FittedModel, at: tuple[int, int]) -> DelayPosterior:
    """The posterior of the parameters at two indices (dead time, time constant)."""
    first, second = (fitted.free_unheld[i] for i in at)
    here = tuple(fitted.free[i].at(_standardised(fitted, i)) for i in at)
    profile = _Profile([_RecordProfile(record, prior, fitted, i, at) for i, record in enumerate(records)], fitted)

    def cost(delay: float, tau: float) -> float:
        of_prior = first.standardised(delay) ** 2 + second.standardised(tau) ** 2
        return of_prior + profile.cost(delay, tau)

    options, low, high = records[0].options, first.parameter.low, first.parameter.high
    most = min(second.parameter.high, max(sum(here) - low, options.delay_step) + 2.0 * options.delay_step)
    bounds, start = (low, high), (sum(here), here[1])
    nodes = 11  # over the whole range, and again over where the posterior is
    ridge = _ridge(cost, np.linspace(0.0, most, nodes), start, bounds, first.std, options)
    near = np.flatnonzero(softmax(-0.5 * ridge.cost) > 1e-3)
    begin, end = ridge.tau[max(near[0] - 1, 0)], ridge.tau[min(near[-1] + 1, nodes - 1)]
    top = int(np.argmin(ridge.cost))
    start = float(ridge.total[top]), float(ridge.tau[top])
    ridge = _ridge(cost, np.linspace(begin, end, nodes), start, bounds, first.std, options)
    best = int(np.argmin(ridge.cost))
    span = 4.0 * np.median(ridge.sd)
    total = ridge.total[:, None] + span * np.linspace(-1.0, 1.0, 17)
    tau = np.broadcast_to(ridge.tau[:, None], total.shape)
    delay = total - tau
    within = (low <= delay) & (delay <= high)
    costs = np.full(total.shape, np.inf)
    costs[within] = [cost(d, t) for d, t in zip(delay[within], tau[within], strict=True)]
    share = softmax(-0.5 * costs)
    mean_total = float((share * total).sum())
    tau_cell, sum_cell = (float(step) / np.sqrt(12.0) for step in (tau[1, 0] - tau[0, 0], total[0, 1] - total[0, 0]))

    def estimate_of(values: Array, cell: float, error: float) -> Estimate:
        mean = float((share * values).sum())
        variance = float((share * (values - mean) ** 2).sum())
        return Estimate(mean, float(np.sqrt(variance + cell**2 + (error * mean_total) ** 2)))

    return DelayPosterior(
        estimate_of(delay, np.hypot(tau_cell, sum_cell), options.error_of_parts),
        estimate_of(tau, tau_cell, options.error_of_parts),
        estimate_of(total, sum_cell, options.error_of_sum),
        (float(ridge.total[best] - ridge.tau[best]), float(ridge.tau[best])),
        cost(*here) - float(ridge.cost[best]),
    )


class _Ridge(NamedTuple):
    """At time constants (K,): the best sum [s], its sd [s], and the cost there."""

    tau: Array
    total: Array
    sd: Array
    cost: Array


def _ridge(
    cost: Cost,
    taus: Array,
    here: tuple[float, float],
    bounds: tuple[float, float],
    std: float,
    options: DiagnosisOptions,
) -> _Ridge:
    """The least cost at each time constant, over sums that leave the delay within its bounds.

    From the time constant nearest to `here` (sum, time constant) outwards, each from its neighbour's sum.
    """
    first = int(np.argmin(np.abs(taus - here[1])))
    found = np.zeros((3, len(taus)))
    for order in (range(first, len(taus)), range(first - 1, -1, -1)):
        total = here[0] if order.step > 0 else float(found[0, first])
        for i in order:
            tau = float(taus[i])
            limits = bounds[0] + tau, bounds[1] + tau
            total, found[1, i], found[2, i] = _best_sum(cost, tau, total, limits, std, options)
            found[0, i] = total
    return _Ridge(taus, *found)


def _best_sum(
    cost: Cost, tau: float, total: float, bounds: tuple[float, float], std: float, options: DiagnosisOptions
) -> tuple[float, float, float]:
    """The best sum at a time constant, its sd (at most the prior's std), and the cost there, by Newton's method."""
    step = options.delay_step
    low, high = bounds[0] + step, bounds[1] - step
    for _ in range(12):
        total = min(max(total, low), high)
        earlier, here, later = (cost(s - tau, tau) for s in (total - step, total, total + step))
        curvature, slope = (earlier + later - 2.0 * here) / step**2, (later - earlier) / (2.0 * step)
        move = -slope / curvature if curvature > 0.0 else -np.sign(slope) * np.inf
        if abs(move) <= step or not low < min(max(total + move, low), high) < high:
            break
        total += float(np.clip(move, -4.0 * step, 4.0 * step))
    curvature, move = max(curvature, 2.0 / std**2), float(np.clip(move, -step, step))
    return total + move, float(np.sqrt(2.0 / curvature)), here + slope * move + 0.5 * curvature * move**2


class _RecordProfile:
    """-2 log posterior of one recording over the lateness of one channel; all else is linear about the fit."""

    def __init__(self, record: Record, prior: SoilPrior, fitted: FittedModel, i: int, at: tuple[int, int]) -> None:
        self.fit: Fit = fitted.fits[i]
        free = tuple(fitted.free_unheld[k] if k in at else f for k, f in enumerate(fitted.free))
        self.problem = record.training.with_effects(fitted.effects, free)
        self.columns = [self.problem.n_sensors + k for k in at]
        self.free = [free[k] for k in at]
        joint_prior = _with_held(fitted.priors[i], self.columns)
        self.gains = self.fit.optimum.gains.copy()
        for f, k, column in zip(self.free, at, self.columns, strict=True):
            self.gains[column] = f.standardised(fitted.free[k].at(float(self.gains[column])))
        optimum = self.fit.optimum
        self.objective = Objective(self.problem, prior, joint_prior)
        iterate = Iterate(optimum.soil, self.gains, optimum.latents)
        quadratic = self.objective.quadratic_model(iterate)
        if quadratic is None:
            raise np.linalg.LinAlgError("the model is not finite where it was fitted")
        self.quadratic, self.directions = quadratic, self.objective.directions(iterate)
        variance, row_var = self.problem.variances(self.gains)
        self.inverse = inverse_covariance(quadratic.linearisation.by_latents, variance, row_var)
        self.torque = self.problem.torques(optimum.soil, self.gains, optimum.latents)
        self.alone = self.problem.with_effects(
            [e for e in fitted.effects if e.name == self.free[0].effect], _alone(free, at)
        )
        self.sensors = self.gains[: self.problem.n_sensors]
        self.here = self._residuals(*(f.at(float(self.gains[c])) for f, c in zip(self.free, self.columns, strict=True)))

    def _residuals(self, *values: float) -> Array:
        """Residuals that this channel alone leaves at a delay and a time constant [s]."""
        standardised = iter(f.standardised(v) for f, v in zip(self.free, values, strict=True))
        gains = np.concatenate([self.sensors, [next(standardised) if f.std else 0.0 for f in self.alone.free]])
        late = self.alone.delay_terms(gains, self.fit.optimum.latents, self.torque)
        return self.alone.delay_residuals(late, self.quadratic.linearisation.by_latents, gains)

    def change(self, delay: float, tau: float) -> tuple[float, Array]:
        """By how much a delay and a time constant [s] change -2 log posterior, and half its gradient, all else held."""
        change = self._residuals(delay, tau) - self.here
        weighed = (self.inverse @ change[:, :, None])[:, :, 0]
        at = self.quadratic.linearisation
        rise = float(2.0 * at.weighed[:, 0] @ change.ravel() + (change * weighed).sum())
        return rise, self.directions.T @ (at.rows.T @ weighed.ravel())


class _Profile:
    """-2 log posterior of all recordings over the lateness of one channel, minimised over all else."""

    def __init__(self, parts: Sequence[_RecordProfile], fitted: FittedModel) -> None:
        own = own_gains(parts[0].problem.n_sensors, fitted.effects, fitted.free)
        self.parts, self.joint = parts, JointObjective([part.objective for part in parts], own)
        self.model = self.joint.together([part.quadratic for part in parts])

    def cost(self, delay: float, tau: float) -> float:
        """-2 log posterior at a delay and a time constant [s], minimised over all else."""
        cost, gradient = self.model.neg2_log_posterior, self.model.gradient.copy()
        for part, columns in zip(self.parts, self.joint.columns, strict=True):
            rise, change = part.change(delay, tau)
            cost += rise
            gradient[columns] += change
        return cost - float(gradient @ np.linalg.solve(self.model.information, gradient))


def _alone(free: Sequence[Free], at: tuple[int, int]) -> list[Free]:
    """The parameters of one effect, of which the two at these indices may vary and the others have no influence."""
    own = [i for i, f in enumerate(free) if f.effect == free[at[0]].effect]
    return [free[i] if i in at else replace(free[i], value=0.0, std=0.0) for i in own]


def _with_held(joint_prior: Gaussian, columns: Sequence[int]) -> Gaussian:
    """A joint prior under which these gains are held: without variance."""
    covariance = joint_prior.covariance.copy()
    held = [_SOIL + c for c in columns]
    covariance[held] = covariance[:, held] = 0.0
    return Gaussian(joint_prior.soil, joint_prior.gains, covariance)


def _standardised(fitted: FittedModel, i: int) -> float:
    """The i-th effect parameter of a fitted model, in units of its prior std."""
    return float(fitted.fits[-1].mode.gains[fitted.checks[-1].problem.n_sensors + i])
