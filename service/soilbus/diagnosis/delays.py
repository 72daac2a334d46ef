"""How late a channel is: the joint posterior of its dead time d and the time constant tau of its low pass.

Evenly driven recordings tell the sum d + tau well and the parts hardly: what tau does besides goes with tau^2, so
that the likelihood is a bent ridge, and a Gaussian at its top is too wide where tau is 0 and too narrow elsewhere.
So the cost -2 log posterior, least over soil, gains and other effects (which are linear about the fit), is taken
along the ridge: at each tau a parabola over the sum, then moments over all tau (Laplace's method with one
parameter integrated outright; Tierney & Kadane 1986, J. Am. Stat. Assoc. 81:82).

Costs are tempered as the verdict's evidences are: curves of the readings leave bias and noise that are not the
model's, and a delay shares them with a low pass.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import softmax

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.verdict import temperature
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.multistart import Fit, Start
from soilbus.estimation.nuisance_parameters import Free
from soilbus.estimation.observation_model import inverse_covariance
from soilbus.estimation.posterior import PARAMETERS, Estimate, SoilPrior
from soilbus.estimation.solver import Iterate, Objective
from soilbus.terra.effects.effect import Effect, Late

Cost = Callable[[float, float], float]

_SOIL = len(PARAMETERS)
NODES = 11
"""Time constants at which the cost is taken: over all their range, and again over where the posterior is."""
STEP, ROUNDS = 0.005, 12
"""Half the span of sums [s] that a parabola goes through, and how often it is moved downhill at most."""

FORM_OF_PARTS, FORM_OF_SUM = 0.1, 0.02
"""Sd of a part and of the sum besides, as shares of the sum: what of a channel moves faster than its curve is not
shifted.  Of delays and low passes of 0.04 to 0.2 s of the second generator (tests/support/shaking.py)."""
SETTLED = 2.0
"""Fall of the tempered -2 log posterior along a ridge from which a fit is taken up again there."""


class DelayPosterior(NamedTuple):
    """Mean and sd [s] of dead time, time constant and their sum; where the cost is least, and by how much."""

    delay: Estimate
    time_constant: Estimate
    total: Estimate
    best: tuple[float, float]
    fall: float


class _Ridge(NamedTuple):
    """At time constants (K,): the likeliest sum, its sd, and the cost there."""

    tau: Array
    total: Array
    sd: Array
    cost: Array

    def weights(self) -> Array:
        """Shares (K,) of the posterior's mass."""
        edges = np.concatenate([self.tau[:1], (self.tau[1:] + self.tau[:-1]) / 2.0, self.tau[-1:]])
        return np.asarray(softmax(np.log(self.sd * np.diff(edges)) - 0.5 * self.cost))


def with_delays(records: Sequence[Record], prior: SoilPrior, fitted: FittedModel, explained: float) -> FittedModel:
    """A fitted model that tells how late channels are by their posteriors; from where the cost is least along these.

    explained: fall of -2 log evidence by its effects.
    """
    found = delay_posteriors(records, prior, fitted, explained)
    if any(posterior.fall > SETTLED * temperature(explained) for posterior in found.values()):
        better = fit_model(records, prior, fitted.effects, _starts(fitted, found))
        if better is not None and better.neg2_log_evidence < fitted.neg2_log_evidence:
            fitted, found = better, delay_posteriors(records, prior, better, explained)
    reported: dict[tuple[str, str], Estimate] = {}
    for (name, late), posterior in found.items():
        reported |= {
            (name, late.delay): posterior.delay,
            (name, late.time_constant): posterior.time_constant,
            (name, late.total): posterior.total,
        }
    return replace(fitted, reported=reported)


def _starts(fitted: FittedModel, found: Mapping[tuple[str, Late], DelayPosterior]) -> list[Start]:
    """Where these fits ended, with channels as late as is likeliest."""
    starts = []
    n_sensors = fitted.checks[0].problem.n_sensors
    for start in fitted.as_starts():
        gains = start.gains.copy()
        for i, free in enumerate(fitted.beforehand):
            for (name, late), posterior in found.items():
                if free.effect == name and free.parameter.name in (late.delay, late.time_constant):
                    best = posterior.best[free.parameter.name == late.time_constant]
                    gains[n_sensors + i] = free.pull_at(best)
        starts.append(start._replace(gains=gains))
    return starts


