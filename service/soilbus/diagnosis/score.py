"""Score test: what each effect could explain, predicted from one linearisation at the fitted model.

    H = H_uu - H_uc H_cc^-1 H_cu,   g = g_u - H_uc H_cc^-1 g_c,   u = -(H + I)^-1 g

u are the effect's parameters in units of their prior std, c the coordinates of the present model (soil, sensor gains,
parameters of its effects).  The Schur complement H is the information on u that the present model cannot imitate.
From H and g follow the fall of -2 log posterior if the effect were added, the change of the score, and a start
for the effect's fit (Rao's score test, Bayesian with the prior's precision).

Of several recordings c holds the soil and the own parameters of each, and the gains that all share (`joint_fit`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular
from scipy.optimize import lsq_linear

from soilbus.arrays import Array
from soilbus.diagnosis.blocks import expected_change
from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.diagnosis.joint_fit import JointModel, JointObjective, Start, own_gains
from soilbus.diagnosis.records import Record
from soilbus.estimation.gaussian import Gaussian, solve_with_inverse
from soilbus.estimation.nuisance_parameters import Free, parameters_of
from soilbus.estimation.posterior import NORMAL_95, SoilPrior
from soilbus.estimation.solver import Iterate, Objective
from soilbus.terra.effects.effect import Effect


@dataclass(frozen=True, slots=True)
class Score:
    """Prediction for one effect.

    fall: fall of -2 log posterior; change: of the score of `blocks` (negative where the effect explains
    something); starts: one for each recording, for a fit with the effect.
    """

    effect: Effect
    fall: float
    change: float
    starts: tuple[Start, ...]


def scores(
    records: Sequence[Record], prior: SoilPrior, present: FittedModel, candidates: Sequence[Effect]
) -> list[Score]:
    """Score of every candidate beside the present model, the best first.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where the present model is not finite or its information is singular.
    """
    n_wheels = len(records[0].training.rig.wheels)
    free = [f for effect in candidates for f in parameters_of(effect, n_wheels)]
    equations = normal_equations(records, prior, present, candidates, free)
    found = [_score(effect, free, equations) for effect in candidates]
    return sorted(found, key=lambda score: score.change)


def further_scores(
    records: Sequence[Record], prior: SoilPrior, present: FittedModel, candidates: Sequence[Effect]
) -> list[Score]:
    """The best score of each candidate with further starts, linearised at each of these.

    Where the effect is absent nothing depends on some parameters (the depth of a hardpan), and the score is blind to
    them: it is taken at each of several values (Davies 1977, Biometrika 64:247).
    """
    found: dict[str, Score] = {}
    for group in shifted_effects(candidates):
        by_name = {one.effect.name: one for one in group}
        for score in scores(records, prior, present, [one.shifted for one in by_name.values()]):
            one, best = by_name[score.effect.name], found.get(score.effect.name)
            if best is None or score.change < best.change:
                starts = tuple(_with_offset(start, one.offsets) for start in score.starts)
                found[score.effect.name] = replace(score, effect=one.effect, starts=starts)
    return list(found.values())


class ShiftedEffect(NamedTuple):
    """An effect, the same with one parameter's neutral value shifted, and the shift of each parameter (P,) in std."""

    effect: Effect
    shifted: Effect
    offsets: list[float]


def shifted_effects(candidates: Sequence[Effect]) -> Iterator[list[ShiftedEffect]]:
    """All further starts of the candidates, in groups of at most one for each effect; one that then acts is alone."""
    for group in zip_longest(*(_shifted(effect) for effect in candidates if not effect.late)):
        yield [one for one in group if one is not None]
    yield from ([one] for effect in candidates if effect.late for one in _shifted(effect))


def _shifted(effect: Effect) -> Iterator[ShiftedEffect]:
    """One for each further start of each parameter."""
    for parameter in effect.parameters:
        for value in parameter.starts:
            parameters = tuple(replace(p, neutral=value) if p is parameter else p for p in effect.parameters)
            offsets = [(value - p.neutral) / p.std if p is parameter else 0.0 for p in effect.parameters]
            yield ShiftedEffect(effect, replace(effect, parameters=parameters), offsets)


