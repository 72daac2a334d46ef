"""What these recordings could have shown: the size from which each effect would have been added.

An effect of parameters u (P,) in units of their prior std raises -2 log likelihood of the model
without it by u H u, on average over the noise.  H (P, P) is the Fisher information of the parameters
after soil, gains and effects of the model have taken up what they can (Schur complement).  From
that follows the expected fall of -2 log evidence, and the size at which it is what an effect must
explain.  An effect of that size is overlooked every other time, one of twice the size hardly ever.
Till then the fit has moved the soil instead: nobody can say that it has not been moved so far.

All this is linear in the effect.  A size is too small where the effect bends far before it is seen,
and for delays where nothing but noise changes quickly: noise of torques counts as change there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from soilbus.arrays import Array
from soilbus.diagnosis.evidence import evidence_of_any_size
from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.score import Normal, moves, normals_of
from soilbus.diagnosis.verdict import price
from soilbus.estimation.nuisance_parameters import Free, parameters_of
from soilbus.estimation.posterior import SoilPrior
from soilbus.terra.effects.effect import Effect, Parameter

PLAUSIBLE = 2.0
"""Prior standard deviations up to which an effect may well be there: a normal one goes beyond in a twentieth of all."""


@dataclass(frozen=True, slots=True)
class Detectable:
    """One effect: the size of its first parameter from which it would have been added, None where none in its range.

    unseen is the size that may be there nevertheless; soil_error (R, 6) by how much the logarithms of the soil
    parameters of each recording are then off, as reported less true.
    """

    effect: Effect
    size: float | None
    unseen: float
    soil_error: Array

    @property
    def parameter(self) -> Parameter:
        """The one that says how great the effect is."""
        return self.effect.parameters[0]


def detectable(
    records: Sequence[Record], prior: SoilPrior, present: FittedModel, candidates: Sequence[Effect]
) -> tuple[Detectable, ...]:
    """Every candidate, as the present model fitted to these recordings could have shown it."""
    asked = price(0.0, present.gap, present.checked_rows, present.rows)
    times = present.rows / sum(fit.rows for fit in present.fits)
    found: dict[str, Detectable] = {}
    for effects in _neutral_and_moved(candidates):
        free = [f for effect in effects for f in parameters_of(effect, present.checks[0].problem.n_wheels)]
        normals = normals_of(records, prior, present, effects, free)
        for effect in effects:
            columns = [i for i, f in enumerate(free) if f.effect == effect.name]
            least = _least_lateness(effect, records[-1])
            one = _detectable(effect, columns, [free[i] for i in columns], normals, times, asked, least)
            if effect.name not in found or _reach(one) < _reach(found[effect.name]):
                found[effect.name] = one
    return tuple(found[effect.name] for effect in candidates)


def _neutral_and_moved(candidates: Sequence[Effect]) -> Iterator[list[Effect]]:
    """The candidates, and those that are blind where they are absent from where else they may start."""
    yield list(candidates)
    for group in moves(candidates):
        yield [move.moved for move in group]


def _reach(one: Detectable) -> float:
    return np.inf if one.size is None else one.size


def _detectable(
    effect: Effect,
    columns: Sequence[int],
    free: Sequence[Free],
    normals: Sequence[Normal],
    times: float,
    asked: float,
    least: float,
) -> Detectable:
    parameter = effect.parameters[0]
    block = np.ix_(columns, columns)
    informations = [times * normal.left[block] for normal in normals]
    if effect.of_record:  # in one recording, while the others pay for parameters that they do not need
        unneeded = [_expected(information, np.zeros(len(free)), free) for information in informations]
        cases = [(one, asked + sum(unneeded) - own) for one, own in zip(informations, unneeded, strict=True)]
    else:
        cases = [(np.sum(informations, axis=0), asked)]
    first = [i for i, f in enumerate(free) if f.parameter is parameter]
    sizes = [min(_least_size(information, i, free, needed) for information, needed in cases) for i in first]
    size = max(*sizes, least)
    unseen = min(size, _most(parameter))
    direction = np.zeros(len(free))
    direction[first[sizes.index(max(sizes))]] = unseen / parameter.std
    error = np.array([_soil_error(normal, columns, direction) for normal in normals])
    return Detectable(effect, size if np.isfinite(size) else None, unseen, error)


def _least_lateness(effect: Effect, record: Record) -> float:
    """Delay [s] of an effect's first channel below which it is none (see late_posterior.is_late)."""
    return max((record.learned.sample_time(quantity) / 2.0 for quantity in [*effect.late][:1]), default=0.0)


def _most(parameter: Parameter) -> float:
    """The greatest size that is looked for."""
    return min(PLAUSIBLE * parameter.std, max(parameter.high - parameter.neutral, parameter.neutral - parameter.low))


def _least_size(information: Array, place: int, free: Sequence[Free], asked: float) -> float:
    """Size of one parameter from which the evidence is expected to fall by what is asked; infinite where none does."""
    direction = np.eye(len(free))[place]
    parameter = free[place].parameter

    def short_of(size: float) -> float:
        return _expected(information, size * direction, free) + asked

    most = _most(parameter) / parameter.std
    return float(brentq(short_of, 0.0, most)) * parameter.std if short_of(most) <= 0.0 else np.inf


def _expected(information: Array, u: Array, free: Sequence[Free]) -> float:
    """Change of -2 log evidence where the parameters are u (P,) and there is no noise."""
    return evidence_of_any_size(information, information @ u, free)


def _soil_error(normal: Normal, columns: Sequence[int], u: Array) -> Array:
    """Logarithms of the soil parameters (6,), reported less true, where an effect is there with u (P,)."""
    follow = normal.answer[:, list(columns)] @ u
    coordinates = normal.fitting.coordinates
    return np.asarray(coordinates.log_directions(normal.place.soil) @ follow[: len(normal.fitting.free)])
