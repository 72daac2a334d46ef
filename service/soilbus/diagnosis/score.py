"""Score test: what each effect could explain, predicted from one linearisation at the fitted model.

    H = H_uu - H_uc H_cc^-1 H_cu,   g = g_u - H_uc H_cc^-1 g_c,   u = -(H + I)^-1 g

u are the effect's parameters in units of their prior std, c the coordinates of the present model (soil, sensor gains,
parameters of its effects).  The Schur complement H is the information on u that the present model cannot imitate.
From H and g follow the fall of -2 log posterior if the effect were added, the change of -2 log evidence, and a start
for the effect's fit (Rao's score test, Bayesian with the prior's precision).

Of several recordings c holds the soil and the own parameters of each, and the gains that all share: each recording's
own coordinates are eliminated, the equations in (gains, u) added up, and then the gains eliminated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from soilbus.arrays import Array
from soilbus.diagnosis.evidence import mixture_neg2_log_evidence
from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.diagnosis.records import Record
from soilbus.estimation.gaussian import Gaussian, solve_with_inverse
from soilbus.estimation.multistart import Start
from soilbus.estimation.nuisance_parameters import Free, parameters_of
from soilbus.estimation.observation_model import Latents
from soilbus.estimation.posterior import NORMAL_95, PARAMETERS, SoilPrior
from soilbus.estimation.solver import Iterate, Objective, QuadraticModel
from soilbus.terra.effects.effect import Effect


@dataclass(frozen=True, slots=True)
class Score:
    """Prediction for one effect.

    fall: fall of -2 log posterior; neg2_log_evidence: change of -2 log evidence (negative where the effect explains
    something); starts: one for each recording, for a fit with the effect.
    """

    effect: Effect
    fall: float
    neg2_log_evidence: float
    starts: tuple[Start, ...]


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Normal equations of one recording, reduced to the P parameters of candidate effects.

    gradient (P,) and information (P, P) are of the data alone, without the parameters' prior.  response (C, P) is
    H_cc^-1 H_cu: the present coordinates follow a step u by -response u.  fitted is the present model.
    is_own (C,): which present coordinates belong to this recording alone.
    """

    objective: Objective
    iterate: Iterate
    quadratic: QuadraticModel
    is_own: NDArray[np.bool_]
    gradient: Array
    information: Array
    response: Array
    held_out_latents: Latents
    fitted: FittedModel

    @property
    def shared_gains(self) -> NDArray[np.intp]:
        """Indices (S,) of the gains that move and that all recordings share."""
        present = self.objective.active[: len(self.objective.active) - len(self.gradient)]
        return np.asarray(present[~self.is_own[len(self.objective.free) :]])


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
    joint = joint_equations(equations)
    found = []
    for effect in candidates:
        columns = np.array([i for i, f in enumerate(free) if f.effect == effect.name])
        found.append(_score(effect, columns, free, equations, joint))
    return sorted(found, key=lambda score: score.neg2_log_evidence)


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
            if best is None or score.neg2_log_evidence < best.neg2_log_evidence:
                starts = tuple(_with_offset(start, one.offsets) for start in score.starts)
                found[score.effect.name] = replace(score, effect=one.effect, starts=starts)
    return list(found.values())


class ShiftedEffect(NamedTuple):
    """An effect, the same with one parameter's neutral value shifted, and the shift of each parameter (P,) in std."""

    effect: Effect
    shifted: Effect
    offsets: list[float]


def shifted_effects(candidates: Sequence[Effect]) -> Iterator[list[ShiftedEffect]]:
    """All further starts of the candidates, in groups of at most one for each effect."""
    for group in zip_longest(*(_shifted(effect) for effect in candidates)):
        yield [one for one in group if one is not None]


def _shifted(effect: Effect) -> Iterator[ShiftedEffect]:
    """One for each further start of each parameter."""
    for parameter in effect.parameters:
        for value in parameter.starts:
            parameters = tuple(replace(p, neutral=value) if p is parameter else p for p in effect.parameters)
            offsets = [
                (value - parameter.neutral) / parameter.std if p is parameter else 0.0 for p in effect.parameters
            ]
            yield ShiftedEffect(effect, replace(effect, parameters=parameters), offsets)


def _with_offset(start: Start, offsets: Sequence[float]) -> Start:
    """A start of the shifted effect as one of the effect itself, whose parameters come last."""
    gains = start.gains.copy()
    gains[-len(offsets) :] += offsets
    return Start(start.soil, gains)


def normal_equations(
    records: Sequence[Record],
    prior: SoilPrior,
    present: FittedModel,
    candidates: Sequence[Effect],
    free: Sequence[Free],
) -> list[NormalEquations]:
    """The reduced normal equations of each recording for candidates with these parameters."""
    return [_reduced(record, prior, present, i, candidates, free) for i, record in enumerate(records)]


