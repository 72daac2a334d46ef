"""The solver: minimises a window's -2 log posterior by Gauss-Newton steps, shortened where they are rejected.

Equations.  With theta the free soil coordinates and the active gains, r the residuals and W their inverse
covariance, p the residuals of the prior and P its precision,

    objective     F(theta) = -2 log posterior = r' W r + p' P p + constant
    Jacobian      J = dr/dtheta,   J_p = dp/dtheta
    model         gradient g = J' W r + J_p' P p,   information H = J' W J + J_p' P J_p
    step          H d = -g,   subject to the active bounds
    decrease      of F, predicted for a full step: D = d' H d, its squared length in posterior sd

The latents (loads and speeds of each instant) are eliminated from the linear model.  In an objective `as_measured`
they are held, and F must fall at each step.  Otherwise they follow each step one linearisation late, so that F may rise
before it falls further.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian, solve_with_inverse
from soilbus.estimation.linearisation import FIRST_GAIN, SOIL, Latents, Linearisation
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.options import SolverOptions
from soilbus.estimation.parametrization import at_bounds, coordinates_of, step_fraction_within
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.terra.wheel import Soil

_SOIL = len(PARAMETERS)


@dataclass(frozen=True, slots=True)
class Iterate:
    """Point of a descent: soil (6,) in SI, gains (G,) and latents."""

    soil: Array
    gains: Array
    latents: Latents

    def as_soil(self) -> Soil:
        """Return the soil by name."""
        return Soil(*self.soil.tolist())


@dataclass(frozen=True, slots=True)
class QuadraticModel:
    """An objective's quadratic model at an iterate, by F free coordinates and A active gains."""

    information: Array  # (F + A, F + A), Gauss-Newton Hessian, half that of -2 log posterior: data and prior
    prior_information: Array  # (F + A, F + A), the prior's part of it
    gradient: Array  # (F + A,), half the gradient of -2 log posterior
    neg2_log_posterior: float  # value of the objective, up to a constant
    active_bounds: Array  # (E, F + A), outward directions of the bounds that the iterate is at: no step goes there

    def step(self) -> Array | None:
        """Return the step (F + A,) to the model's minimum within the active bounds; None where there is no minimum.

        A step that would cross an active bound goes along it, to the least value there.
        """
        solution = solve_with_inverse(self.information, self.gradient)
        if solution is None:
            return None
        (back, inverse), held = solution, np.zeros(len(self.active_bounds), bool)
        step = -back
        while (outward := ~held & (self.active_bounds @ step > 0.0)).any():
            held |= outward
            bounds = self.active_bounds[held]
            along = inverse @ bounds.T
            step = along @ np.linalg.lstsq(bounds @ along, bounds @ back, rcond=None)[0] - back
        return step if np.isfinite(step).all() else None

    @property
    def neg2_log_evidence(self) -> float:
        """-2 log evidence (Laplace): the data's likelihood with the parameters integrated out."""
        return self.neg2_log_posterior + float(
            np.linalg.slogdet(self.information)[1] - np.linalg.slogdet(self.prior_information)[1]
        )

    def squared_length(self, step: Array) -> float:
        """Return the squared length of a step (F + A,) in posterior sd; of a full step it is the predicted decrease."""
        return float(step @ self.information @ step)


@dataclass(frozen=True, slots=True)
class WindowModel(QuadraticModel):
    """The quadratic model of a window, with the linearisation of its data: residuals and Jacobian."""

    linearisation: Linearisation


