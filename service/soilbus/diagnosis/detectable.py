"""What these recordings could have shown: the size from which each effect would have been added.

    E[information vector] = H u  for an effect of parameters u (P,), in units of their prior std
    detectable size: the u at which the expected fall of the score equals the required one

H (P, P) is the Fisher information of the parameters after soil, gains and the model's effects have taken up what they
can (Schur complement).  An effect of that size is missed every other time, one of twice the size hardly ever.  A
smaller one is not seen because the fit moves the soil instead, and nobody can exclude that it has: soil_error says by
how much.

All this is linear in the effect, whose other parameters are at their neutral values: a loss that fades with torque may
show at a tenth of the size of one that does not, which the soil imitates.  A size is too small where the effect is
nonlinear far below it, and for delays where nothing but noise changes quickly: noise of torques counts as change there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from soilbus.arrays import Array
from soilbus.diagnosis.blocks import expected_change
from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.score import NormalEquations, normal_equations
from soilbus.diagnosis.verdict import least_fall
from soilbus.estimation.nuisance_parameters import Free, parameters_of
from soilbus.estimation.posterior import NORMAL_95, SoilPrior
from soilbus.terra.effects.effect import Effect, Parameter


@dataclass(frozen=True, slots=True)
class Detectable:
    """One effect and the size from which it would have been added.

    Attributes
    ----------
    effect
        The effect.
    size
        Of its first parameter [its unit]; None where no plausible size would have been added.
    unseen
        Size that may be there nevertheless.
    soil_error
        (R, 6): error of the logarithms of the soil parameters of each recording at that size, reported less true.
    """

    effect: Effect
    size: float | None
    unseen: float
    soil_error: Array

    @property
    def parameter(self) -> Parameter:
        """The one that says how large the effect is."""
        return self.effect.parameters[0]


def detectable(
    records: Sequence[Record], prior: SoilPrior, present: FittedModel, candidates: Sequence[Effect]
) -> tuple[Detectable, ...]:
    """The detectable size of every candidate beside the present model fitted to these recordings."""
    if not candidates:
        return ()
    data_ratio = present.rows / sum(fit.rows for fit in present.fits)
    free = [f for effect in candidates for f in parameters_of(effect, present.checks[0].problem.n_wheels)]
    equations = normal_equations(records, prior, present, candidates, free)
    needed = least_fall(records[0].options.named_probability)
    return tuple(_detectable(effect, free, equations, data_ratio, needed) for effect in candidates)


def _detectable(
    effect: Effect,
    all_free: Sequence[Free],
    equations: NormalEquations,
    data_ratio: float,
    needed: float,
) -> Detectable:
    parameter, recordings = effect.parameters[0], range(len(equations.iterates))
    most = _max_size(parameter)
    columns = np.array([i for i, f in enumerate(all_free) if f.effect == effect.name])
    free = [all_free[i] for i in columns.tolist()]
    parts = [equations.reduced(columns, i) for i in (recordings if effect.of_record else (0,))]
    informations = [data_ratio * one.information for one in parts]
    cases = [(informations[0], needed)]
    if effect.of_record:  # in one recording, while the others pay for parameters that they do not need
        unneeded = [_expected_change(information, np.zeros(len(free))) for information in informations]
        others = sum(unneeded)
        cases = [(one, needed + others - own) for one, own in zip(informations, unneeded, strict=True)]
    first = [i for i, f in enumerate(free) if f.parameter is parameter]
    sizes = [min(_least_size(information, i, free, fall, most) for information, fall in cases) for i in first]
    size = max(sizes)
    unseen = min(size, most)
    u = np.zeros(len(free))
    u[first[sizes.index(max(sizes))]] = unseen / parameter.std
    error = [_soil_error(equations, i, parts[i if effect.of_record else 0].response @ u) for i in recordings]
    return Detectable(effect, size if np.isfinite(size) else None, unseen, np.array(error))


def _max_size(parameter: Parameter) -> float:
    """The largest plausible size: the end of its prior's 95 % interval."""
    widest = max(parameter.high - parameter.neutral, parameter.neutral - parameter.low)
    return min(NORMAL_95 * parameter.std, widest)


def _least_size(information: Array, index: int, free: Sequence[Free], required: float, largest: float) -> float:
    """Size of one parameter from which the expected fall of the score reaches the required one; else infinite."""
    direction = np.eye(len(free))[index]
    parameter = free[index].parameter

    def excess(size: float) -> float:
        """Change of the score above the negative of the required fall."""
        return _expected_change(information, size * direction) + required

    most = largest / parameter.std
    return float(brentq(excess, 0.0, most)) * parameter.std if excess(most) <= 0.0 else np.inf


def _expected_change(information: Array, u: Array) -> float:
    """Change of the score by the effect where its parameters are u (P,) and there is no noise."""
    return expected_change(information, information @ u)


def _soil_error(equations: NormalEquations, record: int, follow: Array) -> Array:
    """Error (6,) of the logarithms of the soil parameters of a recording, reported less true.

    follow (n,): by how much an effect moves all coordinates, if it is in the model.
    """
    objective = equations.joint.parts[record]
    directions = objective.coordinates.log_directions(equations.iterates[record].soil)
    return np.asarray(-directions @ follow[equations.joint.columns[record]][: len(objective.free)])
