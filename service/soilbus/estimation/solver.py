"""A window's objective, its quadratic model, and the two descents to its minimum (damped Gauss-Newton).

Equations.  With theta the free soil coordinates and the active gains, r the residuals and W their inverse
covariance, p the residuals of the prior and P its precision,

    objective     -2 log posterior (theta) = r' W r + p' P p + constant
    Jacobian      J = dr/dtheta,   J_p = dp/dtheta
    model         gradient g = J' W r + J_p' P p,   information H = J' W J + J_p' P J_p
    step          (H + C + damping diag(H + C)) d = -g,   subject to the active bounds
    prediction    predicted decrease of -2 log posterior along the full step = d' H d

C is the positive part of the curvature that the coordinates add (parametrization.Coordinates.curvature).

`Objective` evaluates residuals, Jacobian and prior at an `Iterate` and returns the `QuadraticModel` there.
`descend_soil` runs far from the optimum: the latents stay as measured, and Levenberg-Marquardt damping rejects
every step that does not lower the objective.  `descend_jointly` runs near the optimum: soil, gains and latents
move together, and a step may raise the objective a little, because the latents follow one linearisation late.
`StoppingRule` holds every condition that ends `descend_jointly`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian, PriorFactor, PriorQuadratic, solve_with_inverse
from soilbus.estimation.observation_model import FIRST_GAIN, SOIL, Latents, Linearisation, ObservationModel, Optimum
from soilbus.estimation.parametrization import (
    MAX_LOG_STEP,
    TYPICAL_DEPTH,
    Coordinates,
    Moments,
    at_bounds,
    moments_along_share,
    step_fraction_within,
)
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.terra.wheel import Soil

MAX_ANGLE_CHANGE = 0.2
"""Relative change of an entry angle [1] above which the angles are solved again instead of extrapolated.

No evidence recorded.
"""
MAX_ANGLE_CHANGE_WITH_EFFECTS = 0.1
"""The same [1] where effects have a part in the load: they may be curved where the soil alone is not."""
MAX_MODULUS_SD = 0.5
"""Sd of log K_L at the typical depth [1] above which k_c and k_phi are each known by the prior alone.

The moments along k_c's share are not worked out there.  No evidence recorded.
"""
STEP_TOLERANCE, WARM_STEP_TOLERANCE = 1e-6, 3e-3
"""Squared length of a step in posterior sd [1] below which a descent has converged: a cold one, and a warm-started
one, which starts so close that the error after such a step is much smaller than the step."""
NEXT_STEP_TOLERANCE, WARM_NEXT_STEP_TOLERANCE = 2e-8, 1e-4
"""The same [1] for the squared length of the next step, predicted from the ratio of the last two.

No evidence recorded.
"""
STALLED_DECREASE = 1.0
"""Predicted decrease [-2 log] below which a stalled descent ends.  No evidence recorded."""
MAX_STALLED = 2
"""Steps in a row without a decrease after which a descent has stalled.  No evidence recorded."""
MAX_REJECTED = 5
"""Rejected steps in a row after which a descent fails: what is left is the noise of the linear model."""
ALLOWED_INCREASE = 20.0
"""Rise [-2 log] that a joint step may bring: where the objective is curved, steps that overshoot return by
themselves."""
ALLOWED_FIRST_INCREASE = 0.02
"""Share of the objective [1] allowed besides at the first joint step: with latents as measured it looks too low."""
SHORTENING = 0.4
"""Factor [1] on the fraction of the full step after a rejected step.  No evidence recorded."""
SLOW_RATIO = 0.5
"""Length of a step over that of the last, along it [1], above which steps are extrapolated.  No evidence recorded."""
MAX_EXTRAPOLATION = 8.0
"""Largest multiple of a full step [1] by extrapolation.  No evidence recorded."""
SOIL_STEP_TOLERANCE = 1.0
"""Squared length of a step in posterior sd [1] below which the soil alone is near enough for the joint descent."""
SOIL_RELATIVE_TOLERANCE = 0.02
"""Relative decrease of the objective [1] by a step of the soil alone below which the joint descent takes over.

No evidence recorded.
"""
GAINS_RELATIVE_TOLERANCE = 1e-3
"""The same [1] where gains move with the soil.  No evidence recorded."""
FIRST_DAMPING, MAX_DAMPING = 1e-3, 1e6
"""Damping of the first step of the soil alone, as a share of the diagonal [1], and the one at which it ends."""
OTHER_OPTIMUM_SD = 10.0
"""Posterior sd on a few instants [1] beyond which the end of a descent is another optimum.  No evidence recorded."""

_SOIL = len(PARAMETERS)
_K_C, _K_PHI, _N, _C = (PARAMETERS.index(name) for name in ("k_c", "k_phi", "n", "c"))
SMALL_SHARE = 1e-12
"""Share [1] that stands for one whose complement does not change."""
_SHARE, _LOG_SHARE, _LOG_REST, _OTHERS = 0, 1, 2, 3
"""Columns of changes for the moments along k_c's share s: of s, log s and log (1 - s); the others follow."""