class Objective:
    """-2 log posterior of a window: its residuals and those of its prior, with derivatives.

    The prior of the soil sets the free coordinates (F), joint_prior is of soil and gains for this window; ValueError
    where it has no proper covariance.  Gains with a variance are active (A). as_measured: latents and sensors' gains
    are held, which far from the optimum would absorb the residuals of a wrong soil.
    """

    def __init__(
        self, problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian, as_measured: bool = False
    ) -> None:
        self.problem, self.joint_prior, self.options = problem, joint_prior, problem.options.search
        self.coordinates = coordinates_of(prior, problem.rig.mean_width, self.options)
        self.as_measured = as_measured
        is_active = np.diag(joint_prior.covariance)[_SOIL:] > 0.0
        is_active[: problem.n_sensors if as_measured else 0] = False
        self.active = np.flatnonzero(is_active)
        self._gain_bounds = problem.gain_bounds[0][self.active], problem.gain_bounds[1][self.active]
        self._has_gain_bounds = bool(np.isfinite(self._gain_bounds).any())
        self.free = self.coordinates.free
        self._identity = np.eye(len(self.free) + len(self.active))
        self._gain_directions = np.zeros((FIRST_GAIN + len(joint_prior.gains), len(self._identity)))
        self._gain_directions[FIRST_GAIN + self.active] = self._identity[len(self.free) :]
        self.unknowns = np.concatenate([self.free, _SOIL + self.active])
        of_unknowns = joint_prior.covariance[self.unknowns[:, None], self.unknowns]
        solution = solve_with_inverse(of_unknowns, np.zeros(len(of_unknowns)))
        if solution is None:
            raise ValueError("the prior has no proper covariance")
        self.prior_precision = solution[1]

    def start(self, soil: Array, gains: Array | None = None, latents: Latents | None = None) -> Iterate:
        """Return an iterate of a soil (6,) in SI and gains (G,), by default the prior's.

        latents: taken where they are of this window's instants; else they are as measured.
        """
        gains = self.joint_prior.gains if gains is None else gains
        if latents is None or latents.load.shape != (self.problem.n, self.problem.n_wheels):
            latents = self.problem.start(Soil(*soil.tolist()), gains)
        return Iterate(soil, gains, latents)

    def stepped(self, iterate: Iterate, model: WindowModel, step: Array) -> Iterate:
        """Return the iterate after a step (F + A,), shortened at bounds, with latents by the linear model.

        Entry angles that change far are solved.
        """
        free = len(self.free)
        step = self.step_fraction(iterate, step) * step
        soil, gains = self.coordinates.stepped(iterate.soil, step[:free]), iterate.gains.copy()
        gains[self.active] += step[free:]
        if self._has_gain_bounds:
            gains = np.clip(gains, *self.problem.gain_bounds)
        at, changes, latents = model.linearisation, (soil - iterate.soil, gains - iterate.gains), iterate.latents
        if self.as_measured:
            angle = self.problem.stepped_entry_angle(at, latents.entry_angle, *changes)
            new = latents._replace(entry_angle=angle)
        else:
            new = self.problem.updated(at, latents, *changes)
        change = np.abs(new.entry_angle / latents.entry_angle - 1.0).max(initial=0.0)
        if change > self.options.max_angle_change:
            new = self.problem.with_entry_angles(new, Soil(*soil.tolist()), gains)
        return Iterate(soil, gains, new)

    def with_entry_angles(self, iterate: Iterate) -> Iterate:
        """Return the same iterate with its entry angles solved, after linear predictions in a row."""
        latents = self.problem.with_entry_angles(iterate.latents, iterate.as_soil(), iterate.gains)
        return replace(iterate, latents=latents)

    def step_fraction(self, iterate: Iterate, step: Array) -> float:
        """Return the largest fraction of a step (F + A,), 1 at most, within the bounds and step limits."""
        free = len(self.free)
        of_soil = self.coordinates.step_fraction(iterate.soil, step[:free])
        if not self._has_gain_bounds:
            return of_soil
        low, high = self._gain_bounds
        room = np.where(step[free:] > 0.0, high, low) - iterate.gains[self.active]
        return min(of_soil, step_fraction_within(room, step[free:]))

    def _active_bounds(self, iterate: Iterate) -> Array:
        """Outward directions (E, F + A) of the bounds that an iterate is at."""
        of_soil = self.coordinates.active_bounds(iterate.soil)
        if not (self._has_gain_bounds or len(of_soil)):
            return self._identity[:0]
        sides = at_bounds(iterate.gains[self.active], *self._gain_bounds)
        of_gains = sides[:, None] * self._identity[len(self.free) :]
        return np.concatenate([np.pad(of_soil, ((0, 0), (0, len(sides)))), of_gains[sides != 0.0]])

    def quadratic_model(self, iterate: Iterate) -> WindowModel | None:
        """Return the quadratic model at an iterate; None where the observation model is not finite there."""
        linearisation = self.problem.linearise(iterate.as_soil(), iterate.gains, iterate.latents, not self.as_measured)
        return self.with_prior(iterate, linearisation)

    def with_prior(self, iterate: Iterate, linearisation: Linearisation) -> WindowModel | None:
        """Return the quadratic model from the data's linearisation at an iterate; None where it is not finite."""
        directions, jacobian = self.directions(iterate.soil), self.prior_jacobian(iterate.soil)
        if self.as_measured:
            directions = np.delete(directions, self.problem.layout.sensor_columns, axis=0)
        weighed, off = self.prior_precision @ jacobian, self.prior_residuals(iterate.soil, iterate.gains)
        neg2_log_posterior = linearisation.chi2 + float(off @ self.prior_precision @ off)
        if not math.isfinite(neg2_log_posterior):
            return None
        prior_information = jacobian.T @ weighed
        return WindowModel(
            information=directions.T @ linearisation.normal @ directions + prior_information,
            prior_information=prior_information,
            gradient=directions.T @ linearisation.normal[:, 0] + off @ weighed,
            neg2_log_posterior=neg2_log_posterior,
            active_bounds=self._active_bounds(iterate),
            linearisation=linearisation,
        )

    def prior_residuals(self, soil: Array, gains: Array) -> Array:
        """Return log soil and gains less the prior's mean (F + A,), of what is free and active."""
        logs = np.log(soil[self.free] / self.joint_prior.soil[self.free])
        return np.concatenate([logs, (gains - self.joint_prior.gains)[self.active]])

    def directions(self, soil: Array) -> Array:
        """Return the derivatives (1 + 6 + G, F + A) of (1, soil, gains) by free coordinates and active gains.

        So Linearisation.rows times `directions` is the residuals' Jacobian.
        """
        directions = self._gain_directions.copy()
        directions[SOIL, : len(self.free)] = soil[:, None] * self.coordinates.log_directions(soil)
        return directions

    def parameter_jacobian(self, soil: Array) -> Array:
        """Return the derivatives (6 + G, F + A) of log soil and gains by coordinates and active gains."""
        jacobian = self._gain_directions[1:].copy()
        jacobian[:_SOIL, : len(self.free)] = self.coordinates.log_directions(soil)
        return jacobian

    def prior_jacobian(self, soil: Array) -> Array:
        """Return the derivatives (F + A, F + A) of the prior's residuals by coordinates and active gains."""
        return np.asarray(self.parameter_jacobian(soil)[self.unknowns])

    def gaussian(self, soil: Array, gains: Array, covariance: Array) -> Gaussian:
        """Return the Gaussian with this covariance of coordinates and active gains."""
        jacobian = self.parameter_jacobian(soil)
        return Gaussian(soil, gains, jacobian @ covariance @ jacobian.T)


