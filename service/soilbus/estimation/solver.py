"""One Gauss-Newton step on a window: normal equations of the residuals and of what was known before.

Descents of one fit: far from the optimum by the soil alone, near it by soil, gains and latents together.
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
    MAX_STEP,
    TYPICAL_DEPTH,
    Coordinates,
    Moments,
    at_edges,
    moments_along_share,
    step_share_within,
)
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.terra.wheel import Soil

LONG_TURN = 0.2
"""Relative change of an entry angle from which the angles are solved again, not extrapolated."""
LONG_TURN_WITH_EFFECTS = 0.1
"""The same where effects have a part in the load: they may bend where the soil alone does not."""
WELL_TOLD = 0.5
"""Sd of the logarithm of K_L at a typical depth from which on k_c and k_phi are each as known before."""
_SOIL = len(PARAMETERS)
_K_C, _K_PHI, _N = (PARAMETERS.index(name) for name in ("k_c", "k_phi", "n"))


@dataclass(frozen=True, slots=True)
class Iterate:
    """A soil (6,) in SI with gains (G,) and latents, what it costs, and how many evaluations led there."""

    soil: Array
    gains: Array
    latents: Latents
    neg2_log_posterior: float
    trials: int

    def as_soil(self) -> Soil:
        """The soil by name."""
        return Soil(*self.soil.tolist())


@dataclass(frozen=True, slots=True)
class QuadraticModel:
    """Normal equations by the free coordinates (F) and active gains (A) at one place.

    information (F + A, F + A) is Gauss-Newton's, of which `prior_information` is what was known
    before; bend, which comes on top for a step, is the curvature of the coordinates.
    cost is -2 log posterior up to a constant.  edges (E, F + A) are the directions in which
    no step can go.
    """

    information: Array
    prior_information: Array
    curvature: Array
    gradient: Array
    neg2_log_posterior: float
    edges: Array
    at: Linearisation

    def step(self, damping: float = 0.0, gradient: Array | None = None) -> Array | None:
        """Step (F + A,) to the minimum, held back in proportion to the diagonal; None where there is none.

        A step that would go beyond an edge goes along it, to where the cost then is least.
        With another gradient it is that of the parabola with that slope here.
        """
        gradient = self.gradient if gradient is None else gradient
        curved = self.information + self.curvature
        curved.flat[:: len(curved) + 1] *= 1.0 + damping
        solution = _solution(curved, np.concatenate([gradient[None], self.edges]).T)
        if solution is None:
            return None
        step = -solution[:, 0]
        if not len(self.edges):
            return step if np.isfinite(step).all() else None
        held = np.zeros(len(self.edges), bool)
        while (beyond := ~held & (self.edges @ step > 0.0)).any():
            held |= beyond
            along, edges = solution[:, 1:][:, held], self.edges[held]
            step = along @ np.linalg.lstsq(edges @ along, edges @ solution[:, 0], rcond=None)[0] - solution[:, 0]
        return step if np.isfinite(step).all() else None

    @property
    def neg2_log_evidence(self) -> float:
        """-2 log of the data's likelihood whatever the soil may be (Laplace), up to the same constant."""
        return self.neg2_log_posterior + float(
            np.linalg.slogdet(self.information)[1] - np.linalg.slogdet(self.prior_information)[1]
        )

    def length(self, step: Array) -> float:
        """Squared length of a step in standard deviations."""
        return float(step @ self.information @ step)


class GaussianApproximation(NamedTuple):
    """A window that is linear about an optimum: what its data and what was known before tell there.

    directions (1 + 6 + G, F + A): as Fitting.directions; known: what was known before; step (F + A,), to be taken
    off, and covariance (F + A, F + A): to the minimum of the parabola, and there.
    """

    directions: Array
    prior: PriorQuadratic
    step: Array
    covariance: Array

    def explained(self, mixed: Array) -> tuple[Array, Array]:
        """What soil and gains take up of gradient (K,) and information (K, K) of further unknowns; mixed (K, F + A)."""
        return mixed @ self.step, mixed @ self.covariance @ mixed.T