@dataclass(frozen=True, slots=True)
class Iterate:
    """A point of a descent: soil (6,) in SI, gains (G,) and latents, with the objective's value there.

    neg2_log_posterior is the value at the iterate before where this one has not been evaluated, and
    evaluations is how many evaluations of the model led here.
    """

    soil: Array
    gains: Array
    latents: Latents
    neg2_log_posterior: float
    evaluations: int

    def as_soil(self) -> Soil:
        """The soil by name."""
        return Soil(*self.soil.tolist())


@dataclass(frozen=True, slots=True)
class QuadraticModel:
    """The objective's quadratic model at an iterate, by F free coordinates and A active gains.

    Attributes
    ----------
    information : (F + A, F + A)
        Gauss-Newton Hessian, half that of -2 log posterior: data and prior.
    prior_information : (F + A, F + A)
        The prior's part of it.
    curvature : (F + A, F + A)
        What the coordinates' own curvature adds for a step.
    gradient : (F + A,)
        Half the gradient of -2 log posterior.
    neg2_log_posterior : float
        Value of the objective, up to a constant.
    active_bounds : (E, F + A)
        Outward directions of the bounds that the iterate is at: no step goes there.
    linearisation
        Residuals and Jacobian of the data.
    """

    information: Array
    prior_information: Array
    curvature: Array
    gradient: Array
    neg2_log_posterior: float
    active_bounds: Array
    linearisation: Linearisation

    def step(self, damping: float = 0.0, gradient: Array | None = None) -> Array | None:
        """The step to the model's minimum within the active bounds.

        Parameters
        ----------
        damping
            Share of the diagonal added to it (Levenberg-Marquardt).
        gradient : (F + A,), optional
            In place of the model's own.

        Returns
        -------
        step : (F + A,) or None
            A step that would cross an active bound goes along it, to the least value there.  None where the
            model has no minimum.
        """
        gradient = self.gradient if gradient is None else gradient
        curved = self.information + self.curvature
        curved.flat[:: len(curved) + 1] *= 1.0 + damping
        solution = _solution(curved, np.concatenate([gradient[None], self.active_bounds]).T)
        if solution is None:
            return None
        step = -solution[:, 0]
        if not len(self.active_bounds):
            return step if np.isfinite(step).all() else None
        held = np.zeros(len(self.active_bounds), bool)
        while (outward := ~held & (self.active_bounds @ step > 0.0)).any():
            held |= outward
            along, bounds = solution[:, 1:][:, held], self.active_bounds[held]
            step = along @ np.linalg.lstsq(bounds @ along, bounds @ solution[:, 0], rcond=None)[0] - solution[:, 0]
        return step if np.isfinite(step).all() else None

    @property
    def neg2_log_evidence(self) -> float:
        """-2 log of the data's likelihood with the parameters integrated out (Laplace), up to the same constant."""
        return self.neg2_log_posterior + float(
            np.linalg.slogdet(self.information)[1] - np.linalg.slogdet(self.prior_information)[1]
        )

    def squared_length(self, step: Array) -> float:
        """Squared length of a step (F + A,) in posterior sd; of a full step it is the predicted decrease."""
        return float(step @ self.information @ step)


class GaussianApproximation(NamedTuple):
    """A window's linear model at its optimum, with the prior.

    Attributes
    ----------
    directions : (1 + 6 + G, F + A)
        As `Objective.directions`.
    prior
        The prior's quadratic there.
    step : (F + A,)
        H^-1 g, to be subtracted: leads to the minimum.
    covariance : (F + A, F + A)
        H^-1.
    """

    directions: Array
    prior: PriorQuadratic
    step: Array
    covariance: Array

    def explained(self, mixed: Array) -> tuple[Array, Array]:
        """What soil and gains take up of gradient (K,) and information (K, K) of further unknowns; mixed (K, F + A)."""
        return mixed @ self.step, mixed @ self.covariance @ mixed.T


