"""Score test: what each effect could explain, predicted from one linearisation at the fitted model.

    H = H_uu - H_uc H_cc^-1 H_cu,   g = g_u - H_uc H_cc^-1 g_c,   u = -(H + I)^-1 g

u are the effect's parameters in units of their prior std, c the coordinates of the present model (soil, sensor gains,
parameters of its effects).  The Schur complement H is the information on u that the present model cannot imitate.
From H and g follow the fall of -2 log posterior if the effect were added, the change of -2 log evidence, and a start
for the effect's fit (Rao's score test, Bayesian with the prior's precision).
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
from soilbus.estimation.observation_model import Latents, Linearisation
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.solver import Iterate, Objective
from soilbus.terra.effects.effect import Effect

MAX_START_SD = 2.0
"""Prior standard deviations to which a start's parameters are confined, as the model is linear near the fit only."""


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
    """

    objective: Objective
    iterate: Iterate
    at: Linearisation
    gradient: Array
    information: Array
    response: Array
    held_out_latents: Latents
    fitted: FittedModel


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
    found = []
    for effect in candidates:
        columns = np.array([i for i, f in enumerate(free) if f.effect == effect.name])
        found.append(_score(effect, columns, free, equations))
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
    iterate = Iterate(fit.optimum.soil, gains, fit.optimum.latents, np.inf, 0)
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
    return NormalEquations(objective, iterate, quadratic.linearisation, gradient, reduced, response, held_out, present)


def _score(
    effect: Effect, columns: NDArray[np.intp], free: Sequence[Free], equations: Sequence[NormalEquations]
) -> Score:
    """One effect's score over all recordings; an effect of the record has parameters of its own in each."""
    block = np.ix_(columns, columns)
    own = [free[i] for i in columns.tolist()]
    parts = [(one.information[block], one.gradient[columns]) for one in equations]
    if not effect.of_record:
        information, gradient = (np.sum([part[i] for part in parts], axis=0) for i in (0, 1))
        parts = [(information, gradient)]
    solutions = [_bounded_minimum(information + np.eye(len(own)), gradient, own) for information, gradient in parts]
    fall = sum(solution.fall for solution in solutions)
    neg2_log_evidence = sum(solution.neg2_log_evidence for solution in solutions)
    steps = [solution.step for solution in solutions] * (1 if effect.of_record else len(equations))
    starts = tuple(_start(one, columns, step) for one, step in zip(equations, steps, strict=True))
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


def _start(equations: NormalEquations, columns: NDArray[np.intp], step: Array) -> Start:
    """Where a fit of one recording with the effect begins: at the step (P,), shortened to MAX_START_SD."""
    share = min(1.0, MAX_START_SD / max(float(np.abs(step).max(initial=0.0)), 1e-12))
    step = share * step
    follow = -equations.response[:, columns] @ step
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
    latents = objective.problem.updated(equations.at, iterate.latents, soil - iterate.soil, change)
    return start._replace(near_optimum=True, latents=latents)
