"""Score test: what each effect could explain, foreseen from one linearisation at the fitted model.

The residuals' gradient by an effect's parameters, and their information less what soil,
gains and effects already in the model can imitate, foretell how far the penalised cost
would fall if the effect were added (Rao's score test, Bayesian with the prior's precision).
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
from soilbus.diagnosis.evidence import evidence_of_any_size
from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.diagnosis.records import Record
from soilbus.estimation.gaussian import Gaussian, solve_with_inverse
from soilbus.estimation.multistart import Start
from soilbus.estimation.nuisance_parameters import Free, parameters_of
from soilbus.estimation.observation_model import Latents, Linearisation
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.solver import Iterate, Objective
from soilbus.terra.effects.effect import Effect

MAX_STEP = 2.0
"""Prior standard deviations to which a foreseen parameter is confined: linear is not for ever."""


@dataclass(frozen=True, slots=True)
class Score:
    """What an effect is foreseen to do: fall of the penalised cost, change of -2 log evidence, start of its fit."""

    effect: Effect
    fall: float
    neg2_log_evidence: float
    starts: tuple[Start, ...]


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal equations of one recording: those of the present model solved for, the effects' left over.

    by_effects (P,) is the gradient, left (P, P) the information without the prior's,
    answer (F + A, P) how the present parameters follow the effects'; present is that model.
    """

    fitting: Objective
    place: Iterate
    at: Linearisation
    by_effects: Array
    left: Array
    answer: Array
    checked: Latents
    present: FittedModel


def scores(
    records: Sequence[Record], prior: SoilPrior, present: FittedModel, candidates: Sequence[Effect]
) -> list[Score]:
    """The candidates in the order of what they are foreseen to explain, the best first."""
    n_wheels = len(records[0].learned.rig.wheels)
    free = [f for effect in candidates for f in parameters_of(effect, n_wheels)]
    normals = normals_of(records, prior, present, candidates, free)
    found = []
    for effect in candidates:
        columns = np.array([i for i, f in enumerate(free) if f.effect == effect.name])
        found.append(_score(effect, columns, free, normals))
    return sorted(found, key=lambda score: score.neg2_log_evidence)


def further_scores(
    records: Sequence[Record], prior: SoilPrior, present: FittedModel, candidates: Sequence[Effect]
) -> list[Score]:
    """The best score of each candidate from where its parameters may start besides, of those that have such starts.

    Where the effect is absent nothing depends on such a parameter (the depth of a pan), and
    the score is blind to it: so it is taken at each of several values (Davies 1977,
    Biometrika 64:247).
    """
    found: dict[str, Score] = {}
    for group in moves(candidates):
        by_name = {move.effect.name: move for move in group}
        for score in scores(records, prior, present, [move.moved for move in by_name.values()]):
            move, best = by_name[score.effect.name], found.get(score.effect.name)
            if best is None or score.neg2_log_evidence < best.neg2_log_evidence:
                starts = tuple(_offset(start, move.offsets) for start in score.starts)
                found[score.effect.name] = replace(score, effect=move.effect, starts=starts)
    return list(found.values())


class Move(NamedTuple):
    """An effect, the same with one parameter's neutral value moved, and by how many std of each parameter (P,)."""

    effect: Effect
    moved: Effect
    offsets: list[float]


def moves(candidates: Sequence[Effect]) -> Iterator[list[Move]]:
    """All further starts of the candidates, of each one at a time."""
    for group in zip_longest(*(_moves(effect) for effect in candidates)):
        yield [move for move in group if move is not None]


def _moves(effect: Effect) -> Iterator[Move]:
    """One for each value at which a parameter may start besides."""
    for parameter in effect.parameters:
        for value in parameter.starts:
            moved = tuple(replace(p, neutral=value) if p is parameter else p for p in effect.parameters)
            offsets = [
                (value - parameter.neutral) / parameter.std if p is parameter else 0.0 for p in effect.parameters
            ]
            yield Move(effect, replace(effect, parameters=moved), offsets)


def _offset(start: Start, offsets: Sequence[float]) -> Start:
    """Where a fit of the effect begins that was moved so far."""
    gains = start.gains.copy()
    gains[-len(offsets) :] += offsets
    return Start(start.soil, gains)


def normals_of(
    records: Sequence[Record],
    prior: SoilPrior,
    present: FittedModel,
    candidates: Sequence[Effect],
    free: Sequence[Free],
) -> list[Normal]:
    """The normal equations of each recording for candidates with these parameters."""
    return [_normal(r, prior, present, i, candidates, free) for i, r in enumerate(records)]