class Objective:
    """-2 log posterior of a window: its residuals and those of its prior, with derivatives.

    Parameters
    ----------
    problem
        The window's observation model: N instants, W wheels, G gains.
    prior
        Prior of the soil, which sets the free coordinates (F).
    joint_prior
        Prior of soil and gains for this window.
    with_gains
        Whether gains move at all.
    first_gain
        Gains before this index are held; those that are not held and have a variance are active (A).

    Raises
    ------
    ValueError
        Where `joint_prior` has no proper covariance.
    """

    def __init__(
        self,
        problem: ObservationModel,
        prior: SoilPrior,
        joint_prior: Gaussian,
        with_gains: bool = True,
        first_gain: int = 0,
    ) -> None:
        self.problem, self.joint_prior = problem, joint_prior
        self.coordinates = Coordinates(prior, float(problem.rig.width.mean()))
        is_active = (
            np.diag(joint_prior.covariance)[_SOIL:] > 0.0 if with_gains else np.zeros(len(joint_prior.gains), bool)
        )
        is_active[:first_gain] = False
        self.active = np.flatnonzero(is_active)
        self._gain_bounds = tuple(bound[self.active] for bound in problem.gain_bounds())
        self._has_gain_bounds = bool(np.isfinite(self._gain_bounds).any())
        self.free = self.coordinates.free
        self._identity = np.eye(len(self.free) + len(self.active))
        self._gain_directions = np.zeros((FIRST_GAIN + len(joint_prior.gains), len(self._identity)))
        self._gain_directions[FIRST_GAIN + self.active] = self._identity[len(self.free) :]
        self._by_sensors = with_gains and first_gain == 0
        self.prior_factor = PriorFactor(joint_prior, prior, self.active, self.coordinates.width)
        self._prior_cache: tuple[Array, Array, PriorQuadratic] | None = None
        self._approximation: tuple[Optimum, GaussianApproximation | None] | None = None

    def with_joint_prior(self, joint_prior: Gaussian) -> Objective:
        """The same window under another joint prior."""
        return Objective(self.problem, self.coordinates.prior, joint_prior)

    # Iterates

    def start(self, soil: Array, guess: Array | None = None, gains: Array | None = None) -> Iterate:
        """An iterate with the latents as measured.

        Parameters
        ----------
        soil : (6,)
            In SI.
        guess : (N, W), optional
            Entry angles [rad] to solve them from.
        gains : (G,), optional
            Those of the joint prior if not given.
        """
        gains = self.joint_prior.gains if gains is None else gains
        return Iterate(soil, gains, self.problem.start(Soil(*soil.tolist()), guess, gains), np.inf, 0)

    def start_near(self, soil: Array, gains: Array, latents: Latents | None) -> Iterate:
        """Soil (6,) and gains (G,) with these latents where they are of this window's instants, else as measured."""
        if latents is None or latents.load.shape != (self.problem.n, self.problem.n_wheels):
            return self.start(soil, gains=gains)
        return Iterate(soil, gains, latents, np.inf, 0)

    def stepped(self, iterate: Iterate, model: QuadraticModel, step: Array) -> Iterate:
        """The iterate after a step (F + A,), shortened at bounds, with latents as the linear model predicts them."""
        free = len(self.free)
        step = self.step_fraction(iterate, step) * step
        soil = self.coordinates.stepped(iterate.soil, step[:free])
        gain_step = np.zeros(len(iterate.gains))
        gain_step[self.active] = step[free:]
        latents = self.problem.updated(model.linearisation, iterate.latents, soil - iterate.soil, gain_step)
        return self._with_latents(iterate, model, soil, iterate.gains + gain_step, latents)

    def stepped_with_measured_latents(self, iterate: Iterate, model: QuadraticModel, step: Array) -> Iterate:
        """The iterate after a step (F + A,) with latents as measured, as they already are at this iterate."""
        free, gains = len(self.free), iterate.gains.copy()
        step = self.step_fraction(iterate, step) * step
        gains[self.active] += step[free:]
        soil, gains = self.coordinates.stepped(iterate.soil, step[:free]), self.problem.allowed(gains)
        angle = self.problem.stepped_entry_angle(
            model.linearisation, iterate.latents.entry_angle, soil - iterate.soil, gains - iterate.gains
        )
        return self._with_latents(iterate, model, soil, gains, replace(iterate.latents, entry_angle=angle))

    def _with_latents(
        self, iterate: Iterate, model: QuadraticModel, soil: Array, gains: Array, latents: Latents
    ) -> Iterate:
        """Soil (6,), gains (G,) and predicted latents as an iterate; entry angles that change far are solved."""
        change = np.abs(latents.entry_angle / iterate.latents.entry_angle - 1.0).max(initial=0.0)
        has_effects = len(model.linearisation.load_by_effects)
        if change > (MAX_ANGLE_CHANGE_WITH_EFFECTS if has_effects else MAX_ANGLE_CHANGE):
            latents = self.problem.with_entry_angles(latents, Soil(*soil.tolist()), gains)
        return Iterate(soil, gains, latents, model.neg2_log_posterior, iterate.evaluations)

    def with_entry_angles(self, iterate: Iterate) -> Iterate:
        """The same iterate with its entry angles solved, after linear predictions in a row."""
        latents = self.problem.with_entry_angles(iterate.latents, iterate.as_soil(), iterate.gains)
        return replace(iterate, latents=latents)

    def step_fraction(self, iterate: Iterate, step: Array) -> float:
        """Largest fraction of a step (F + A,), 1 at most, within the bounds and step limits."""
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
        own = np.flatnonzero(sides)
        bounds = np.zeros((len(of_soil) + len(own), len(self.free) + len(self.active)))
        bounds[: len(of_soil), : len(self.free)] = of_soil
        bounds[len(of_soil) + np.arange(len(own)), len(self.free) + own] = sides[own]
        return bounds

    # Residuals, Jacobian, prior: the quadratic model

    def quadratic_model(self, iterate: Iterate) -> QuadraticModel | None:
        """The quadratic model at an iterate; None where the observation model is not finite there."""
        linearisation = self.problem.linearise(iterate.as_soil(), iterate.gains, iterate.latents, self._by_sensors)
        return self.with_prior(iterate, linearisation)

    def with_prior(self, iterate: Iterate, linearisation: Linearisation) -> QuadraticModel | None:
        """The quadratic model from the data's linearisation at an iterate; None where it is not finite."""
        free = len(self.free)
        directions = self.directions(iterate)
        if not self._by_sensors:
            directions = np.delete(directions, self.problem.layout.sensor_columns, axis=0)
        gradient = directions.T @ linearisation.normal[:, 0]
        prior = self.prior_at(iterate)
        neg2_log_posterior = linearisation.chi2 + prior.neg2_log_prior
        if not math.isfinite(neg2_log_posterior):
            return None
        curvature = np.zeros_like(self._identity)
        curvature[:free, :free] = self.coordinates.curvature((gradient + prior.gradient_of_data)[:free])
        return QuadraticModel(
            information=directions.T @ linearisation.normal @ directions + prior.information,
            prior_information=prior.information,
            curvature=curvature,
            gradient=gradient + prior.gradient,
            neg2_log_posterior=neg2_log_posterior,
            active_bounds=self._active_bounds(iterate),
            linearisation=linearisation,
        )

    def prior_at(self, iterate: Iterate) -> PriorQuadratic:
        """The prior's quadratic at an iterate; kept for the next call with the same soil and gains."""
        last = self._prior_cache
        if last is None or last[0] is not iterate.soil or last[1] is not iterate.gains:
            by_logs = self._identity.copy()
            by_logs[: len(self.free), : len(self.free)] = self._log_directions(iterate.soil)[self.free]
            prior = self.prior_factor.quadratic_at(iterate.soil, iterate.gains, by_logs)
            last = self._prior_cache = iterate.soil, iterate.gains, prior
        return last[2]

    def directions(self, iterate: Iterate) -> Array:
        """Derivatives (1 + 6 + G, F + A) of (1, soil in SI, gains) by free coordinates and active gains.

        So Linearisation.rows times `directions` is the residuals' Jacobian.
        """
        directions = self._gain_directions.copy()
        directions[SOIL, : len(self.free)] = iterate.soil[:, None] * self._log_directions(iterate.soil)
        return directions

    def parameter_jacobian(self, optimum: Optimum) -> Array:
        """Derivatives (6 + G, F + A) of the soil's logarithms and the gains by coordinates and active gains."""
        jacobian = self._gain_directions[1:].copy()
        jacobian[:_SOIL, : len(self.free)] = self._log_directions(optimum.soil)
        return jacobian

    def prior_jacobian(self, optimum: Optimum) -> Array:
        """Derivatives (R, F + A) of the prior's residuals by coordinates and active gains."""
        unknowns = np.concatenate([self.free, _SOIL + self.active])
        return self.prior_factor.jacobian(optimum.soil, self.parameter_jacobian(optimum)[unknowns])

    def second_derivative(self, iterate: Iterate, model: QuadraticModel, step: Array, there: QuadraticModel) -> Array:
        """Second derivative of the residuals (R,) along a step (F + A,), from the models at both of its ends."""
        straight = model.linearisation.rows @ (self.directions(iterate) @ step)
        change = there.linearisation.rows[:, 0] - model.linearisation.rows[:, 0]
        return np.asarray(2.0 * (change - straight))

    def geodesic_step(
        self, iterate: Iterate, model: QuadraticModel, fraction: float, second_derivative: Array
    ) -> Array | None:
        """A fraction of the full step with its geodesic acceleration (F + A,); None where there is no step.

        Parameters
        ----------
        fraction
            Of the full step [1].
        second_derivative : (R,)
            That of the residuals along the full step.

        References
        ----------
        Transtrum & Sethna 2012, arXiv:1201.5885.
        """
        acceleration = self.directions(iterate).T @ (model.linearisation.weighed.T @ second_derivative)
        return model.step(gradient=fraction * model.gradient + 0.5 * fraction**2 * acceleration)

    # Gaussians at an optimum

    def approximation_at(self, optimum: Optimum) -> GaussianApproximation | None:
        """The linear model at an optimum, kept for the next call; None where its information is singular."""
        if self._approximation is None or self._approximation[0] is not optimum:
            iterate = Iterate(optimum.soil, optimum.gains, optimum.latents, math.nan, 0)
            directions, prior = self.directions(iterate), self.prior_at(iterate)
            by_unknowns = directions.T @ optimum.at.normal
            solution = solve_with_inverse(
                by_unknowns @ directions + prior.information, by_unknowns[:, 0] + prior.gradient
            )
            self._approximation = (
                optimum,
                None if solution is None else GaussianApproximation(directions, prior, *solution),
            )
        return self._approximation[1]

    def gaussians_at(self, iterate: Iterate, model: QuadraticModel, base: Array) -> tuple[Gaussian, Gaussian] | None:
        """Gaussians of the posterior at an optimum: by its moments along k_c's share and c, and by its curvature.

        Parameters
        ----------
        iterate
            The optimum.
        model
            The quadratic model one step before it.
        base : (6,)
            The soil of that model.

        Returns
        -------
        moments, mode
            By the curvature where there are no finite moments; along k_c's share also where k_c and k_phi are not
            both free, or the sd of log K_L exceeds MAX_MODULUS_SD.  None where the information is singular.
        """
        inverse = solve_with_inverse(model.information, model.gradient)
        if inverse is None:
            return None
        covariance = inverse[1]
        mode = self._gaussian(iterate.soil, iterate.gains, covariance, base)
        free, has_share = len(self.free), {_K_C, _K_PHI} <= set(self.free.tolist())
        has_share = has_share and bool(covariance[_K_PHI, _K_PHI] <= MAX_MODULUS_SD**2)
        along_share = self._moments(iterate, model, base) if has_share else None
        along_c = self._moments_along_c(iterate, model, base)
        if along_share is None and along_c is None:
            return mode, mode
        soil, gains, own = iterate.soil, iterate.gains.copy(), covariance
        if along_share is not None:
            step = self._by_share(iterate.soil) @ along_share.mean
            soil = self.coordinates.soil_at(self.coordinates.position(iterate.soil) + step[:free])
            gains[self.active] += step[free:]
            by_share = self._by_share(soil)
            own = by_share @ along_share.covariance @ by_share.T
        if along_c is not None:  # about the optimum, at which c and tan phi make the strength that was measured
            square = along_c.covariance + np.outer(along_c.mean, along_c.mean)
            to_square = _root_of(square) @ np.linalg.inv(_root_of(covariance))
            own = to_square @ own @ to_square.T
            place, prior_sd = int(np.searchsorted(self.free, _C)), float(self.coordinates.prior.log_std[_C])
            scale = np.ones(len(own))
            scale[place] = min(1.0, prior_sd / math.sqrt(own[place, place]))  # c is known no less than beforehand
            own = scale[:, None] * own * scale
        return self._gaussian(soil, gains, own), mode

    def _moments_along_c(self, iterate: Iterate, model: QuadraticModel, base: Array) -> Moments | None:
        """Moments (F + A) of coordinates and gains about the optimum, c being log-normal and the forces linear in it.

        As along a share of k_c that is small, whose complement does not change.  The prior is linearised at the model's
        soil `base`, too: at another c what compensates for c is another share of tan phi.
        """
        if _C not in self.free:
            return None
        place, n = int(np.searchsorted(self.free, _C)), len(model.gradient)
        others = np.delete(np.arange(n), place)
        by_changes = np.zeros((n, n - 1 + _OTHERS))
        by_changes[others, _OTHERS + np.arange(n - 1)] = 1.0
        by_value = by_changes[place].copy()
        by_changes[place, _LOG_SHARE], by_value[_SHARE] = 1.0, 1.0
        by_logs = by_changes.copy()
        by_logs[: len(self.free)] = self._log_directions(base)[self.free] @ by_changes[: len(self.free)]
        slopes = self.prior_factor.jacobian(base, by_logs, {_C: by_value})
        weighted = self.prior_factor.precision @ slopes
        quadratic = slopes.T @ weighted
        of_data, order = np.concatenate([[_SHARE], _OTHERS + np.arange(n - 1)]), np.concatenate([[place], others])
        quadratic[of_data[:, None], of_data] += (model.information - model.prior_information)[order[:, None], order]
        gradient = np.zeros(len(quadratic))  # at the optimum the data's gradient is minus the prior's
        gradient[_LOG_SHARE] = weighted[:, _LOG_SHARE] @ self.prior_factor.residuals(iterate.soil, iterate.gains)
        gradient[_SHARE] = -gradient[_LOG_SHARE]
        found = moments_along_share(quadratic, gradient, SMALL_SHARE)
        if found is None:
            return None
        back = np.argsort(order)
        return Moments(found.mean[back], found.covariance[back[:, None], back])

    def _moments(self, iterate: Iterate, model: QuadraticModel, base: Array) -> Moments | None:
        """Moments of log s, s = k_c's share in K_L, of the other coordinates and of the gains, about the optimum.

        Linearised at the model's soil `base`, as in `_moments_along_c`.
        """
        others = np.arange(1, len(model.gradient))
        by_share = self._by_share(base)
        by_changes = np.zeros((len(others) + 1, len(others) + _OTHERS))  # of log k_c = log s K_L b, log (1 - s) K_L, ..
        by_changes[others, others + _OTHERS - 1] = 1.0
        by_changes[[_K_C, _K_PHI], _OTHERS:] = by_share[_K_C, 1:]
        by_changes[[_K_C, _K_PHI], [_LOG_SHARE, _LOG_REST]] = 1.0
        by_k_c = by_changes[_K_C].copy()
        by_k_c[[_SHARE, _LOG_SHARE]] = 1.0, 0.0
        slopes = self.prior_factor.jacobian(base, by_changes, {_K_C: by_k_c})
        quadratic = slopes.T @ self.prior_factor.precision @ slopes
        of_data = np.concatenate([[_SHARE], others + _OTHERS - 1])
        quadratic[of_data[:, None], of_data] += by_share.T @ (model.information - model.prior_information) @ by_share
        k_c, k_phi = iterate.soil[[_K_C, _K_PHI]]
        share = k_c / (k_c + k_phi * self.coordinates.width)
        of_prior = slopes.T @ self.prior_factor.precision @ self.prior_factor.residuals(iterate.soil, iterate.gains)
        gradient = np.zeros(len(quadratic))  # at the optimum the data's gradient is minus the prior's
        gradient[:_OTHERS] = of_prior[_LOG_REST] * share / (1.0 - share) - of_prior[_LOG_SHARE], *of_prior[1:_OTHERS]
        return moments_along_share(quadratic, gradient, share)

    def _by_share(self, soil: Array) -> Array:
        """Derivatives (F + A, F + A) of coordinates and gains by the same with log k_c's share in place of log k_c."""
        by_share = np.eye(len(self.free) + len(self.active))
        by_share[_K_C, _K_PHI] = 1.0
        by_share[_K_C, : len(self.free)] += np.where(self.free == _N, -soil[_N] * np.log(TYPICAL_DEPTH), 0.0)
        return by_share

    def _gaussian(self, soil: Array, gains: Array, covariance: Array, base: Array | None = None) -> Gaussian:
        """The Gaussian with this covariance (F + A, F + A) of coordinates and active gains, linearised at `base`."""
        free = len(self.free)
        jacobian = self._gain_directions[1:].copy()
        jacobian[:_SOIL, :free] = self._log_directions(soil if base is None else base)
        logs = jacobian @ covariance @ jacobian.T
        if base is None:
            return Gaussian(soil, gains, logs)
        of_base, prior = Gaussian(base, gains, logs), self.coordinates.prior
        return of_base.relinearised(soil, gains, prior, self.coordinates.width)

    def gaussian_with(self, iterate: Iterate, covariance: Array) -> Gaussian:
        """The Gaussian at an iterate with this covariance (F + A, F + A) of coordinates and active gains."""
        return self._gaussian(iterate.soil, iterate.gains, covariance)

    def shifted(self, gaussian: Gaussian, step: Array, covariance: Array) -> Gaussian:
        """A Gaussian shifted by a step (F + A,), with this covariance (F + A, F + A) of the step added."""
        free, gains = len(self.free), gaussian.gains.copy()
        gains[self.active] += step[free:]
        soil = self.coordinates.stepped(gaussian.soil, step[:free])
        added = self._gaussian(gaussian.soil, gains, covariance).covariance
        wider = replace(gaussian, covariance=gaussian.covariance + added)
        return wider.relinearised(soil, gains, self.coordinates.prior, self.coordinates.width)

    def _log_directions(self, soil: Array) -> Array:
        return self.coordinates.log_directions(soil)