class Objective:
    """A window's residuals and those of its prior (`prior_factor`): free coordinates (F), active gains (A)."""

    def __init__(
        self,
        problem: ObservationModel,
        prior: SoilPrior,
        joint_prior: Gaussian,
        with_gains: bool = True,
        first: int = 0,
    ) -> None:
        """Raises ValueError where `joint_prior` has no proper covariance; gains before the `first` one are held."""
        self.problem, self.joint_prior = problem, joint_prior
        self.coordinates = Coordinates(prior, float(problem.rig.width.mean()))
        known = np.diag(joint_prior.covariance)[_SOIL:] > 0.0 if with_gains else np.zeros(len(joint_prior.gains), bool)
        known[:first] = False
        self.active = np.flatnonzero(known)
        self._gain_bounds = tuple(bound[self.active] for bound in problem.gain_bounds())
        self._has_bounds = bool(np.isfinite(self._gain_bounds).any())
        self.free = self.coordinates.free
        self._identity = np.eye(len(self.free) + len(self.active))
        self._of_gains = np.zeros((FIRST_GAIN + len(joint_prior.gains), len(self._identity)))
        self._of_gains[FIRST_GAIN + self.active] = self._identity[len(self.free) :]
        self._by_sensors = with_gains and first == 0
        self.prior_factor = PriorFactor(joint_prior, prior, self.active)
        self._last: tuple[Array, Array, PriorQuadratic] | None = None
        self._approximation: tuple[Optimum, GaussianApproximation | None] | None = None

    def given(self, joint_prior: Gaussian) -> Objective:
        """The same with something else known before."""
        return Objective(self.problem, self.coordinates.prior, joint_prior)

    def start(self, soil: Array, guess: Array | None = None, gains: Array | None = None) -> Iterate:
        """A soil with gains as believed, or these (G,), and latents as measured; angles solved from a guess (N, W)."""
        gains = self.joint_prior.gains if gains is None else gains
        return Iterate(soil, gains, self.problem.start(Soil(*soil.tolist()), guess, gains), np.inf, 0)

    def near(self, soil: Array, gains: Array, latents: Latents | None) -> Iterate:
        """A soil with gains (G,) and the latents foreseen there where they are of these instants, else as measured."""
        if latents is None or latents.load.shape != (self.problem.n, self.problem.n_wheels):
            return self.start(soil, gains=gains)
        return Iterate(soil, gains, latents, np.inf, 0)

    def stepped_with_measured_latents(self, place: Iterate, point: QuadraticModel, step: Array) -> Iterate:
        """The place after a step (F + A,) with latents as measured, as they are at this place already."""
        free, gains = len(self.free), place.gains.copy()
        step = self.step_share(place, step) * step
        gains[self.active] += step[free:]
        soil, gains = self.coordinates.moved(place.soil, step[:free]), self.problem.allowed(gains)
        angle = self.problem.stepped_entry_angle(
            point.at, place.latents.entry_angle, soil - place.soil, gains - place.gains
        )
        return self._reached(place, point, soil, gains, replace(place.latents, entry_angle=angle))

    def point(self, place: Iterate) -> QuadraticModel | None:
        """The normal equations at a place; None where the model is not finite."""
        at = self.problem.linearise(place.as_soil(), place.gains, place.latents, self._by_sensors)
        return self.with_prior(place, at)

    def with_prior(self, place: Iterate, at: Linearisation) -> QuadraticModel | None:
        """Those of residuals linearised already."""
        free = len(self.free)
        directions = self.directions(place)
        if not self._by_sensors:
            directions = np.delete(directions, self.problem.layout.sensor_columns, axis=0)
        gradient = directions.T @ at.normal[:, 0]
        known = self.prior_at(place)
        cost = at.chi2 + known.neg2_log_prior
        if not math.isfinite(cost):
            return None
        curvature = np.zeros_like(self._identity)
        curvature[:free, :free] = self.coordinates.curvature((gradient + known.of_data)[:free])
        return QuadraticModel(
            information=directions.T @ at.normal @ directions + known.information,
            prior_information=known.information,
            curvature=curvature,
            gradient=gradient + known.gradient,
            neg2_log_posterior=cost,
            edges=self._edges(place),
            at=at,
        )

    def prior_at(self, place: Iterate) -> PriorQuadratic:
        """What was known before, seen from a place; asked again from the last one's soil and gains, it is at hand."""
        if self._last is None or self._last[0] is not place.soil or self._last[1] is not place.gains:
            by_logs = self._identity.copy()
            by_logs[: len(self.free), : len(self.free)] = self._log_directions(place.soil)[self.free]
            self._last = place.soil, place.gains, self.prior_factor.quadratic_at(place.soil, place.gains, by_logs)
        return self._last[2]

    def approximation_at(self, optimum: Optimum) -> GaussianApproximation | None:
        """The linear window about an optimum, at hand when asked for it again; None where it tells nothing."""
        if self._approximation is None or self._approximation[0] is not optimum:
            place = Iterate(optimum.soil, optimum.gains, optimum.latents, math.nan, 0)
            directions, known = self.directions(place), self.prior_at(place)
            by_unknowns = directions.T @ optimum.at.normal
            solution = solve_with_inverse(
                by_unknowns @ directions + known.information, by_unknowns[:, 0] + known.gradient
            )
            self._approximation = (
                optimum,
                None if solution is None else GaussianApproximation(directions, known, *solution),
            )
        return self._approximation[1]

    def parameter_jacobian(self, optimum: Optimum) -> Array:
        """Derivatives (6 + G, F + A) of the soil's logarithms and the gains by coordinates and active gains there."""
        spread = self._of_gains[1:].copy()
        spread[:_SOIL, : len(self.free)] = self._log_directions(optimum.soil)
        return spread

    def prior_jacobian(self, optimum: Optimum) -> Array:
        """Derivatives (R, F + A) of the residuals of what was known before."""
        kept = np.concatenate([self.free, _SOIL + self.active])
        return self.prior_factor.jacobian(optimum.soil, self.parameter_jacobian(optimum)[kept])

    def directions(self, place: Iterate) -> Array:
        """What a column of Linearised.rows (1 + 6 + G) has of each coordinate and active gain (F + A)."""
        directions = self._of_gains.copy()
        directions[SOIL, : len(self.free)] = place.soil[:, None] * self._log_directions(place.soil)
        return directions

    def stepped(self, place: Iterate, point: QuadraticModel, step: Array) -> Iterate:
        """The place after a step (F + A,), with the latents that the linear model foresees."""
        free = len(self.free)
        step = self.step_share(place, step) * step
        soil = self.coordinates.moved(place.soil, step[:free])
        gain_step = np.zeros(len(place.gains))
        gain_step[self.active] = step[free:]
        latents = self.problem.updated(point.at, place.latents, soil - place.soil, gain_step)
        return self._reached(place, point, soil, place.gains + gain_step, latents)

    def second_derivative(self, place: Iterate, point: QuadraticModel, step: Array, there: QuadraticModel) -> Array:
        """Second derivative of the residuals (R,) along a step (F + A,) that led from the place to `there`."""
        straight = point.at.rows @ (self.directions(place) @ step)
        return np.asarray(2.0 * (there.at.rows[:, 0] - point.at.rows[:, 0] - straight))

    def geodesic_step(self, place: Iterate, point: QuadraticModel, share: float, bend: Array) -> Array | None:
        """A share of the full step that bends (R,) as the valley does (F + A,); None where there is no step.

        Geodesic acceleration: Transtrum & Sethna 2012, arXiv:1201.5885.
        """
        turning = self.directions(place).T @ (point.at.weighed.T @ bend)
        return point.step(gradient=share * point.gradient + 0.5 * share**2 * turning)

    def _edges(self, place: Iterate) -> Array:
        """Directions (E, F + A) in which no step from there can go."""
        of_soil = self.coordinates.edges(place.soil)
        if not (self._has_bounds or len(of_soil)):
            return self._identity[:0]
        at = at_edges(place.gains[self.active], *self._gain_bounds)
        own = np.flatnonzero(at)
        edges = np.zeros((len(of_soil) + len(own), len(self.free) + len(self.active)))
        edges[: len(of_soil), : len(self.free)] = of_soil
        edges[len(of_soil) + np.arange(len(own)), len(self.free) + own] = at[own]
        return edges

    def step_share(self, place: Iterate, step: Array) -> float:
        """Share of a step (F + A,) that can be taken."""
        free = len(self.free)
        of_soil = self.coordinates.step_share(place.soil, step[:free])
        if not self._has_bounds:
            return of_soil
        low, high = self._gain_bounds
        room = np.where(step[free:] > 0.0, high, low) - place.gains[self.active]
        return min(of_soil, step_share_within(room, step[free:]))

    def _reached(self, place: Iterate, point: QuadraticModel, soil: Array, gains: Array, latents: Latents) -> Iterate:
        """Soil (6,), gains (G,) and foreseen latents as a place, with the entry angles solved where they turn far."""
        turn = np.abs(latents.entry_angle / place.latents.entry_angle - 1.0).max(initial=0.0)
        if turn > (LONG_TURN_WITH_EFFECTS if len(point.at.load_by_effects) else LONG_TURN):
            latents = self.problem.with_entry_angles(latents, Soil(*soil.tolist()), gains)
        return Iterate(soil, gains, latents, point.neg2_log_posterior, place.trials)

    def with_entry_angles(self, place: Iterate) -> Iterate:
        """The same place with the entry angles solved anew: linear models in a row may have lost them."""
        return replace(place, latents=self.problem.with_entry_angles(place.latents, place.as_soil(), place.gains))

    def gaussians_at(self, place: Iterate, point: QuadraticModel, at: Array) -> tuple[Gaussian, Gaussian] | None:
        """What this optimum tells, by its moments and by its curvature; None where the information is singular.

        The point is of a soil (6,) one step away, `at`.  Without moments that are finite both are the curvature's.
        """
        inverse = solve_with_inverse(point.information, point.gradient)
        if inverse is None:
            return None
        covariance = inverse[1]
        mode = self._gaussian(place.soil, place.gains, covariance, at)
        if not {_K_C, _K_PHI} <= set(self.free.tolist()) or covariance[_K_PHI, _K_PHI] > WELL_TOLD**2:
            return mode, mode
        moments = self._moments(place, point)
        if moments is None:
            return mode, mode
        free, gains = len(self.free), place.gains.copy()
        step = self._by_share(place.soil) @ moments.mean
        soil = self.coordinates.soil_at(self.coordinates.position(place.soil) + step[:free])
        gains[self.active] += step[free:]
        by_share = self._by_share(soil)
        return self._gaussian(soil, gains, by_share @ moments.covariance @ by_share.T), mode

    def _moments(self, place: Iterate, point: QuadraticModel) -> Moments | None:
        """Moments of the logarithm of k_c's share in K_L, the other coordinates and the gains, about the optimum."""
        others = np.arange(1, len(point.gradient))
        by_share = self._by_share(place.soil)
        by_changes = np.zeros((len(others) + 1, len(others) + 3))  # of what was known: k_c and k_phi have s K_L each
        by_changes[others, others + 2] = 1.0
        by_changes[[_K_C, _K_PHI], 3:] = by_share[_K_C, 1:]
        by_changes[[_K_C, _K_PHI], [1, 2]] = 1.0
        by_k_c = by_changes[_K_C].copy()
        by_k_c[[0, 1]] = 1.0, 0.0
        slopes = self.prior_factor.jacobian(place.soil, by_changes, by_k_c)
        quadratic = slopes.T @ self.prior_factor.precision @ slopes
        of_data = np.concatenate([[0], others + 2])
        quadratic[of_data[:, None], of_data] += by_share.T @ (point.information - point.prior_information) @ by_share
        k_c, k_phi = place.soil[[_K_C, _K_PHI]]
        share = k_c / (k_c + k_phi * self.coordinates.width)
        pull = slopes.T @ self.prior_factor.precision @ self.prior_factor.residuals(place.soil, place.gains)
        gradient = np.zeros(len(quadratic))
        gradient[:3] = pull[2] * share / (1.0 - share) - pull[1], *pull[1:3]  # the data pull as much the other way
        return moments_along_share(quadratic, gradient, share)

    def _by_share(self, soil: Array) -> Array:
        """Derivatives (F + A, F + A) of the coordinates, where log k_c is one, by those where that of its share is."""
        by_share = np.eye(len(self.free) + len(self.active))
        by_share[_K_C, _K_PHI] = 1.0
        by_share[_K_C, : len(self.free)] += np.where(self.free == _N, -soil[_N] * np.log(TYPICAL_DEPTH), 0.0)
        return by_share

    def _gaussian(self, soil: Array, gains: Array, covariance: Array, at: Array | None = None) -> Gaussian:
        """The belief with this covariance (F + A, F + A) of coordinates and active gains, there or at a soil nearby."""
        free = len(self.free)
        spread = self._of_gains[1:].copy()
        spread[:_SOIL, :free] = self._log_directions(soil if at is None else at)
        return Gaussian(soil, gains, spread @ covariance @ spread.T)

    def gaussian_with(self, place: Iterate, covariance: Array) -> Gaussian:
        """A place with the covariance (F + A, F + A) of its coordinates and active gains."""
        return self._gaussian(place.soil, place.gains, covariance)

    def shifted(self, gaussian: Gaussian, step: Array, covariance: Array) -> Gaussian:
        """A belief after a step (F + A,) that brings as much covariance (F + A, F + A) with it."""
        free, gains = len(self.free), gaussian.gains.copy()
        gains[self.active] += step[free:]
        added = self._gaussian(self.coordinates.moved(gaussian.soil, step[:free]), gains, covariance)
        return replace(added, covariance=gaussian.covariance + added.covariance)

    def _log_directions(self, soil: Array) -> Array:
        return self.coordinates.log_directions(soil)