def _with_offset(start: Start, offsets: Sequence[float]) -> Start:
    """A start of the shifted effect as one of the effect itself, whose parameters come last."""
    gains = start.gains.copy()
    gains[-len(offsets) :] += offsets
    return Start(start.soil, gains)


class Reduced(NamedTuple):
    """Normal equations of the parameters u (P,) of one effect, the present coordinates eliminated; of the data alone.

    gradient is (P,), information (P, P).  All coordinates (n,) follow a step of u: they change by
    offset + response u, offset (n,) and response (n, P).
    """

    gradient: Array
    information: Array
    offset: Array
    response: Array


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Normal equations of all recordings, by the present model's coordinates and the candidates' parameters.

    Attributes
    ----------
    joint, model
        Objective with the present effects and all candidates, and its quadratic model where the present model was
        fitted.
    iterates
        Of each recording there.
    fitted
        The present model.
    n_new
        Number of the candidates' parameters, the last coordinates of each recording.
    solved
        (C, 1 + n): H_cc^-1 (g_c, H_c.) of the C present coordinates.
    """

    joint: JointObjective
    model: JointModel
    iterates: tuple[Iterate, ...]
    fitted: FittedModel
    n_new: int
    present: NDArray[np.intp]
    solved: Array

    @property
    def rise(self) -> float:
        """By how much -2 log posterior is above that of the fit where a candidate acts at its neutral values."""
        by_present = float(self.model.gradient[self.present] @ self.solved[:, 0])  # which they fall by without it
        return self.model.neg2_log_posterior - by_present - self.fitted.neg2_log_posterior

    def reduced(self, parameters: NDArray[np.intp], record: int = 0) -> Reduced:
        """Those of some candidates' parameters (P,); record: the recording, of parameters that each has for itself."""
        u = self.joint.columns[record][-self.n_new :][parameters]
        by_present = self.model.information[np.ix_(u, self.present)]
        gradient, by_u = self.solved[:, 0], self.solved[:, 1 + u]
        offset, response = np.zeros(self.joint.size), np.zeros((self.joint.size, len(u)))
        offset[self.present], response[self.present] = -gradient, -by_u
        response[u] = np.eye(len(u))
        of_data = self.model.information[np.ix_(u, u)] - self.model.prior_information[np.ix_(u, u)]
        return Reduced(self.model.gradient[u] - by_present @ gradient, of_data - by_present @ by_u, offset, response)


def normal_equations(
    records: Sequence[Record],
    prior: SoilPrior,
    present: FittedModel,
    candidates: Sequence[Effect],
    free: Sequence[Free],
) -> NormalEquations:
    """The normal equations of the present model and candidates with these parameters, where it was fitted.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where the present model is not finite or its information is singular.
    """
    P, R, of_record = len(free), len(records), {effect.name: effect.of_record for effect in candidates}
    new_own = np.array([of_record[f.effect] for f in free])
    own = np.concatenate([own_gains(records[0].training.n_sensors, present.effects, present.free), new_own])
    variance = np.where(new_own, 1.0, float(R))
    effects, parameters = (*present.effects, *candidates), (*present.free, *free)
    parts, iterates = [], []
    for record, fit, before in zip(records, present.fits, present.priors, strict=True):
        covariance = block_diag(before.covariance, np.diag(variance))
        extended = Gaussian(before.soil, np.append(before.gains, np.zeros(P)), covariance)
        parts.append(Objective(record.training.with_effects(effects, parameters), prior, extended))
        gains = np.append(fit.optimum.gains, np.zeros(P))
        iterates.append(Iterate(fit.optimum.soil, gains, fit.optimum.latents))
    joint = JointObjective(parts, own)
    with np.errstate(all="ignore"):
        model = joint.quadratic_model(tuple(iterates))
    if model is None:
        raise np.linalg.LinAlgError("the model is not finite where it was fitted")
    new = np.unique([columns[-P:] for columns in joint.columns])
    c = np.setdiff1d(np.arange(joint.size), new)
    inverse = solve_with_inverse(model.information[np.ix_(c, c)], np.zeros(len(c)))
    if inverse is None:
        raise np.linalg.LinAlgError("the present model's information is singular")
    solved = inverse[1] @ np.column_stack([model.gradient[c], model.information[c]])
    return NormalEquations(joint, model, tuple(iterates), present, P, c, solved)