def delay_posteriors(
    records: Sequence[Record], prior: SoilPrior, fitted: FittedModel, explained: float
) -> dict[tuple[str, Late], DelayPosterior]:
    """The posterior of each channel that a fitted model lets be late, by effect and names of the parameters."""
    found: dict[tuple[str, Late], DelayPosterior] = {}
    heat = temperature(explained)
    for effect in fitted.effects:
        for late in effect.late.values():
            names = [(f.effect, f.parameter.name) for f in fitted.beforehand]
            at = names.index((effect.name, late.delay)), names.index((effect.name, late.time_constant))
            if all(fitted.beforehand[i].std > 0.0 for i in at):
                found[effect.name, late] = _posterior(records, prior, fitted, at, heat)
    return found


def is_late(records: Sequence[Record], prior: SoilPrior, fitted: FittedModel, effect: Effect, explained: float) -> bool:
    """Whether any channel is surely later, by an effect of a fitted model, than half the time between its samples.

    A stamp says when a frame was on the bus: what it holds was measured up to a cycle before, half of one in the mean.
    Surely: by two standard deviations.
    """
    half = {late: records[-1].learned.sample_time(quantity) / 2.0 for quantity, late in effect.late.items()}
    if not any(half.values()):  # nobody knows when its samples came
        return True
    totals = [
        (posterior.total, half[late])
        for (name, late), posterior in delay_posteriors(records, prior, fitted, explained).items()
        if name == effect.name
    ]
    return any(abs(total.value) - 2.0 * total.std > of_cycle for total, of_cycle in totals)


def _posterior(
    records: Sequence[Record], prior: SoilPrior, fitted: FittedModel, at: tuple[int, int], heat: float
) -> DelayPosterior:
    first, second = (fitted.beforehand[i] for i in at)
    here = tuple(fitted.free[i].at(_pull(fitted, i)) for i in at)
    parts = [_Part(record, prior, fitted, i, at) for i, record in enumerate(records)]

    def cost(delay: float, tau: float) -> float:
        of_prior = first.pull_at(delay) ** 2 + second.pull_at(tau) ** 2
        return of_prior + sum(part.cost(delay, tau) for part in parts) / heat

    low, high = first.parameter.low, first.parameter.high
    most = min(second.parameter.high, max(sum(here) - low, STEP) + 2.0 * STEP)
    bounds, start = (low, high), (sum(here), here[1])
    ridge = _ridge(cost, np.linspace(0.0, most, NODES), start, bounds, first.std)
    share = ridge.weights()
    near = np.flatnonzero(share > 1e-3)
    begin, end = ridge.tau[max(near[0] - 1, 0)], ridge.tau[min(near[-1] + 1, NODES - 1)]
    top = int(np.argmin(ridge.cost))
    start = float(ridge.total[top]), float(ridge.tau[top])
    ridge = _ridge(cost, np.linspace(begin, end, NODES), start, bounds, first.std)
    share, best = ridge.weights(), int(np.argmin(ridge.cost))

    sums = float(share @ ridge.total)

    def estimate_of(values: Array, sd: Array, form: float) -> Estimate:
        mean = float(share @ values)
        return Estimate(mean, float(np.sqrt(share @ (sd**2 + (values - mean) ** 2) + (form * sums) ** 2)))

    within = np.full(NODES, (ridge.tau[1] - ridge.tau[0]) / np.sqrt(12.0))  # of a node's own stretch
    delay = ridge.total - ridge.tau
    return DelayPosterior(
        estimate_of(delay, np.hypot(ridge.sd, within), FORM_OF_PARTS),
        estimate_of(ridge.tau, within, FORM_OF_PARTS),
        estimate_of(ridge.total, ridge.sd, FORM_OF_SUM),
        (float(delay[best]), float(ridge.tau[best])),
        heat * (cost(*here) - float(ridge.cost[best])),
    )


def _ridge(cost: Cost, taus: Array, here: tuple[float, float], bounds: tuple[float, float], std: float) -> _Ridge:
    """The least cost at each time constant, over sums that leave the delay within its bounds.

    From the time constant nearest to `here` (sum, time constant) outwards, each from its neighbour's sum.
    """
    first = int(np.argmin(np.abs(taus - here[1])))
    found = np.zeros((3, len(taus)))
    for order in (range(first, len(taus)), range(first - 1, -1, -1)):
        total = here[0] if order.step > 0 else float(found[0, first])
        for i in order:
            tau = float(taus[i])
            total, found[1, i], found[2, i] = _downhill(cost, tau, total, (bounds[0] + tau, bounds[1] + tau), std)
            found[0, i] = total
    return _Ridge(taus, *found)


