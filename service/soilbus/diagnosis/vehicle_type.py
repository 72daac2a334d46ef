"""Effects that all vehicles of a type share, apart from those of single vehicles.

    log p(type has e)      = sum over v of log L_v  with  integral of prod over v of L_v(u) dp(u)      one value u
    log p(vehicles' own)   = sum over v of log [pi_0 + sum over e of pi_e integral of L_v,e(u) dp(u)]  a value each

L_v,e(u) is the likelihood of effect e's size by the logs of vehicle v alone (Gaussian around its fit), soils and
sensor gains eliminated.  Equal values in several vehicles are a coincidence unless the type has the effect.  pi is the
share of vehicles that have an effect of their own, and which, as the other vehicles of the type show it (empirical
Bayes: Efron 2010, Large-Scale Inference, ch. 5; with a rule of succession, so that few vehicles teach little).
Evidences are tempered as in `verdict`: a formula that is off is off in all vehicles.  A vehicle with a fault of its own
may contradict the type's value, so vehicles that their own effects explain better are left out, while most remain.

What the formula of the type's first effect leaves is alike in all vehicles too, and looks like a further effect.  So a
name is judged at the temperature of all recordings together by what they leave without effects: V vehicles are no surer
there than one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logsumexp, softmax

from soilbus.arrays import Array
from soilbus.diagnosis.diagnose import Diagnosis
from soilbus.diagnosis.evidence import OwnParameters, own_parameters
from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.options import DEFAULT, TYPE_DEFAULT, TypeOptions
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.score import normal_equations, scores
from soilbus.diagnosis.verdict import TEMPERED_FALL_OF_NONE, temperature
from soilbus.estimation.nuisance_parameters import Free, parameters_of
from soilbus.estimation.posterior import Estimate, SoilPrior
from soilbus.terra.effects.effect import Effect

__all__ = [
    "Factor",
    "SharedEffect",
    "factors_of",
    "own_probabilities",
    "records_with",
    "shared_effect",
    "shared_effects",
]

UNBOUNDED = replace(DEFAULT, max_excess=math.inf)
"""For what is alike in many logs and vehicles: what a formula leaves of it grows with their number."""
ROUNDING = float(np.finfo(float).eps)
"""Of a sum of probabilities, which are no surer than this."""


@dataclass(frozen=True, slots=True)
class Factor:
    """What the logs of one vehicle say of one effect's size.

    Attributes
    ----------
    falls
        Fall of -2 log evidence by the effect, and by each that may be there in its place, by name.
    excess
        Of the squared residuals without effects, those of the type included: it gives the temperature (see `verdict`).
    own
        Likelihood of the effect's parameters, those of the whole vehicle, about their neutral values in units of the
        catalogue's prior std.
    """

    falls: Mapping[str, float]
    excess: float
    own: OwnParameters

    @property
    def divisor(self) -> float:
        """The temperature."""
        return temperature(self.excess)


@dataclass(frozen=True, slots=True)
class SharedEffect:
    """An effect that a type of vehicles has.

    Attributes
    ----------
    effect, probability
        The effect, and that the type has it.
    vehicles
        Indices of the vehicles that agree in its value.
    parameters
        Value and std by name; a wheel's own with the wheel's number behind a dot.
    given
        For each vehicle, the effect's parameters with a prior from the other vehicles.
    """

    effect: Effect
    probability: float
    vehicles: tuple[int, ...]
    parameters: Mapping[str, Estimate]
    given: tuple[tuple[Free, ...], ...]


# --- one vehicle


def factors_of(
    records: Sequence[Record], prior: SoilPrior, found: Diagnosis, catalogue: Sequence[Effect]
) -> dict[str, Factor]:
    """The factor of each effect that several vehicles may share; those of the ground of one log are none.

    Parameters
    ----------
    records
        Of one vehicle.
    prior
        Of the soil.
    found
        Their diagnosis: an effect found, and each that may be in its place, is judged beside the others found; one
        that is neither, beside all of them.
    catalogue
        Effects that may be missing.
    """
    completed, law = found.completed, records[0].training.model.shear_law
    possible = {
        e.name: e for e in catalogue if not e.of_record and e.name not in found.base.names and e.base_law in (None, law)
    }
    factors: dict[str, Factor] = {}
    for addition in found.additions:
        falls = {name: fall for name, fall in addition.falls.items() if np.isfinite(fall)}
        others = [e for e in completed.effects if e is not addition.effect]
        for name in sorted(possible.keys() & falls.keys() - factors.keys()):
            if name == addition.effect.name:
                fitted: FittedModel | None = completed
            elif name in completed.names:
                continue
            else:
                beside = [*others, possible[name]]
                fitted = fit_model(records, prior, beside, completed.as_starts(beside))
            own = None if fitted is None else _by_fit(records, prior, fitted, possible[name])
            if own is not None:
                factors[name] = Factor(falls, found.excess, own)
    rest = [e for e in possible.values() if e.name not in factors and e.name not in completed.names]
    for name, (fall, own) in _by_score(records, prior, completed, rest).items():
        factors[name] = Factor({name: fall}, found.excess, own)
    return factors


def _by_fit(records: Sequence[Record], prior: SoilPrior, fitted: FittedModel, effect: Effect) -> OwnParameters | None:
    """Likelihood by a fit with the effect; None where the model without it cannot be fitted.

    A fit that holds a parameter at an edge has no information on it: then it is that of the score without the effect,
    with its optimum where the fit ended.
    """
    if all(f.std > 0.0 for f in fitted.free if f.effect == effect.name):
        return fitted.shared_parameters(effect)
    others = [e for e in fitted.effects if e is not effect]
    without = fit_model(records, prior, others, fitted.as_starts(others))
    if without is None:
        return None
    _, own = _by_score(records, prior, without, [effect])[effect.name]
    at = {f.name: first.standardised(f.at(u)) for f, first, u in _effect_values(fitted)}
    return own._replace(information_vector=own.information @ [at[f.name] for f in own.free])


def _effect_values(fitted: FittedModel) -> Iterator[tuple[Free, Free, float]]:
    """Each parameter of the effects as fitted, before any was held, and its standardised value."""
    n_sensors = fitted.checks[0].problem.n_sensors
    return zip(fitted.free, fitted.free_unheld, fitted.fits[-1].mode.gains[n_sensors:].tolist(), strict=True)


def _by_score(
    records: Sequence[Record], prior: SoilPrior, present: FittedModel, effects: Sequence[Effect]
) -> dict[str, tuple[float, OwnParameters]]:
    """Falls and likelihoods by one linearisation where the effects are absent, which knows no range of parameters."""
    if not effects:
        return {}
    free = [f for effect in effects for f in parameters_of(effect, records[0].training.n_wheels)]
    equations = normal_equations(records, prior, present, effects, free)
    found = {}
    for score in scores(records, prior, present, effects):
        effect = score.effect
        shared = [
            i for i, f in enumerate(free) if f.effect == effect.name and not effect.own_in_each_record(f.parameter)
        ]
        reduced = equations.reduced(np.array(shared, int))
        own = OwnParameters(reduced.information, -reduced.gradient, tuple(free[i] for i in shared))
        found[effect.name] = -score.neg2_log_evidence, own
    return found


def records_with(records: Sequence[Record], effect: Effect, free: Sequence[Free]) -> list[Record]:
    """The same recordings under a present model that has an effect of the type."""
    of_type = records[0].of_type | {effect.name}
    beside = [
        record.with_effects((*record.training.effects, effect), (*record.training.free, *free)) for record in records
    ]
    return [replace(record, of_type=of_type) for record in beside]


# --- the vehicles of a type


class Pool(NamedTuple):
    """Likelihood of one value of an effect (P parameters) in each of V vehicles, divided by its temperature.

    information (V, P, P) and vector (V, P) are as in OwnParameters; log_evidence (V,) is that of a value each less that
    of the same likelihood, both relative to the effect's absence.
    """

    information: Array
    vector: Array
    log_evidence: Array
    free: tuple[Free, ...]

    def sum(self, chosen: Sequence[int]) -> OwnParameters:
        """Likelihood of the chosen vehicles together."""
        return OwnParameters(self.information[chosen].sum(0), self.vector[chosen].sum(0), self.free)

    def of_all(self, chosen: Sequence[int]) -> float:
        """Log evidence of one value in the chosen vehicles, relative to the effect's absence."""
        return float(self.log_evidence[chosen].sum()) - self.sum(chosen).neg2_log_evidence() / 2.0

    def of_each(self, chosen: Sequence[int]) -> Array:
        """Log evidence (of the chosen) that each adds to the others."""
        information, vector, _ = whole = self.sum(chosen)
        others = [OwnParameters(information - self.information[i], vector - self.vector[i], self.free) for i in chosen]
        shared = np.array([each.neg2_log_evidence() for each in others]) - whole.neg2_log_evidence()
        return np.asarray(self.log_evidence[chosen] + shared / 2.0)


