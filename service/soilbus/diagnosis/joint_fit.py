"""One fit to all recordings of a vehicle: a soil each, and gains and effects that they share.

    F(theta) = sum over recordings i of F_i(soil_i, own_i, shared),    theta = (soil_1, own_1, soil_2, ..., shared)
    H = sum over i of E_i' H_i E_i      (E_i: the coordinates of recording i among those of all)

F_i is the -2 log posterior of one recording and H_i its information (`estimation.solver`).  Sensor gain errors and
parameters of effects belong to the vehicle; the soil belongs to a recording, and so do the parameters of an effect of
the record (see terra.effects.effect).  Of R recordings each has the R-th part of the prior of what they share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian, solve_with_inverse
from soilbus.estimation.linearisation import Latents
from soilbus.estimation.multistart import Fit, fit_at, fit_window
from soilbus.estimation.nuisance_parameters import Free
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.options import SolverOptions
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.solver import Iterate, Objective, QuadraticModel, Solution, Termination, WindowModel, minimise
from soilbus.terra.effects.effect import Effect

_SOIL = len(PARAMETERS)


class Start(NamedTuple):
    """Where a fit of one recording begins.

    Attributes
    ----------
    soil : (6,)
        In SI.
    gains : (G,)
        Sensors' gains and effects' parameters.
    near_optimum
        Whether a fit of the same model ended there, on the same or on fewer instants.
    latents
        Prediction of the latents there, if of the same instants.
    checked
        The same for the instants that are held out.
    """

    soil: Array
    gains: Array
    near_optimum: bool = False
    latents: Latents | None = None
    checked: Latents | None = None


@dataclass(frozen=True, slots=True)
class JointModel(QuadraticModel):
    """The quadratic model by the coordinates of all recordings; parts: that of each by its own."""

    parts: tuple[WindowModel, ...]


class JointObjective:
    """-2 log posterior of all recordings, with derivatives.

    Parameters
    ----------
    parts
        Objective of each recording; all have the same gains.
    own : (G,)
        Which gains and parameters each recording has for itself.

    Attributes
    ----------
    columns
        Of each recording, the indices of its coordinates among the `size` coordinates of all.
    """

    def __init__(self, parts: Sequence[Objective], own: NDArray[np.bool_]) -> None:
        self.parts, self.own = tuple(parts), own
        R, free, active = len(self.parts), self.parts[0].free, self.parts[0].active
        is_own = np.concatenate([np.ones(len(free), bool), own[active] if R > 1 else np.ones(len(active), bool)])
        n_own, n_shared = int(is_own.sum()), int((~is_own).sum())
        self.size = R * n_own + n_shared
        self.columns = [np.where(is_own, np.cumsum(is_own) - 1 + i * n_own, 0) for i in range(R)]
        for columns in self.columns:
            columns[~is_own] = R * n_own + np.arange(n_shared)

    @classmethod
    def of(
        cls,
        problems: Sequence[ObservationModel],
        prior: SoilPrior,
        priors: Sequence[Gaussian],
        own: NDArray[np.bool_],
        as_measured: bool = False,
    ) -> JointObjective:
        """With the objective of each recording by its observation model and prior."""
        parts = zip(problems, priors, strict=True)
        return cls([Objective(problem, prior, of_one, as_measured) for problem, of_one in parts], own)

    def start(self, starts: Sequence[Start]) -> tuple[Iterate, ...]:
        """The iterate of each recording at its start, with the mean of the gains that all share."""
        gains = [
            np.clip(np.where(part.problem.gain_std > 0.0, start.gains, 0.0), *part.problem.gain_bounds)
            for part, start in zip(self.parts, starts, strict=True)
        ]
        if len(gains) > 1:
            gains = [np.where(self.own, of_one, np.mean(gains, axis=0)) for of_one in gains]
        return tuple(
            part.start(start.soil, of_one, None if part.as_measured else start.latents)
            for part, start, of_one in zip(self.parts, starts, gains, strict=True)
        )

    def quadratic_model(self, iterate: tuple[Iterate, ...]) -> JointModel | None:
        """The quadratic model at an iterate of each recording; None where one of them is not finite."""
        models = [part.quadratic_model(at) for part, at in zip(self.parts, iterate, strict=True)]
        finite = [model for model in models if model is not None]
        return self.together(finite) if len(finite) == len(models) else None

    def together(self, models: Sequence[WindowModel]) -> JointModel:
        """The quadratic model of all recordings from that of each."""
        information, of_prior = np.zeros((2, self.size, self.size))
        gradient = np.zeros(self.size)
        bounds = [np.zeros((len(model.active_bounds), self.size)) for model in models]
        for model, columns, outward in zip(models, self.columns, bounds, strict=True):
            block = columns[:, None], columns
            information[block] += model.information
            of_prior[block] += model.prior_information
            gradient[columns] += model.gradient
            outward[:, columns] = model.active_bounds
        value = sum(model.neg2_log_posterior for model in models)
        return JointModel(information, of_prior, gradient, value, np.vstack(bounds), tuple(models))

    def stepped(self, iterate: tuple[Iterate, ...], model: JointModel, step: Array) -> tuple[Iterate, ...]:
        """The iterate of each recording after a step of all coordinates, shortened at the first bound of any."""
        steps = [step[columns] for columns in self.columns]
        fraction = min(map(Objective.step_fraction, self.parts, iterate, steps))
        return tuple(
            part.stepped(at, of_part, fraction * own)
            for part, at, of_part, own in zip(self.parts, iterate, model.parts, steps, strict=True)
        )

    def with_entry_angles(self, iterate: tuple[Iterate, ...]) -> tuple[Iterate, ...]:
        """The same iterates with their entry angles solved."""
        return tuple(part.with_entry_angles(at) for part, at in zip(self.parts, iterate, strict=True))


def own_gains(n_sensors: int, effects: Sequence[Effect], free: Sequence[Free]) -> NDArray[np.bool_]:
    """Which gains and parameters (G,) each recording has for itself."""
    by_name = {effect.name: effect for effect in effects}
    of_effects = [by_name[f.effect].own_in_each_record(f.parameter) for f in free]
    return np.array([False] * n_sensors + of_effects, bool)


def priors_of(
    problems: Sequence[ObservationModel], prior: SoilPrior, own: NDArray[np.bool_], earlier: Gaussian | None = None
) -> tuple[Gaussian, ...]:
    """Prior of soil and gains of each recording, with its part of the prior of what all share.

    earlier: posterior of a fit on the same soil, for the one recording that there then is; effects that it lacks have
    the catalogue's prior.

    Raises
    ------
    ValueError
        Where such a posterior is given for several recordings.
    """
    several = np.sqrt(np.where(own, 1.0, len(problems)))
    priors = tuple(Gaussian.of(prior, problem.gain_std * several) for problem in problems)
    if earlier is None:
        return priors
    (first,), n = priors, len(earlier.gains)
    first.gains[:n], first.covariance[: _SOIL + n, : _SOIL + n] = earlier.gains, earlier.covariance
    return (replace(first, soil=earlier.soil),)


def fit_jointly(
    problems: Sequence[ObservationModel],
    prior: SoilPrior,
    priors: Sequence[Gaussian],
    own: NDArray[np.bool_],
    starts: Sequence[Start] | None,
    options: SolverOptions,
) -> list[Fit] | None:
    """The fit of each recording at the optimum of all, whose -2 log evidence and posterior add up to those of all.

    Parameters
    ----------
    problems, priors
        Observation model and prior of each recording (`priors_of`).
    prior
        Of the soil.
    own : (G,)
        As of `own_gains`.
    starts
        Of each recording.  Near an optimum everything moves from there.  Otherwise soils and effect parameters move
        first, with the latents as measured, for up to half the evaluations.  None: each is searched for alone.
    options
        Of the descent.

    Returns
    -------
    list of Fit or None
        None where the numbers are not finite, or where the fit stays above `give_up_above`.
    """
    if starts is None:
        alone = [fit_window(problem, prior, of_one) for problem, of_one in zip(problems, priors, strict=True)]
        found = [fit for fit in alone if fit is not None]
        if len(found) < len(alone) or (len(found) == 1 and found[0].converged):
            return found if len(found) == len(alone) else None
        starts = [Start(fit.mode.soil, fit.mode.gains, fit.converged, fit.optimum.latents) for fit in found]
    search = problems[0].options.search
    with np.errstate(all="ignore"):
        joint = JointObjective.of(problems, prior, priors, own)
        if all(start.near_optimum for start in starts):
            end = minimise(joint, joint.start(starts), options, 0.0)
        else:
            as_measured = JointObjective.of(problems, prior, priors, own, as_measured=True)
            first = replace(search.soil_alone, max_evaluations=options.max_evaluations // 2)
            near = minimise(as_measured, as_measured.start(starts), first)
            if near.termination in (Termination.GIVEN_UP, Termination.NOT_FINITE):
                return None
            end = minimise(joint, near.previous, options)
        fits = _fits_at(joint, end)
    if fits is None or sum(fit.neg2_log_posterior for fit in fits) > options.give_up_above:
        return None
    return fits


def _fits_at(objective: JointObjective, end: Solution[tuple[Iterate, ...], JointModel]) -> list[Fit] | None:
    """The fit of each recording at the end of a descent; None where it is not finite."""
    inverse = None if end.model is None else solve_with_inverse(end.model.information, end.model.gradient)
    if end.model is None or inverse is None:
        return None
    R, covariance, fits = len(objective.parts), inverse[1], list[Fit]()
    for i, (part, columns) in enumerate(zip(objective.parts, objective.columns, strict=True)):
        own = Solution(
            end.iterate[i], end.previous[i], end.model.parts[i], end.predicted_decrease / R, end.evaluations,
            end.termination,
        )  # fmt: skip
        fit = fit_at(part, own)
        if fit is None:
            return None
        mode = part.gaussian(fit.mode.soil, fit.mode.gains, covariance[columns[:, None], columns])
        fits.append(replace(fit, mode=mode))
    penalty = end.model.neg2_log_evidence - sum(model.neg2_log_evidence for model in end.model.parts)
    return [replace(fit, neg2_log_evidence=fit.neg2_log_evidence + penalty / R) for fit in fits]