def _root_of(covariance: Array) -> Array:
    """R (M, M) with R R' = a covariance (M, M), whose variances may differ by many decades."""
    scale = np.sqrt(covariance.diagonal())
    variance, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * (axes * np.sqrt(np.maximum(variance, 1e-300))) @ axes.T)


class Descent(NamedTuple):
    """The end of a descent.

    Attributes
    ----------
    iterate
        The last iterate, one step after `previous`.
    previous
        The iterate at which `model` was evaluated.
    model
        The quadratic model there, whose step led to `iterate`.
    predicted_decrease
        Squared length of the model's full step in posterior sd.
    iterations
        Evaluations of the model, those before this descent included.
    converged
        Whether the stopping rule says so.
    """

    iterate: Iterate
    previous: Iterate
    model: QuadraticModel
    predicted_decrease: float
    iterations: int
    converged: bool


class StoppingRule(NamedTuple):
    """When `descend_jointly` stops.  All decreases are of -2 log posterior; d is the predicted decrease of a full step.

    ==========  ================================================================================
    reason      condition
    ==========  ================================================================================
    converged   d < step_tolerance, or after a full step d^2 / (d of the full step before) < next_step_tolerance
    stalled     MAX_STALLED steps in a row did not lower the least value by stall_tolerance, and d < STALLED_DECREASE
                at the least value
    given up    value - d > give_up_above
    rejected    more than max_rejected steps in a row were rejected
    exhausted   max_iterations evaluations
    ==========  ================================================================================

    Converged is the last iterate, stalled the one after the least value.  In the other three cases the one after
    the least value counts as converged if d < WARM_STEP_TOLERANCE there; else the descent has not converged.

    Attributes
    ----------
    max_iterations
        Evaluations of the model.
    step_tolerance, next_step_tolerance
        Squared lengths in posterior sd.
    max_rejected
        Rejected steps in a row.
    stall_tolerance
        Decrease that counts as none; 0 where a descent may not end as stalled.
    give_up_above
        Value of the objective above which the fit is of no use.
    """

    max_iterations: int
    step_tolerance: float = STEP_TOLERANCE
    next_step_tolerance: float = NEXT_STEP_TOLERANCE
    max_rejected: int = MAX_REJECTED
    stall_tolerance: float = 0.0
    give_up_above: float = math.inf

    def is_converged(self, decrease: float, previous_decrease: float, is_full_step: bool) -> bool:
        """Whether this step is short, or the next one will be: steps shrink by the ratio of the last two."""
        if decrease < self.step_tolerance:
            return True
        return is_full_step and decrease * decrease < self.next_step_tolerance * previous_decrease

    def is_given_up(self, model: QuadraticModel, decrease: float) -> bool:
        """Whether the predicted value is still too high."""
        return model.neg2_log_posterior - decrease > self.give_up_above

    def is_stalled(self, n_stalled: int, lowest: Descent) -> bool:
        """Whether steps no longer lower the objective: along a curved valley they overshoot without end."""
        return self.stall_tolerance > 0.0 and n_stalled >= MAX_STALLED and lowest.predicted_decrease < STALLED_DECREASE

    def is_lower(self, model: QuadraticModel, lowest: Descent) -> bool:
        """Whether a value is lower than the least so far by at least the stall tolerance."""
        return lowest.model.neg2_log_posterior - model.neg2_log_posterior >= self.stall_tolerance