def _solution(information: Array, right: Array) -> Array | None:
    """information^-1 right (F, M); None where the information is singular."""
    scale = 1.0 / np.sqrt(information.diagonal())
    try:
        return np.asarray(
            np.linalg.solve(information * scale[:, None] * scale, right * scale[:, None]) * scale[:, None]
        )
    except np.linalg.LinAlgError:
        return None


CONVERGED, CONVERGED_RESUMED = 1e-6, 3e-3
"""Squared length of a step in posterior standard deviations that ends the fit, and one that is resumed from the
window before: what such a step leaves behind is much less."""
LEFT_OVER, LEFT_OVER_RESUMED = 2e-8, 1e-4
"""The same for what a full step leaves behind, foreseen from how fast the steps shrink."""
SETTLING = 1.0
"""The same, below which the latents and gains join in."""
ENOUGH = 0.02
"""Relative fall of the cost below which the approach has done its part."""
LITTLE = 1e-3
"""The same where other parameters than the soil's move too."""
WORSE = 20.0
"""Rise of the cost that a step may bring: where the cost bends, steps that overshoot come back by themselves."""
AT_FIRST = 0.02
"""Share of the cost by which it may rise besides at the first step: with latents as measured it seems too low."""
SLOWLY = 0.5
"""Length of a step over that of the last, along it, above which steps are extrapolated."""
MAX_STRIDE = 8.0
MAX_REFUSED = 5
"""Steps taken back one after the other after which a fit has failed: what is left is noise of the linear model."""
IDLE, NEARLY = 2, 1.0
"""Steps in a row that do not lower the cost, and how little they must foresee, after which no further one will."""
FAR = 10.0
"""Standard deviations on a few instants beyond which an end is not the optimum looked at."""