def _downhill(
    cost: Cost, tau: float, total: float, bounds: tuple[float, float], std: float
) -> tuple[float, float, float]:
    """The likeliest sum at a time constant, its sd, no more than the prior's std, and the cost there."""
    low, high = bounds[0] + STEP, bounds[1] - STEP
    for _ in range(ROUNDS):
        total = min(max(total, low), high)
        earlier, here, later = (cost(s - tau, tau) for s in (total - STEP, total, total + STEP))
        curved, slope = (earlier + later - 2.0 * here) / STEP**2, (later - earlier) / (2.0 * STEP)
        move = -slope / curved if curved > 0.0 else -np.sign(slope) * np.inf
        if abs(move) <= STEP or not low < min(max(total + move, low), high) < high:
            break
        total += float(np.clip(move, -4.0 * STEP, 4.0 * STEP))
    curved, move = max(curved, 2.0 / std**2), float(np.clip(move, -STEP, STEP))
    return total + move, float(np.sqrt(2.0 / curved)), here + slope * move + 0.5 * curved * move**2


class _Part:
    """One recording, linear about its fit in all but how late one channel is."""

    def __init__(self, record: Record, prior: SoilPrior, fitted: FittedModel, i: int, at: tuple[int, int]) -> None:
        self.fit: Fit = fitted.fits[i]
        free = tuple(fitted.beforehand[k] if k in at else f for k, f in enumerate(fitted.free))
        self.problem = record.learned.completed(fitted.effects, free)
        self.columns = [self.problem.n_sensors + k for k in at]
        self.free = [free[k] for k in at]
        joint_prior = _without(fitted.joint_prior[i], self.columns)
        self.gains = self.fit.optimum.gains.copy()
        for f, k, column in zip(self.free, at, self.columns, strict=True):
            self.gains[column] = f.pull_at(fitted.free[k].at(float(self.gains[column])))
        optimum = self.fit.optimum
        fitting = Objective(self.problem, prior, joint_prior)
        place = Iterate(optimum.soil, self.gains, optimum.latents, np.inf, 0)
        point = fitting.point(place)
        if point is None:
            raise np.linalg.LinAlgError("the model is not finite where it was fitted")
        self.point, self.directions = point, fitting.directions(place)
        variance, row_var = self.problem.variances(self.gains)
        self.inverse = inverse_covariance(point.at.by_latents, variance, row_var, self.problem.n_wheels)
        self.torque = self.problem.torques(optimum.soil, self.gains, optimum.latents)
        self.alone = self.problem.completed(
            [e for e in fitted.effects if e.name == self.free[0].effect], _alone(free, at)
        )
        self.sensors = self.gains[: self.problem.n_sensors]
        self.here = self._residuals(*(f.at(float(self.gains[c])) for f, c in zip(self.free, self.columns, strict=True)))

    def _residuals(self, *values: float) -> Array:
        """What this channel alone is off where it is so late (delay, time constant)."""
        pulls = iter(f.pull_at(v) for f, v in zip(self.free, values, strict=True))
        gains = np.concatenate([self.sensors, [next(pulls) if f.std else 0.0 for f in self.alone.free]])
        late = self.alone.lateness(gains, self.fit.optimum.latents, self.torque)
        return self.alone.late_residuals(late, self.point.at.by_latents, gains)

    def cost(self, delay: float, tau: float) -> float:
        """-2 log posterior of this recording, least over all the rest."""
        off = self._residuals(delay, tau) - self.here
        weighed = (self.inverse @ off[:, :, None])[:, :, 0]
        at = self.point.at
        gradient = self.point.gradient + self.directions.T @ (at.rows.T @ weighed.ravel())
        fall = gradient @ np.linalg.solve(self.point.information, gradient)
        return float(
            self.point.neg2_log_posterior + 2.0 * at.weighed[:, 0] @ off.ravel() + (off * weighed).sum() - fall
        )


def _alone(free: Sequence[Free], at: tuple[int, int]) -> list[Free]:
    """The parameters of one effect of which two may vary, and the others leave nothing."""
    own = [i for i, f in enumerate(free) if f.effect == free[at[0]].effect]
    return [free[i] if i in at else replace(free[i], value=0.0, std=0.0) for i in own]


def _without(joint_prior: Gaussian, columns: Sequence[int]) -> Gaussian:
    """What was known before of all but these gains, which are held."""
    covariance = joint_prior.covariance.copy()
    held = [_SOIL + c for c in columns]
    covariance[held] = covariance[:, held] = 0.0
    return Gaussian(joint_prior.soil, joint_prior.gains, covariance)


def _pull(fitted: FittedModel, i: int) -> float:
    return float(fitted.fits[-1].mode.gains[fitted.checks[-1].problem.n_sensors + i])