def shared_effects(
    effects: Mapping[str, Effect],
    n_wheels: int,
    factors_beside: Callable[[tuple[SharedEffect, ...]], Sequence[Mapping[str, Factor]]],
    options: TypeOptions = TYPE_DEFAULT,
) -> tuple[SharedEffect, ...]:
    """The effects that a type has, one after the other.

    Parameters
    ----------
    effects, n_wheels, options
        As of shared_effect().
    factors_beside
        Diagnoses every vehicle beside effects of the type; gives their factors.
    """
    found: tuple[SharedEffect, ...] = ()
    vehicles = factors_beside(found)
    while (one := shared_effect(effects, vehicles, n_wheels, options)) is not None:
        found = (*found, one)
        vehicles = factors_beside(found)
    return found


def shared_effect(
    effects: Mapping[str, Effect],
    vehicles: Sequence[Mapping[str, Factor]],
    n_wheels: int,
    options: TypeOptions = TYPE_DEFAULT,
) -> SharedEffect | None:
    """The effect that the vehicles of a type share, the most probable one.

    Parameters
    ----------
    effects
        Of the catalogue, by name.
    vehicles
        Of each vehicle of the type, the factors by name; {} of one that says nothing.
    n_wheels
        Of a vehicle.
    options
        Of the judgement.

    Returns
    -------
    SharedEffect or None
        None where the vehicles' own effects, or none, explain as much.
    """
    usable = [v for v, factors in enumerate(vehicles) if factors]
    found = _most_probable([vehicles[v] for v in usable], options) if len(usable) >= options.min_vehicles else None
    if found is None:
        return None
    name, pool, chosen, p = found
    free = parameters_of(effects[name], n_wheels)
    members = {usable[i]: i for i in chosen}
    given = [_given(free, pool.sum([i for member, i in members.items() if member != v])) for v in range(len(vehicles))]
    common = {f.name for f in pool.free}
    values = [f for f in _given(free, pool.sum(chosen)) if f.name in common]
    parameters = {f.name.removeprefix(f"{name}."): Estimate(f.value, f.std) for f in values}
    return SharedEffect(effects[name], p, tuple(members), parameters, tuple(given))