@dataclass(frozen=True, slots=True)
class JointEquations:
    """Normal equations of all recordings, reduced to the P parameters that they share.

    gradient (P,) and information (P, P) are of the data alone.  follow: of each recording, how its present coordinates
    (C,) change with no effect, and by u (C, P).
    """

    gradient: Array
    information: Array
    follow: tuple[tuple[Array, Array], ...]


def joint_equations(equations: Sequence[NormalEquations]) -> JointEquations:
    """The normal equations of all recordings together, in which the gains that they share are the same.

    Each is taken about its own optimum, without what its prior holds of the others; the gains' prior is added once.
    """
    parts = [_without_own(one) for one in equations]
    at, shared = equations[-1].iterate.gains, equations[0].shared_gains
    information, gradient = np.zeros_like(parts[0].information), np.zeros(len(parts[0].gradient))
    gains = slice(None, len(shared))
    first = equations[0].fitted.first_prior
    precision = _precision(first, shared)
    information[gains, gains] = precision
    gradient[gains] = precision @ (at[shared] - first.gains[shared])
    moved = []
    for one, part in zip(equations, parts, strict=True):
        moved.append((at - one.iterate.gains)[shared])
        information += part.information
        gradient += part.gradient + part.information[:, : len(shared)] @ moved[-1]
    u = slice(len(shared), None)
    solved = np.linalg.solve(information[gains, gains], np.column_stack([gradient[gains], information[gains, u]]))
    follow = []
    for one, part, change in zip(equations, parts, moved, strict=True):
        step = np.column_stack([change, np.zeros((len(shared), len(one.gradient)))]) - solved
        present = np.zeros((len(one.is_own), step.shape[1]))
        present[~one.is_own] = step
        present[one.is_own] = -part.own_solved[:, : 1 + len(one.gradient)] - part.own_by_gains @ step
        follow.append((present[:, 0], present[:, 1:]))
    return JointEquations(
        gradient[u] - information[u, gains] @ solved[:, 0],
        information[u, u] - information[u, gains] @ solved[:, 1:],
        tuple(follow),
    )


class _WithoutOwn(NamedTuple):
    """Equations (S + P) of shared gains and u, a recording's own coordinates o eliminated.

    own_solved (O, 1 + P): H_oo^-1 (g_o, H_ou); own_by_gains (O, S): H_oo^-1 H_og.
    """

    information: Array
    gradient: Array
    own_solved: Array
    own_by_gains: Array


def _without_own(equations: NormalEquations) -> _WithoutOwn:
    """The equations of one recording's data, with the prior of its own coordinates but not of the gains."""
    P, shared = len(equations.gradient), equations.shared_gains
    H, g = equations.quadratic.information.copy(), equations.quadratic.gradient.copy()
    own = np.concatenate([equations.is_own, np.zeros(P, bool)])
    gains = np.concatenate([~equations.is_own, np.zeros(P, bool)])
    H[-P:, -P:] -= np.eye(P)
    prior = equations.objective.joint_prior
    precision = _precision(prior, shared)
    H[np.ix_(gains, gains)] -= precision
    g[gains] -= precision @ (equations.iterate.gains - prior.gains)[shared]
    rest = ~own
    K = np.linalg.solve(H[np.ix_(own, own)], np.column_stack([g[own], H[np.ix_(own, rest)]]))
    cross, S = H[np.ix_(rest, own)], len(shared)
    return _WithoutOwn(
        H[np.ix_(rest, rest)] - cross @ K[:, 1:],
        g[rest] - cross @ K[:, 0],
        np.column_stack([K[:, 0], K[:, 1 + S :]]),
        K[:, 1 : 1 + S],
    )


def _precision(prior: Gaussian, gains: NDArray[np.intp]) -> Array:
    """Inverse of the covariance of some gains in a prior."""
    at = len(PARAMETERS) + gains
    return np.asarray(np.linalg.inv(prior.covariance[np.ix_(at, at)]))


