"""Which vehicles of a fleet have which fault, and since when.

    expected share of false names in a set S = mean over S of (1 - P),  P = probability that the vehicle has the effect
    S = the largest set, taken in the order of P, whose expected share is at most FALSE_DISCOVERY_RATE
    -2 log evidence(effect from log k on) = sum of E0 before k + sum of E1 from k on

Naming each vehicle's best effect would give a fleet of 10 000 hundreds of false names.  The set S bounds their expected
share (Newton et al. 2004, Biostatistics 5:155).  A fault of a sensor begins at some day: E0 and E1 are the -2 log
evidences of each log alone, without and with the effect, its size free in each; the soil is each log's own in any case.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from soilbus.diagnosis.diagnose import Diagnosis, diagnose
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.verdict import TEMPERATURE, Verdict
from soilbus.estimation.posterior import Estimate, SoilPrior
from soilbus.terra.effects.effect import Effect

__all__ = [
    "FALSE_DISCOVERY_RATE",
    "Onset",
    "VehicleDiagnosis",
    "diagnose_vehicle",
    "named",
    "onset_of",
    "onset_probabilities",
]

FALSE_DISCOVERY_RATE = 0.05
"""Expected share of names that are false, over the fleet: the usual level of a test."""


@dataclass(frozen=True, slots=True)
class Onset:
    """Since which log a vehicle has an effect.

    Attributes
    ----------
    effect
        Its name.
    first
        Index of the first log with the effect, the most probable one.
    probabilities
        Of each log to be the first.
    sizes
        The effect's parameters as each log alone shows them; None where its fit failed.
    """

    effect: str
    first: int
    probabilities: tuple[float, ...]
    sizes: tuple[Mapping[str, Estimate] | None, ...]


@dataclass(frozen=True, slots=True)
class VehicleDiagnosis:
    """Diagnosis of one vehicle over its logs.

    Attributes
    ----------
    diagnosis
        Joint diagnosis of the logs that have the effects: all, or those from the onset of the first effect on.
    onset
        Of the effect that explains most; None where none was found, or there is one log only.
    """

    diagnosis: Diagnosis
    onset: Onset | None

    @property
    def probabilities(self) -> dict[str, float]:
        """Probability of each effect that may be in the model; none where what was found does not explain the gap."""
        found: dict[str, float] = {}
        if self.diagnosis.verdict is Verdict.UNKNOWN:
            return found
        for addition in self.diagnosis.additions:
            for name, p in ({addition.effect.name: addition.probability} | addition.alternatives).items():
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
    found = diagnose(records, prior, catalogue)
    if not found.additions or len(records) == 1:
        return VehicleDiagnosis(found, None)
    onset = onset_of(records, prior, found.additions[0].effect)
    if onset.first > 0:  # one value of the effect for all logs was wrong: it belongs to the later ones
        found = diagnose(records[onset.first :], prior, catalogue)
    return VehicleDiagnosis(found, onset)


def onset_of(records: Sequence[Record], prior: SoilPrior, effect: Effect) -> Onset:
    """The first of several logs from which on a vehicle has an effect.

    Parameters
    ----------
    records
        In the order of their dates.
    prior
        Of the soil.
    effect
        The effect.
    """
    without, along, sizes = [], [], []
    for record in records:
        present = record.training.effects
        base, full = (fit_model([record], prior, effects) for effects in (present, (*present, effect)))
        without.append(np.inf if base is None else base.neg2_log_evidence)
        along.append(np.inf if full is None else full.neg2_log_evidence)
        sizes.append(None if full is None else full.parameters()[effect.name])
    probabilities = onset_probabilities(np.array(without) - np.array(along))
    return Onset(effect.name, int(np.argmax(probabilities)), tuple(probabilities), tuple(sizes))


def onset_probabilities(falls: Sequence[float]) -> list[float]:
    """Probability of each log to be the first with an effect.

    Parameters
    ----------
    falls
        Fall of -2 log evidence by the effect in each log alone; not finite where a fit failed, which counts as 0.

    Returns
    -------
    Probabilities; each log is as likely as any other beforehand, and evidences are tempered as in `verdict`.
    """
    known = np.where(np.isfinite(falls), falls, 0.0)
    explained = np.cumsum(known[::-1])[::-1]
    return [float(p) for p in softmax(explained / (2.0 * TEMPERATURE))]


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