class Termination(StrEnum):
    """Reason why a descent ended."""

    STEP = "step"
    """Converged: the next step is predicted to be shorter than the tolerance."""
    LIMIT = "limit"
    """Evaluations are used up."""
    REJECTED = "rejected"
    """No step was accepted: what is left is the noise of the linear model."""
    GIVEN_UP = "given_up"
    """The objective is predicted to stay above a value of interest."""
    NOT_FINITE = "not_finite"
    """The model is not finite, or has no minimum, where the descent begins."""


PointT = TypeVar("PointT")
"""Iterate of an objective."""
ModelT = TypeVar("ModelT", bound=QuadraticModel)
"""Its quadratic model there."""


class Minimisable(Protocol[PointT, ModelT]):
    """An objective that `minimise` takes: of one window, or of several recordings together."""

    def quadratic_model(self, iterate: PointT, /) -> ModelT | None:
        """Return the quadratic model at an iterate; None where it is not finite."""

    def stepped(self, iterate: PointT, model: ModelT, step: Array, /) -> PointT:
        """Return the iterate after a step, shortened at bounds."""

    def with_entry_angles(self, iterate: PointT, /) -> PointT:
        """Return the same iterate with its entry angles solved."""


class Solution(NamedTuple, Generic[PointT, ModelT]):
    """The end of a descent."""

    iterate: PointT  # one full step after `previous`
    # the iterate at which `model` was evaluated: the last one where the descent converged, else that of least value
    previous: PointT
    model: ModelT | None  # the quadratic model there; None where it is not finite
    predicted_decrease: float  # of the objective by the full step
    evaluations: int  # of the model
    termination: Termination  # why it ended

    @property
    def value(self) -> float:
        """Value of the objective at `previous`; nan without a model."""
        return math.nan if self.model is None else self.model.neg2_log_posterior