class Descent(NamedTuple):
    """Where a descent ended: the place one step on from the `last` one, whose `point` foresaw it.

    length is the squared length of that step in posterior standard deviations.
    """

    place: Iterate
    last: Iterate
    point: QuadraticModel
    length: float
    iterations: int
    converged: bool


def descend_soil(
    fitting: Objective,
    soil: Array,
    most: int,
    least: float = ENOUGH,
    gains: Array | None = None,
    known: Sequence[Iterate] = (),
    give_up_above: float = np.inf,
) -> Iterate | None:
    """Levenberg-damped steps of the soil and the active gains, latents as measured, until they are short.

    A descent that is foreseen to end at one of the `prior_information` places ends there at once; one
    that is foreseen to cost more than `give_up_above`, or that has no further step, is None.
    """
    place = fitting.start(soil, gains=gains)
    point = fitting.point(place)
    damping, ease, trials = 1e-3, 0.1, 1
    while point is not None:
        step = point.step(damping)
        if step is None:
            return None
        length = point.length(step)
        if point.neg2_log_posterior - length > give_up_above:
            return None
        if length < SETTLING or trials >= most or damping > 1e6:
            return replace(place, neg2_log_posterior=point.neg2_log_posterior, trials=trials)
        for end in known:
            if _leads_to(fitting, place, point, step, end):
                return replace(end, trials=trials)
        new_place = fitting.stepped_with_measured_latents(place, point, step)
        new = fitting.point(new_place)
        trials += 1
        if new is None or new.neg2_log_posterior >= point.neg2_log_posterior:
            damping, ease = 10.0 * damping, 1.0
            continue
        enough = point.neg2_log_posterior - new.neg2_log_posterior < least * point.neg2_log_posterior
        place, point, damping, ease = new_place, new, damping * ease, 0.1
        if enough:
            return replace(place, neg2_log_posterior=point.neg2_log_posterior, trials=trials)
    return None