def descend_jointly(
    objective: Objective, start: Iterate, rule: StoppingRule, previous_decrease: float = 0.0
) -> Descent | None:
    """Gauss-Newton steps of soil, gains and latents together, from near the optimum.

    A step is rejected where it raises the objective by more than ALLOWED_INCREASE.  The descent then returns
    to the last accepted iterate and takes SHORTENING of the step; damping would hold back only the weak
    directions, along which steps overshoot.  At the second rejection in a row the entry angles are solved.
    Full steps that shrink slowly are extrapolated (`_extrapolation`).

    Parameters
    ----------
    objective
        Of the window.
    start
        Near the optimum.
    rule
        When to stop.
    previous_decrease
        Squared length of the step that led to `start`, if it was one of these.

    Returns
    -------
    Descent or None
        None where the numbers are not finite.
    """
    iterate, iterations = start, start.evaluations
    accepted: tuple[Iterate, QuadraticModel] | None = None
    lowest: Descent | None = None
    last_step: Array | None = None
    fraction, last_fraction = 1.0, 1.0
    decrease, allowed_increase, converged = np.inf, np.inf, False
    n_rejected = n_stalled = 0
    for _ in range(rule.max_iterations):
        iterations += 1
        model = objective.quadratic_model(iterate)
        if accepted is not None and (
            model is None or model.neg2_log_posterior > accepted[1].neg2_log_posterior + allowed_increase
        ):
            iterate, model = accepted
            if n_rejected == 1:
                iterate = objective.with_entry_angles(iterate)
                model = objective.quadratic_model(iterate)
            fraction = SHORTENING * min(fraction, 1.0)
            previous_decrease, last_step = 0.0, None  # after a rejected step nothing can be extrapolated
            n_rejected += 1
            if n_rejected > rule.max_rejected:
                break
        else:
            fraction, n_rejected = min(2.0 * fraction, 1.0), 0
        full = None if model is None else model.step()
        if model is None or full is None:
            return None
        is_first = accepted is None
        allowed_increase = (
            ALLOWED_INCREASE + ALLOWED_FIRST_INCREASE * model.neg2_log_posterior if is_first else ALLOWED_INCREASE
        )
        accepted = (iterate, model)
        decrease = model.squared_length(full)
        if last_step is not None and fraction == 1.0:
            fraction = _extrapolation(model, last_step, last_fraction, full)
        iterate = objective.stepped(iterate, model, fraction * full)
        last_step, last_fraction = full, fraction
        converged = rule.is_converged(decrease, previous_decrease, fraction == 1.0)
        previous_decrease = decrease if fraction == 1.0 else 0.0
        if converged or rule.is_given_up(model, decrease):
            break
        n_stalled = 0 if lowest is None or rule.is_lower(model, lowest) else n_stalled + 1
        if lowest is None or model.neg2_log_posterior < lowest.model.neg2_log_posterior:
            lowest = Descent(iterate, *accepted, decrease, iterations, converged=True)
        if rule.is_stalled(n_stalled, lowest):
            return lowest._replace(iterations=iterations)
    if accepted is None:
        return None
    if not converged and lowest is not None and lowest.predicted_decrease < WARM_STEP_TOLERANCE:
        return lowest._replace(iterations=iterations)
    return Descent(iterate, *accepted, decrease, iterations, converged)