def _most_probable(
    vehicles: Sequence[Mapping[str, Factor]], options: TypeOptions
) -> tuple[str, Pool, list[int], float] | None:
    """Name, likelihoods, vehicles that agree, and probability; None where nothing is more probable than not."""
    names = sorted(set.union(*(set(factors) for factors in vehicles)))
    found: dict[str, tuple[float, Pool, list[int]]] = {}
    for name in names:
        shown = [v for v, factors in enumerate(vehicles) if name in factors]
        pool, own = _pool(name, vehicles), np.zeros(len(vehicles))
        own[shown] = _own_log_evidence(name, [vehicles[v] for v in shown])
        chosen = _agreeing(pool, own, shown, options) if pool.free else None
        if chosen is not None:
            # any effect of the catalogue may be the type's, each as likely beforehand as another
            log_odds = pool.of_all(chosen) - float(own[chosen].sum()) - math.log(len(names))
            found[name] = log_odds, pool, chosen
    if not found:
        return None
    best = max(found, key=lambda name: found[name][0])
    log_odds, pool, chosen = found[best]
    p = _name_probability(best, [vehicles[v] for v in chosen]) * float(expit(log_odds))
    return (best, pool, chosen, p) if p >= 0.5 else None


def _name_probability(best: str, vehicles: Sequence[Mapping[str, Factor]]) -> float:
    """Probability of a name among those in its place in the vehicles that agree, and nothing (see `verdict`).

    At the temperature of all their recordings together: a formula that is off is off in all of them, and leaves
    something that is alike in all.
    """
    places = [factors[best] for factors in vehicles]
    divisor = temperature(sum(abs(place.excess) for place in places), UNBOUNDED)
    log_evidence: dict[str, float] = {}
    for name in sorted({rival for place in places for rival in place.falls}):
        here = [
            {name: replace(factors[name], falls=place.falls)} if name in factors and name in place.falls else {}
            for factors, place in zip(vehicles, places, strict=True)
        ]
        pool = _pool(name, here, divisor) if any(here) else None
        if pool is not None and pool.free:
            log_evidence[name] = pool.of_all(range(len(vehicles)))
    of_all = [*log_evidence.values(), TEMPERED_FALL_OF_NONE / 2.0]
    return float(softmax(of_all)[list(log_evidence).index(best)])