def _reduced(
    record: Record,
    prior: SoilPrior,
    present: FittedModel,
    i: int,
    candidates: Sequence[Effect],
    free: Sequence[Free],
) -> NormalEquations:
    """The normal equations of recording i with the present model's coordinates eliminated."""
    problem = record.training.with_effects((*present.effects, *candidates), (*present.free, *free))
    fit, joint_prior, P = present.fits[i], present.joint_prior[i], len(free)
    covariance = np.zeros((len(joint_prior.covariance) + P,) * 2)
    covariance[:-P, :-P], covariance[-P:, -P:] = joint_prior.covariance, np.eye(P)
    extended = Gaussian(joint_prior.soil, np.concatenate([joint_prior.gains, np.zeros(P)]), covariance)
    gains = np.concatenate([fit.optimum.gains, np.zeros(P)])
    iterate = Iterate(fit.optimum.soil, gains, fit.optimum.latents)
    objective = Objective(problem, prior, extended)
    with np.errstate(all="ignore"):
        quadratic = objective.quadratic_model(iterate)
    if quadratic is None:
        raise np.linalg.LinAlgError("the model is not finite where it was fitted")
    present_columns, new = slice(None, -P), slice(-P, None)
    information = quadratic.information
    inverse = solve_with_inverse(information[present_columns, present_columns], np.zeros(len(information) - P))
    if inverse is None:
        raise np.linalg.LinAlgError("the present model's information is singular")
    response = inverse[1] @ information[present_columns, new]
    reduced = information[new, new] - np.eye(P) - information[new, present_columns] @ response
    gradient = quadratic.gradient[new] - response.T @ quadratic.gradient[present_columns]
    held_out = present.checks[i].latents
    by_name = {effect.name: effect for effect in present.effects}
    own = [
        record.training.n_sensors + k
        for k, f in enumerate(present.free)
        if by_name[f.effect].own_in_each_record(f.parameter)
    ]
    is_own = np.concatenate([np.ones(len(objective.free), bool), np.isin(objective.active[:-P], own)])
    return NormalEquations(
        objective,
        iterate,
        quadratic,
        is_own,
        gradient,
        reduced,
        response,
        held_out,
        present,
    )


def _score(
    effect: Effect,
    columns: NDArray[np.intp],
    free: Sequence[Free],
    equations: Sequence[NormalEquations],
    joint: JointEquations,
) -> Score:
    """One effect's score over all recordings; an effect of the record has parameters of its own in each."""
    block = np.ix_(columns, columns)
    own = [free[i] for i in columns.tolist()]
    parts: Sequence[NormalEquations | JointEquations] = equations if effect.of_record else [joint]
    solutions = [
        _bounded_minimum(one.information[block] + np.eye(len(own)), one.gradient[columns], own) for one in parts
    ]
    fall = sum(solution.fall for solution in solutions)
    neg2_log_evidence = sum(solution.neg2_log_evidence for solution in solutions)
    if effect.of_record:
        starts = tuple(
            _start(one, columns, solution.step, 0.0, -one.response)
            for one, solution in zip(equations, solutions, strict=True)
        )
    else:
        starts = tuple(
            _start(one, columns, solutions[0].step, *follow)
            for one, follow in zip(equations, joint.follow, strict=True)
        )
    return Score(effect, fall, neg2_log_evidence, starts)


class _Minimum(NamedTuple):
    """Step of the parameters (P,) in prior std, fall of -2 log posterior, and change of -2 log evidence."""

    step: Array
    fall: float
    neg2_log_evidence: float


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
    if not inside.any():
        return _Minimum(step, fall, -fall)
    kept = np.ix_(inside, inside)
    of_data, vector = information[kept] - np.eye(int(inside.sum())), information[kept] @ step[inside]
    mixture = mixture_neg2_log_evidence(
        of_data, vector, [f for f, is_inside in zip(free, inside, strict=True) if is_inside]
    )
    return _Minimum(step, fall, mixture + float(step[inside] @ vector) - fall)


def _start(
    equations: NormalEquations, columns: NDArray[np.intp], step: Array, offset: Array | float, by_u: Array
) -> Start:
    """Where a fit of one recording with the effect begins: at the step (P,), shortened to the prior's 95 % interval.

    offset (C,) and by_u (C, P): what the present coordinates change by, and by each of all parameters.
    """
    share = min(1.0, NORMAL_95 / max(float(np.abs(step).max(initial=0.0)), 1e-12))
    step = share * step
    follow = offset + by_u[:, columns] @ step
    objective, iterate = equations.objective, equations.iterate
    n_free, n_present = len(objective.free), len(iterate.gains) - len(equations.information)
    soil = objective.coordinates.stepped(iterate.soil, follow[:n_free])
    gains = iterate.gains[:n_present].copy()
    gains[objective.active[objective.active < n_present]] += follow[n_free:]
    standardised = np.concatenate([equations.fitted.unheld(gains), step])
    start = Start(soil, standardised, checked=equations.held_out_latents)
    if share < 1.0:
        return start
    change = np.zeros(len(iterate.gains))
    change[:n_present], change[n_present + columns] = gains - iterate.gains[:n_present], step
    latents = objective.problem.updated(equations.quadratic.linearisation, iterate.latents, soil - iterate.soil, change)
    return start._replace(near_optimum=True, latents=latents)