def _extrapolation(model: QuadraticModel, last: Array, last_fraction: float, step: Array) -> float:
    """Multiple of a full step (F + A,) to take, from the last one (F + A,) and the fraction of it that was taken.

    Aitken's extrapolation: above 1 where steps shrink slowly, below 1 where they turn back, else 1.
    """
    ratio = 1.0 - (1.0 - float(last @ model.information @ step) / model.squared_length(last)) / last_fraction
    is_slow = abs(ratio) > SLOW_RATIO
    return min(1.0 / max(1.0 - ratio, 1.0 / MAX_EXTRAPOLATION), MAX_EXTRAPOLATION) if is_slow else 1.0


def descend_soil(
    objective: Objective,
    soil: Array,
    max_evaluations: int,
    relative_tolerance: float = SOIL_RELATIVE_TOLERANCE,
    gains: Array | None = None,
    ends: Sequence[Iterate] = (),
    give_up_above: float = np.inf,
) -> Iterate | None:
    """Levenberg-Marquardt steps of the soil and the active gains with the latents as measured.

    It ends where the squared length of a step is below SOIL_STEP_TOLERANCE, where a step lowers the objective
    by less than `relative_tolerance` of it, at `max_evaluations`, or at MAX_DAMPING.  Steps that do not lower the
    objective are rejected and the damping is raised.

    Parameters
    ----------
    objective
        Of the window, or of a few of its instants.
    soil : (6,)
        Start, in SI.
    max_evaluations
        Of the model.
    relative_tolerance
        See above [1].
    gains : (G,), optional
        Start; those of the joint prior if not given.
    ends
        Where other descents ended: one that is predicted to end there ends there at once.
    give_up_above
        Value of the objective: a descent that is predicted to end above it is given up.

    Returns
    -------
    Iterate or None
        None where it is given up, or where there is no further step.
    """
    iterate = objective.start(soil, gains=gains)
    model = objective.quadratic_model(iterate)
    damping, easing, evaluations = FIRST_DAMPING, 0.1, 1
    while model is not None:
        step = model.step(damping)
        if step is None:
            return None
        length = model.squared_length(step)
        if model.neg2_log_posterior - length > give_up_above:
            return None
        if length < SOIL_STEP_TOLERANCE or evaluations >= max_evaluations or damping > MAX_DAMPING:
            return replace(iterate, neg2_log_posterior=model.neg2_log_posterior, evaluations=evaluations)
        for end in ends:
            if _leads_to(objective, iterate, model, step, end):
                return replace(end, evaluations=evaluations)
        new_iterate = objective.stepped_with_measured_latents(iterate, model, step)
        new = objective.quadratic_model(new_iterate)
        evaluations += 1
        if new is None or new.neg2_log_posterior >= model.neg2_log_posterior:
            damping, easing = 10.0 * damping, 1.0
            continue
        decrease = model.neg2_log_posterior - new.neg2_log_posterior
        is_small = decrease < relative_tolerance * model.neg2_log_posterior
        iterate, model, damping, easing = new_iterate, new, damping * easing, 0.1
        if is_small:
            return replace(iterate, neg2_log_posterior=model.neg2_log_posterior, evaluations=evaluations)
    return None


def _leads_to(objective: Objective, iterate: Iterate, model: QuadraticModel, step: Array, end: Iterate) -> bool:
    """Whether a step of the soil comes within OTHER_OPTIMUM_SD of where another descent ended.

    False for a step that the coordinates would shorten: the quadratic model does not hold that far.
    """
    if np.abs(step).max() > MAX_LOG_STEP:
        return False
    off = objective.coordinates.position(end.soil) - objective.coordinates.position(iterate.soil) - step
    return model.squared_length(off) < OTHER_OPTIMUM_SD**2


def _solution(information: Array, right: Array) -> Array | None:
    """information^-1 right (F, M); None where the information is singular."""
    scale = 1.0 / np.sqrt(information.diagonal())
    try:
        return np.asarray(
            np.linalg.solve(information * scale[:, None] * scale, right * scale[:, None]) * scale[:, None]
        )
    except np.linalg.LinAlgError:
        return None
