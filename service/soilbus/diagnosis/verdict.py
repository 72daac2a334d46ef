"""From evidences to a verdict: none, named, ambiguous or unknown, with probabilities.

    P(name) = exp(zeta fall / 2) / (K + sum over names of exp(zeta fall / 2)),  fall = -2 log evidence before - after
    zeta = zeta_0 alpha / (alpha + E) = 1 / T,  E = |chi2 - rows| without effects;  K: effects of the catalogue

No effect's formula is exactly that of the field: one that is off by a share e of its effect leaves e^2 E unexplained,
however long the recording.  So the likelihood counts to the power zeta, as if the data were to follow some model to
within a relative entropy in proportion to E only (coarsened posterior: Miller & Dunson 2019, J. Am. Stat. Assoc.
114:1113).  Where nothing is missing zeta is zeta_0, as residuals that follow each other are not independent.
A priori nothing is missing with probability 1/2, and every effect with 1 / 2 K.  An effect is added where it is more
probable than none, and explains a good part of the gap and more than the formulas of the others may leave; the verdict
is `unknown` where too much of the gap remains: where loads are computed, too much for all that these leave open, as
loads that shake are no effect.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from types import MappingProxyType

import numpy as np
from scipy.special import softmax

from soilbus.diagnosis.evidence import OwnParameters
from soilbus.diagnosis.options import DEFAULT, DiagnosisOptions
from soilbus.terra.effects.catalogue import CATALOGUE

TEMPERED_FALL_OF_NONE = 2.0 * math.log(len(CATALOGUE))
"""Tempered fall from which an effect is more probable than none."""


class Verdict(StrEnum):
    """What the diagnosis comes to."""

    NONE = "none"
    NAMED = "named"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


def verdict_of(
    before: float,
    after: float,
    rows: int,
    chances: Sequence[float],
    is_doubtful: bool = False,
    options: DiagnosisOptions = DEFAULT,
) -> Verdict:
    """The verdict of a diagnosis.

    Parameters
    ----------
    before, after
        Gaps (reduced chi-square) under the present model and with the effects added; where loads are computed with all
        that these leave open (Gap.with_open_loads).
    rows
        Held-out residuals of which the gaps are.
    chances
        Probability of each effect added.
    is_doubtful
        Whether the names are not to be trusted at any probability: the effects explain the data only together
        (`diagnose.shares_alone`), one of them explains them only at the edge of its range, or the present model's fit
        did not converge, so that every fall from it is too large.
    """
    if is_unexplained(before, after, rows, options):
        return Verdict.UNKNOWN
    if not chances:
        return Verdict.NONE
    return Verdict.NAMED if min(chances) >= options.named_probability and not is_doubtful else Verdict.AMBIGUOUS


def is_unexplained(before: float, after: float, checked_rows: int, options: DiagnosisOptions = DEFAULT) -> bool:
    """Whether a gap (reduced chi-square) remains that the effects added do not explain."""
    is_explained = math.isfinite(after) and after - 1.0 <= options.max_unexplained_share * (before - 1.0)
    return not (after <= gap_limit(checked_rows, options) or is_explained)


def gap_limit(degrees: float, options: DiagnosisOptions = DEFAULT) -> float:
    """Reduced chi-square of this number of held-out residuals, degrees of freedom, up to which noise explains them."""
    return max(options.least_gap_limit, 1.0 + options.gap_limit_sd * math.sqrt(2.0 / max(degrees, 1.0)))


def temperature(excess: float, options: DiagnosisOptions = DEFAULT) -> float:
    """T = 1 / zeta where the present model's squared residuals differ from what noise leaves by this much.

    Fewer than expected are as little a description of the noise as more.
    """
    return (1.0 + min(abs(excess), options.max_excess) / options.alpha) / options.zeta_0


def required_fall(
    divisor: float,
    gap: float,
    checked_rows: int,
    rows: int,
    options: DiagnosisOptions = DEFAULT,
    excess: float | None = None,
    explained: float = 0.0,
) -> float:
    """Fall of -2 log evidence from which an effect is added.

    Parameters
    ----------
    divisor
        The temperature.
    gap, checked_rows
        Reduced chi-square under the present model, and the number of held-out residuals of which it is.
    rows
        Residuals of all blocks.
    excess
        Of all blocks' chi-square over the expected one, where all of it counts; else that of a gap beyond noise.
    explained
        What the effects of the present model take from that excess: their formulas leave a share of it.
    """
    if excess is None:
        excess = (gap - 1.0) * rows if gap > gap_limit(checked_rows, options) else 0.0
    of_formulas = options.max_formula_error**2 * explained
    return max(least_required_fall(divisor), options.least_gap_share * excess, of_formulas)


def least_required_fall(divisor: float) -> float:
    """The required fall where no gap is seen: an effect is then as probable as none."""
    return TEMPERED_FALL_OF_NONE * divisor


def dominated_deficit(divisor: float, options: DiagnosisOptions = DEFAULT) -> float:
    """-2 log posterior above the best candidate's from which a candidate cannot get into the set of names.

    Twice the deficit of -2 log evidence at which its probability is `set_probability`: the posterior lacks the penalty
    for parameters.
    """
    return -4.0 * math.log(options.set_probability) * divisor


def probabilities(
    falls: Mapping[str, float],
    divisor: float,
    own: Mapping[str, Sequence[OwnParameters]] = MappingProxyType({}),
) -> dict[str, float]:
    """Probability of each candidate's name, the largest first.

    Parameters
    ----------
    falls
        Fall of -2 log evidence by name.
    divisor
        The temperature.
    own
        By name, the parameters that each recording has for itself: that their values agree is a coincidence, which no
        error of a formula makes more likely.  A recording may lack them.  The one that costs most is not charged, as
        in a single recording nothing has to agree.

    Returns
    -------
    dict
        Probabilities; what they lack to one is the probability that nothing more is missing.
    """
    tempered = [
        fall / divisor - sum(sorted(one.surcharge_or_absent(divisor) for one in own.get(name, ()))[:-1])
        for name, fall in falls.items()
    ]
    chances = softmax(np.array([*tempered, TEMPERED_FALL_OF_NONE]) / 2.0).tolist()[:-1]
    return dict(sorted(zip(falls, chances, strict=True), key=lambda item: -item[1]))


def soil_error_share(name: str, options: DiagnosisOptions = DEFAULT) -> float:
    """Share of the change of the soil's parameters by an effect of this name that counts as a standard deviation."""
    return options.tyre_soil_error_share if name == "tyre_deflection" else options.soil_error_share


def mean_soil_error_share(chances: Mapping[str, float], options: DiagnosisOptions = DEFAULT) -> float:
    """Root mean square of the shares of these names, weighted by their probabilities."""
    square = sum(p * soil_error_share(name, options) ** 2 for name, p in chances.items())
    return math.sqrt(square / sum(chances.values()))