def _pool(name: str, vehicles: Sequence[Mapping[str, Factor]], of_all: float | None = None) -> Pool:
    """The factors in the parameters that all have, others are marginalised; a vehicle without a factor is neutral.

    of_all is what each is divided by, its own temperature where it is None.
    """
    factors = {v: of_vehicle[name] for v, of_vehicle in enumerate(vehicles) if name in of_vehicle}
    common = set.intersection(*({f.name for f in factor.own.free} for factor in factors.values()))
    V, P = len(vehicles), len(common)
    information, vector, log_evidence = np.zeros((V, P, P)), np.zeros((V, P)), np.zeros(V)
    free: tuple[Free, ...] = ()
    for v, factor in factors.items():
        own, divisor = _marginal(factor.own, common), factor.divisor if of_all is None else of_all
        log_evidence[v] = (factor.falls[name] + own.neg2_log_evidence()) / divisor / 2.0
        information[v], vector[v] = own.information / divisor, own.information_vector / divisor
        free = own.free
    return Pool(information, vector, log_evidence, free)


def _marginal(own: OwnParameters, names: set[str]) -> OwnParameters:
    kept = [i for i, f in enumerate(own.free) if f.name in names]
    mean, covariance = own.moments()
    return own_parameters(mean[kept], covariance[np.ix_(kept, kept)], [own.free[i] for i in kept])


def _agreeing(pool: Pool, own: Array, shown: Sequence[int], options: TypeOptions) -> list[int] | None:
    """The vehicles that one value explains better than effects of their own; None where these are not most of all.

    Most must show the effect too: with the value of the others it explains something in them.  shown are those whose
    logs say something of the effect.
    """

    def are_most(vehicles: Sequence[int]) -> bool:
        return 2 * len(vehicles) > len(own) and len(vehicles) >= options.min_vehicles

    chosen = list(shown)
    at_once = 1 + int(options.left_out_share * len(own))
    while are_most(chosen) and (worse := pool.of_each(chosen) - own[chosen]).min() < 0.0:
        left_out = {chosen[k] for k in np.argsort(worse)[:at_once] if worse[k] < 0.0}
        chosen = [i for i in chosen if i not in left_out]
    if not are_most(chosen):
        return None
    whole = pool.of_all(chosen)  # a vehicle may be left out on account of another that was left out after it
    back = [i for i in shown if i not in chosen and pool.of_all([*chosen, i]) - whole >= own[i]]
    chosen = sorted([*chosen, *back])
    showing = [i for i, adds in zip(chosen, pool.of_each(chosen), strict=True) if adds > options.shown_log_evidence]
    return chosen if are_most(showing) else None