class _Expansion(NamedTuple, Generic[PointT, ModelT]):
    """An iterate, the quadratic model there, its step and the predicted decrease."""

    iterate: PointT
    model: ModelT
    step: Array
    decrease: float
    value: float  # of the objective


def minimise(
    objective: Minimisable[PointT, ModelT], start: PointT, options: SolverOptions, last_decrease: float | None = None
) -> Solution[PointT, ModelT]:
    """Descend from a start.

    last_decrease is the predicted decrease of the full step that led to the start, 0 where it is unknown.  None: the
    descent does not end at the start, where the latents are as measured and the objective is underestimated.
    """
    here = lowest = _expanded(objective, start)
    if here is None or lowest is None:
        return Solution(start, start, None, math.nan, 1, Termination.NOT_FINITE)
    evaluations, n_rejected, fraction = 1, 0, 1.0
    max_rise = options.max_rise
    while (ended := _termination(options, here, last_decrease, evaluations, n_rejected)) is None:
        new = objective.stepped(here.iterate, here.model, fraction * here.step)
        there = _expanded(objective, new)
        evaluations += 1
        if there is None or not there.value <= here.value + max_rise * (here.value + 1.0):
            n_rejected, last_decrease = n_rejected + 1, 0.0
            fraction *= options.shortening
            if n_rejected == 2:  # they were predicted
                here = _expanded(objective, objective.with_entry_angles(here.iterate)) or here
                evaluations += 1
            continue
        last_decrease = here.decrease if fraction == 1.0 else 0.0
        if there.value > here.value:  # it overshot
            max_rise *= options.shortening
            fraction *= options.shortening
        else:
            fraction = min(2.0 * fraction, 1.0)
        here, n_rejected = there, 0
        if here.value < lowest.value:
            lowest = here
    if ended is not Termination.STEP:
        here = lowest
    end = objective.stepped(here.iterate, here.model, here.step)
    return Solution(end, here.iterate, here.model, here.decrease, evaluations, ended)


def _expanded(objective: Minimisable[PointT, ModelT], iterate: PointT) -> _Expansion[PointT, ModelT] | None:
    """The quadratic model at an iterate with its step; None where these are not finite."""
    model = objective.quadratic_model(iterate)
    step = None if model is None else model.step()
    if model is None or step is None:
        return None
    return _Expansion(iterate, model, step, model.squared_length(step), model.neg2_log_posterior)


def _termination(
    options: SolverOptions,
    here: _Expansion[PointT, ModelT],
    last_decrease: float | None,
    evaluations: int,
    n_rejected: int,
) -> Termination | None:
    """Why the descent ends here; None where it goes on."""
    if here.value - here.decrease > options.give_up_above:
        return Termination.GIVEN_UP
    ratio = min(here.decrease / last_decrease, 1.0) if last_decrease else 1.0
    if last_decrease is not None and ratio * here.decrease < options.step_tolerance:
        return Termination.STEP
    if n_rejected > options.max_rejected:
        return Termination.REJECTED
    return Termination.LIMIT if evaluations >= options.max_evaluations else None