def _leads_to(fitting: Objective, place: Iterate, point: QuadraticModel, step: Array, end: Iterate) -> bool:
    """Whether a step of the soil comes so near to where another descent ended that this one will end there too.

    Only a short step is trusted to tell.
    """
    if np.abs(step).max() > MAX_STEP:
        return False
    off = fitting.coordinates.position(end.soil) - fitting.coordinates.position(place.soil) - step
    return point.length(off) < FAR**2


def _stride(point: QuadraticModel, last: Array, share: float, step: Array) -> float:
    """How many times a step to go that follows this share of the last one (Aitken's extrapolation).

    More than once where steps shrink slowly, less where they turn back.
    """
    left = 1.0 - (1.0 - float(last @ point.information @ step) / point.length(last)) / share
    return min(1.0 / max(1.0 - left, 1.0 / MAX_STRIDE), MAX_STRIDE) if abs(left) > SLOWLY else 1.0


def descend_jointly(
    fitting: Objective,
    near: Iterate,
    most: int,
    left_over: float = LEFT_OVER,
    previous_length: float = 0.0,
    refusals: int = MAX_REFUSED,
    give_up_above: float = np.inf,
    enough: float = CONVERGED,
    nothing: float = 0.0,
) -> Descent | None:
    """Steps of soil, gains and latents together from a place near the optimum.

    `joint_prior` is the squared length of the step that led there, if it was one of these; a step
    of less than `enough` is the last, and one after which the cost twice fell by less than
    `nothing` though little more was foreseen: along a bent valley steps overshoot for ever.
    Given up after more `refusals` in a row, and where the foreseen cost is above `give_up_above`.
    None where the numbers stop being finite.

    A step that makes things worse is taken back and tried again shorter: damping would
    hold back just the weak directions, along which the steps overshoot.
    """
    best: tuple[Iterate, QuadraticModel] | None = None
    share, length, refused = 1.0, np.inf, 0
    iterations, converged = near.trials, False
    last_step: Array | None = None
    last_share = 1.0
    worse = np.inf
    lowest: Descent | None = None
    idle = 0
    for _ in range(most):
        iterations += 1
        point = fitting.point(near)
        if best is not None and (point is None or point.neg2_log_posterior > best[1].neg2_log_posterior + worse):
            near, point = best
            if refused == 1:
                near = fitting.with_entry_angles(near)
                point = fitting.point(near)
            share = 0.4 * min(share, 1.0)
            previous_length, last_step = 0.0, None  # nothing can be foreseen after a refused step
            refused += 1
            if refused > refusals:
                break
        else:
            share, refused = min(2.0 * share, 1.0), 0
        full = None if point is None else point.step()
        if point is None or full is None:
            return None
        worse = WORSE if best is not None else WORSE + AT_FIRST * point.neg2_log_posterior
        best = (near, point)
        length = point.length(full)
        if last_step is not None and share == 1.0:
            share = _stride(point, last_step, last_share, full)
        near = fitting.stepped(near, point, share * full)
        last_step, last_share = full, share
        converged = length < enough or (share == 1.0 and length * length < left_over * previous_length)
        previous_length = length if share == 1.0 else 0.0
        if converged or point.neg2_log_posterior - length > give_up_above:
            break
        idle = (
            idle + 1
            if lowest is not None and lowest.point.neg2_log_posterior - point.neg2_log_posterior < nothing
            else 0
        )
        if lowest is None or point.neg2_log_posterior < lowest.point.neg2_log_posterior:
            lowest = Descent(near, *best, length, iterations, converged=True)
        if nothing > 0.0 and idle >= IDLE and lowest.length < NEARLY:
            return lowest._replace(iterations=iterations)
    if best is None:
        return None
    if not converged and lowest is not None and lowest.length < CONVERGED_RESUMED:
        return lowest._replace(iterations=iterations)
    return Descent(near, *best, length, iterations, converged)