def _score(effect: Effect, free: Sequence[Free], equations: NormalEquations) -> Score:
    """One effect's score over all recordings; an effect of the record has parameters of its own in each."""
    parameters = np.array([i for i, f in enumerate(free) if f.effect == effect.name])
    own, recordings = [free[i] for i in parameters.tolist()], range(len(equations.iterates))
    parts = [equations.reduced(parameters, i) for i in (recordings if effect.of_record else (0,))]
    solutions = [_bounded_minimum(one.information + np.eye(len(own)), one.gradient, own) for one in parts]
    starts = []
    for i in recordings:
        of_own = i if effect.of_record else 0
        starts.append(_start(equations, i, parameters, parts[of_own], solutions[of_own].step))
    rise = equations.rise if effect.late else 0.0  # from a further start of a delay
    fall = sum(solution.fall for solution in solutions) - rise
    return Score(effect, fall, sum(solution.change for solution in solutions) + rise, tuple(starts))


class _Minimum(NamedTuple):
    """Step of the parameters (P,) in prior std, fall of -2 log posterior, and change of the score."""

    step: Array
    fall: float
    change: float


def _bounded_minimum(information: Array, gradient: Array, free: Sequence[Free]) -> _Minimum:
    """Minimum of the quadratic model with the parameters (P,) inside their ranges.

    information (P, P) includes the prior's, the identity.  With information = L L' the minimum is that of the bounded
    least squares problem |L' u + L^-1 gradient|^2, solved by an active set method (Stark & Parker 1995, Comput. Stat.
    10:129).
    """
    low, high = (np.array([(getattr(f.parameter, edge) - f.value) / f.std for f in free]) for edge in ("low", "high"))
    root = np.linalg.cholesky(information)
    found = lsq_linear(root.T, -solve_triangular(root, gradient, lower=True), (low, high), method="bvls")
    step, inside = found.x, found.active_mask == 0
    fall = float(-2.0 * gradient @ step - step @ information @ step)
    length = float(step @ step)
    if not inside.any():
        return _Minimum(step, fall, -fall - length)
    kept = np.ix_(inside, inside)
    of_data, vector = information[kept] - np.eye(int(inside.sum())), information[kept] @ step[inside]
    of_inside = step[inside] @ vector + float(step[inside] @ step[inside])  # the fall of -2 log likelihood by them
    return _Minimum(step, fall, expected_change(of_data, vector) + of_inside - fall - length)


def _start(
    equations: NormalEquations, record: int, parameters: NDArray[np.intp], reduced: Reduced, step: Array
) -> Start:
    """Where a fit of one recording with the effect begins: at the step (P,), shortened to the prior's 95 % interval."""
    share = min(1.0, NORMAL_95 / max(float(np.abs(step).max(initial=0.0)), 1e-12))
    objective, iterate = equations.joint.parts[record], equations.iterates[record]
    change = (reduced.offset + reduced.response @ (share * step))[equations.joint.columns[record]]
    n_free, n_present = len(objective.free), len(iterate.gains) - equations.n_new
    soil, gains = objective.coordinates.stepped(iterate.soil, change[:n_free]), iterate.gains.copy()
    gains[objective.active] += change[n_free:]
    standardised = np.append(equations.fitted.unheld(gains[:n_present]), gains[n_present + parameters])
    start = Start(soil, standardised, checked=equations.fitted.checks[record].latents)
    if share < 1.0:
        return start
    at = equations.model.parts[record].linearisation
    latents = objective.problem.updated(at, iterate.latents, soil - iterate.soil, gains - iterate.gains)
    return start._replace(near_optimum=True, latents=latents)
