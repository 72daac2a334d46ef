"""Which vehicles of a fleet have which fault, and since when.

    expected share of false names in a set S = mean over S of (1 - P),  P = probability that the vehicle has the effect
    S = the largest set, taken in the order of P, whose expected share is at most FALSE_DISCOVERY_RATE
    score(effect from log k on) = that expected of prod(i >= k) L_i(u)  (`blocks`),  u = the effect's size

Naming each vehicle's best effect would give a fleet of 10 000 hundreds of false names.  The set S bounds their expected
share (Newton et al. 2004, Biostatistics 5:155).  A fault of a sensor begins at some day and then has one size: L_i is
the likelihood of that size by log i alone (Gaussian around its fit), whose soil is its own.  That no log has it is one
more case, and its probability is taken from the name's: what all logs together seem to show, and none of them by
itself, may be no fault of the vehicle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from soilbus.diagnosis.blocks import expected_change
from soilbus.diagnosis.diagnose import Diagnosis, diagnose
from soilbus.diagnosis.fitted_model import SizeLikelihood, fit_model
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.verdict import Verdict
from soilbus.estimation.posterior import Estimate, SoilPrior
from soilbus.terra.effects.effect import Effect

FALSE_DISCOVERY_RATE = 0.05
"""Expected share of names that are false, over the fleet: the usual level of a test."""

MAX_ROUNDS = 2
"""Times that a vehicle is diagnosed once more from the onset on, as another effect may then explain most."""


@dataclass(frozen=True, slots=True)
class Onset:
    """Since which log a vehicle has an effect.

    Attributes
    ----------
    first
        Index of the first log with the effect, the most probable one.
    probabilities
        Of each log to be the first.
    never
        Probability that no log has it.
    sizes
        The effect's parameters as each log alone shows them; None where its fit failed.
    """

    first: int
    probabilities: tuple[float, ...]
    never: float
    sizes: tuple[Mapping[str, Estimate] | None, ...]


@dataclass(frozen=True, slots=True)
class VehicleDiagnosis:
    """Diagnosis of one vehicle over its logs.

    Attributes
    ----------
    diagnosis
        Joint diagnosis of the logs that have the effects: all, or those from the onset of the first effect on.
    onsets
        Of each effect found, by name; none where there is one log only.
    """

    diagnosis: Diagnosis
    onsets: Mapping[str, Onset]

    @property
    def places(self) -> list[dict[str, float]]:
        """For each effect found, the probabilities of its names; none where what was found does not explain the gap."""
        if self.diagnosis.verdict is Verdict.UNKNOWN:
            return []
        found = []
        for addition in self.diagnosis.additions:
            onset = self.onsets.get(addition.effect.name)
            shown = 1.0 if onset is None else 1.0 - onset.never
            names = {addition.effect.name: addition.probability} | addition.alternatives
            found.append({name: p * shown for name, p in names.items()})
        return found

    @property
    def probabilities(self) -> dict[str, float]:
        """Probability of each effect that may be in the model."""
        found: dict[str, float] = {}
        for place in self.places:
            for name, p in place.items():
                found[name] = max(p, found.get(name, 0.0))
        return found


def diagnose_vehicle(records: Sequence[Record], prior: SoilPrior, catalogue: Sequence[Effect]) -> VehicleDiagnosis:
    """Joint diagnosis of a vehicle's logs, and since which of them it has what was found.

    Parameters
    ----------
    records
        In the order of their dates.
    prior
        Of the soil, the same for each recording.
    catalogue
        Effects that may be missing.

    Raises
    ------
    NotFitted
        Where already the present model cannot be fitted.
    """
    first, found = _first_diagnosis(records, prior, catalogue)
    onsets = onsets_of(records, prior, found)
    for _ in range(MAX_ROUNDS):
        surest = max(onsets.values(), key=lambda onset: max(onset.probabilities), default=None)
        begin = first if surest is None else surest.first
        if begin <= first:  # the logs before contradicted those after: another effect's onset does not undo that
            break
        # one value of the effect for all logs was wrong: it belongs to those from its onset on
        first, found = begin, diagnose(records[begin:], prior, catalogue)
        onsets = onsets_of(records, prior, found)
    return VehicleDiagnosis(found, onsets)


def _first_diagnosis(records: Sequence[Record], prior: SoilPrior, catalogue: Sequence[Effect]) -> tuple[int, Diagnosis]:
    """The diagnosis of all logs, or of those from a change of the vehicle on where that explains more; and the first.

    A fault that begins lets the logs contradict each other under the present model, and no effect of one size explains
    that: rather one that each log may have for itself.
    """
    found = diagnose(records, prior, catalogue)
    if len(records) == 1 or found.verdict is Verdict.NONE:
        return 0, found

    def score(some: Sequence[Record]) -> float:
        fitted = fit_model(some, prior, some[0].training.effects)
        return np.inf if fitted is None else fitted.score

    together = score(records)
    apart = [score(records[:k]) + score(records[k:]) for k in range(1, len(records))]
    if min(apart) >= together:
        return 0, found
    first = 1 + int(np.argmin(apart))
    later = diagnose(records[first:], prior, catalogue)
    explained = found.verdict is not Verdict.UNKNOWN or later.verdict is Verdict.UNKNOWN
    if explained and together - _explained(found) <= min(apart) - _explained(later):
        return 0, found
    return first, later


def _explained(found: Diagnosis) -> float:
    """Fall of the score by all effects added."""
    return found.base.score - found.completed.score


def onsets_of(records: Sequence[Record], prior: SoilPrior, found: Diagnosis) -> dict[str, Onset]:
    """The onset of each effect of the vehicle, beside the others of a diagnosis, by name; none of a single log."""
    effects = [addition.effect for addition in found.additions] if len(records) > 1 else []
    return {
        e.name: onset_of(records, prior, e, [other for other in effects if other is not e])
        for e in effects
        if not e.of_record
    }


def onset_of(records: Sequence[Record], prior: SoilPrior, effect: Effect, beside: Sequence[Effect] = ()) -> Onset:
    """The first of several logs from which on a vehicle has an effect.

    Parameters
    ----------
    records
        In the order of their dates.
    prior
        Of the soil.
    effect
        The effect.
    beside
        Other effects of the model.
    """
    shown: list[SizeLikelihood | None] = []
    sizes: list[Mapping[str, Estimate] | None] = []
    for record in records:
        fitted = fit_model([record], prior, (*record.training.effects, *beside, effect))
        shown.append(None if fitted is None else fitted.size_likelihood(effect))
        sizes.append(None if fitted is None else fitted.parameters()[effect.name])
    falls = [_fall(shown[k:]) for k in range(len(records))]
    *probabilities, never = onset_probabilities(falls)
    return Onset(int(np.argmax(probabilities)), tuple(probabilities), never, tuple(sizes))


def _fall(shown: Sequence[SizeLikelihood | None]) -> float:
    """Expected fall of the score by an effect of one size in all of these logs; a fit that failed says nothing.

    A parameter that some log's fit holds at the edge of its range is left out.
    """
    known = [each for each in shown if each is not None]
    common = set.intersection(*({f.name for f in each.free} for each in known)) if known else set()
    if not common:
        return 0.0
    kept = [[i for i, f in enumerate(each.free) if f.name in common] for each in known]
    information = np.sum([each.information[np.ix_(at, at)] for each, at in zip(known, kept, strict=True)], axis=0)
    vector = np.sum([each.vector[at] for each, at in zip(known, kept, strict=True)], axis=0)
    return -expected_change(information, vector)


def onset_probabilities(falls: Sequence[float]) -> list[float]:
    """Probability of each log to be the first with an effect, and, last, that none has it.

    Parameters
    ----------
    falls
        Fall of the score by an effect that all logs from this one on have.

    Returns
    -------
    Probabilities; beforehand each case is as likely as any other.
    """
    return [float(p) for p in softmax(np.array([*falls, 0.0]) / 2.0)]


def named(probabilities: Sequence[float], rate: float = FALSE_DISCOVERY_RATE) -> list[bool]:
    """Which names to give, so that the expected share of false ones is at most `rate`.

    Parameters
    ----------
    probabilities
        That each name is right.
    rate
        Expected share of false names among those given.

    Examples
    --------
    >>> named([0.99, 0.5, 0.93, 0.2])
    [True, False, True, False]
    """
    order = sorted(range(len(probabilities)), key=lambda i: -probabilities[i])
    given = [False] * len(probabilities)
    false = 0.0
    for n, i in enumerate(order, 1):
        false += 1.0 - probabilities[i]
        if false > rate * n:
            break
        given[i] = True
    return given