def _normal(
    record: Record,
    prior: SoilPrior,
    present: FittedModel,
    i: int,
    candidates: Sequence[Effect],
    free: Sequence[Free],
) -> Normal:
    problem = record.learned.completed((*present.effects, *candidates), (*present.free, *free))
    fit, joint_prior, P = present.fits[i], present.joint_prior[i], len(free)
    covariance = np.zeros((len(joint_prior.covariance) + P,) * 2)
    covariance[:-P, :-P], covariance[-P:, -P:] = joint_prior.covariance, np.eye(P)
    extended = Gaussian(joint_prior.soil, np.concatenate([joint_prior.gains, np.zeros(P)]), covariance)
    gains = np.concatenate([fit.optimum.gains, np.zeros(P)])
    place = Iterate(fit.optimum.soil, gains, fit.optimum.latents, np.inf, 0)
    fitting = Objective(problem, prior, extended)
    with np.errstate(all="ignore"):
        point = fitting.point(place)
    if point is None:
        raise np.linalg.LinAlgError("the model is not finite where it was fitted")
    base, new = slice(None, -P), slice(-P, None)
    information = point.information
    inverse = solve_with_inverse(information[base, base], np.zeros(len(information) - P))
    if inverse is None:
        raise np.linalg.LinAlgError("the present model's information is singular")
    answer = inverse[1] @ information[base, new]
    left = information[new, new] - np.eye(P) - information[new, base] @ answer
    by_effects = point.gradient[new] - answer.T @ point.gradient[base]
    return Normal(fitting, place, point.at, by_effects, left, answer, present.checks[i].latents, present)


def _score(effect: Effect, columns: NDArray[np.intp], free: Sequence[Free], normals: Sequence[Normal]) -> Score:
    """One effect's score over all recordings; with parameters of its own in each where it is of the recording."""
    block = np.ix_(columns, columns)
    own = [free[i] for i in columns.tolist()]
    parts = [(n.left[block], n.by_effects[columns]) for n in normals]
    if not effect.of_record:
        left, gradient = (np.sum([part[i] for part in parts], axis=0) for i in (0, 1))
        parts = [(left, gradient)]
    solutions = [_within(left + np.eye(len(own)), gradient, own) for left, gradient in parts]
    fall = sum(solution.fall for solution in solutions)
    neg2_log_evidence = sum(solution.neg2_log_evidence for solution in solutions)
    steps = [solution.step for solution in solutions] * (1 if effect.of_record else len(normals))
    starts = tuple(_start(n, columns, step) for n, step in zip(normals, steps, strict=True))
    return Score(effect, fall, neg2_log_evidence, starts)


class _Solution(NamedTuple):
    """Step of the parameters (P,) in prior std, by how much the cost falls, and change of -2 log evidence."""

    step: Array
    fall: float
    neg2_log_evidence: float


def _within(information: Array, gradient: Array, free: Sequence[Free]) -> _Solution:
    """Least cost of the parabola with the parameters (P,) inside their ranges.

    With information = L L' that is the bounded least squares problem |L' u + L^-1 gradient|^2, of an active set method
    (Stark & Parker 1995, Comput. Stat. 10:129).
    """
    low, high = (np.array([(getattr(f.parameter, edge) - f.value) / f.std for f in free]) for edge in ("low", "high"))
    root = np.linalg.cholesky(information)
    found = lsq_linear(root.T, -solve_triangular(root, gradient, lower=True), (low, high), method="bvls")
    step, inside = found.x, found.active_mask == 0
    fall = float(-2.0 * gradient @ step - step @ information @ step)
    if not inside.any():
        return _Solution(step, fall, -fall)
    kept = np.ix_(inside, inside)
    left, pull = information[kept] - np.eye(int(inside.sum())), information[kept] @ step[inside]
    there = evidence_of_any_size(left, pull, [f for f, free_still in zip(free, inside, strict=True) if free_still])
    return _Solution(step, fall, there + float(step[inside] @ pull) - fall)


def _start(normal: Normal, columns: NDArray[np.intp], step: Array) -> Start:
    share = min(1.0, MAX_STEP / max(float(np.abs(step).max(initial=0.0)), 1e-12))
    step = share * step
    follow = -normal.answer[:, columns] @ step
    fitting, place = normal.fitting, normal.place
    n_free, n_known = len(fitting.free), len(place.gains) - len(normal.left)
    soil = fitting.coordinates.moved(place.soil, follow[:n_free])
    gains = place.gains[:n_known].copy()
    gains[fitting.active[fitting.active < n_known]] += follow[n_free:]
    start = Start(soil, np.concatenate([normal.present.unheld(gains), step]), checked=normal.checked)
    if share < 1.0:
        return start
    change = np.zeros(len(place.gains))
    change[:n_known], change[n_known + columns] = gains - place.gains[:n_known], step
    latents = fitting.problem.updated(normal.at, place.latents, soil - place.soil, change)
    return start._replace(near=True, latents=latents)