def _own_log_evidence(name: str, vehicles: Sequence[Mapping[str, Factor]]) -> Array:
    """Tempered log evidence (V,) of an effect of each vehicle's own in the place of this one, relative to none.

    A value of its own is paid in full in each vehicle: data divided by a temperature tell it less well (see
    OwnParameters.surcharge).
    """
    places = []
    for factors in vehicles:
        here = factors[name]
        own = {rival: factors.get(rival, here).own.surcharge(here.divisor) for rival in here.falls}
        places.append({rival: (fall / here.divisor - own[rival]) / 2.0 for rival, fall in here.falls.items()})
    log_odds, _ = _columns(places)
    return np.asarray(logsumexp(log_odds + np.log(_shares(log_odds, np.arange(len(vehicles)))), axis=1))


def _columns(places: Sequence[Mapping[str, float]], names: int = 0) -> tuple[Array, list[str]]:
    """Log odds (R, 1 + K) of nothing and of each name, relative to nothing, and the names.

    names: least K; columns without a name are -inf.
    """
    columns = sorted({name for place in places for name in place})
    log_odds = np.full((len(places), 1 + max(names, len(columns))), -np.inf)
    log_odds[:, 0] = 0.0
    for row, place in zip(log_odds, places, strict=True):
        row[[1 + columns.index(name) for name in place]] = list(place.values())
    return log_odds, columns


def _shares(log_odds: Array, vehicle: NDArray[np.intp]) -> Array:
    """Probability (R, 1 + K) of nothing and of each effect, in each place, as those of other vehicles show them.

    Parameters
    ----------
    log_odds : (R, 1 + K)
        Log evidence of nothing and of each effect, relative to nothing, in each place for an effect.
    vehicle : (R,)
        Of each place.
    """
    R, K = len(log_odds), log_odds.shape[1] - 1
    shares, before = np.full((R, 1 + K), 0.5 / K), np.zeros((R, 1 + K))
    shares[:, 0] = 0.5
    while not np.allclose(shares, before, equal_nan=True):
        posterior, before = softmax(log_odds + np.log(shares), axis=1), shares
        of_vehicle = np.zeros((R, 1 + K))  # each vehicle has a place
        np.add.at(of_vehicle, vehicle, posterior)
        others = np.maximum(of_vehicle.sum(0) - of_vehicle[vehicle], 0.0)
        with_one = others[:, 1:].sum(1, keepdims=True)
        something = (with_one + 1.0) / (others.sum(1, keepdims=True) + 2.0)
        shares = np.hstack([1.0 - something, something * (others[:, 1:] + 1.0) / (with_one + K)])
    return shares


def own_probabilities(found: Sequence[Sequence[Mapping[str, float]]], names: int) -> list[list[dict[str, float]]]:
    """Probabilities of vehicles' own effects, by how common these are in the other vehicles of the type.

    Parameters
    ----------
    found
        Of each vehicle, for each effect that it shows, the probabilities of its names: each name as likely beforehand
        as another, and all together as nothing.
    names
        Effects that can be named.

    Returns
    -------
    list of list of dict
        The same names.
    """
    # a vehicle that shows nothing counts as one place with nothing in it
    places = [(v, place) for v, of_vehicle in enumerate(found) for place in (of_vehicle or [{}])]
    odds = []
    for _, place in places:
        nothing = max(1.0 - sum(place.values()), ROUNDING)
        odds.append({name: math.log(max(p, ROUNDING) / nothing * names) for name, p in place.items()})
    log_odds, columns = _columns(odds, names)
    shares = _shares(log_odds, np.array([v for v, _ in places], int))
    posterior = softmax(log_odds + np.log(shares), axis=1)[:, 1:]
    out: list[list[dict[str, float]]] = [[] for _ in found]
    for (v, place), of_place in zip(places, posterior, strict=True):
        if place:
            out[v].append({name: float(of_place[columns.index(name)]) for name in place})
    return out


def _given(parameters: Sequence[Free], likelihood: OwnParameters) -> tuple[Free, ...]:
    """An effect's parameters with the posterior by a likelihood as prior."""
    mean, covariance = likelihood.moments()
    sd = np.sqrt(np.diag(covariance))
    at = {f.name: i for i, f in enumerate(likelihood.free)}
    return tuple(
        replace(f, value=f.at(float(mean[at[f.name]])), std=f.std * float(sd[at[f.name]])) if f.name in at else f
        for f in parameters
    )
