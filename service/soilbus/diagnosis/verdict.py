"""From evidences to a verdict: none, named, ambiguous or unknown, with probabilities.

    P(name) = exp(zeta fall / 2) / (K + sum over names of exp(zeta fall / 2)),  fall = -2 log evidence before - after
    zeta = zeta_0 alpha / (alpha + E) = 1 / T,  E = chi2 - rows of the present model;  K: effects of the catalogue

No effect's formula is exactly that of the field: one that is off by a share e of its effect leaves e^2 E unexplained,
however long the recording.  So the likelihood counts to the power zeta, as if the data were to follow some model to
within a relative entropy in proportion to E only (coarsened posterior: Miller & Dunson 2019, J. Am. Stat. Assoc.
114:1113).  Where nothing is missing zeta is zeta_0, as residuals that follow each other are not independent.
A priori nothing is missing with probability 1/2, and every effect with 1 / 2 K.  An effect is added where it is more
probable than none and explains a good part of the gap; the verdict is `unknown` where too much of the gap remains.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from types import MappingProxyType

import numpy as np
from scipy.special import softmax

from soilbus.diagnosis.evidence import OwnParameters
from soilbus.terra.effects.catalogue import CATALOGUE

MAX_EXCESS = 10000.0
"""Excess from which on evidence counts no less: without it 4 of 24 blind pairs (seeds 301 to 303) lose their smaller
effect."""
ALPHA, ZETA_0 = 400.0, 0.5
"""Excess of squared residuals at which evidence counts half as much, and how much it counts without excess.

Of 140 blind cases (seeds 211 and 212) names are right about as often as their probability says; with 200 to 2000, and
1/3 to 2/3, as many single effects are named first.  Other seeds: service/docs/diagnosis.md.
"""
TEMPERED_FALL_OF_NONE = 2.0 * math.log(len(CATALOGUE))
"""Tempered fall from which an effect is more probable than none."""
LEAST_GAP_SHARE = 0.25
"""Share of a real gap's excess over noise that an effect must explain to be added.  Without it 6 of 18 cases outside
the catalogue (seeds 211 and 212) get names beside the verdict `unknown`, with it 2."""

NAMED_PROBABILITY = 0.8
"""Probability from which a name stands alone."""
SET_PROBABILITY = 0.02
"""Probability from which a name belongs to the set."""
MAX_UNEXPLAINED_SHARE = 0.15
"""Share of the gap's excess over noise that named effects may leave, as no formula is that of the field.  Of 400 blind
cases (seeds 211 to 303) 0.1 and 0.2 change one verdict each."""
GAP_LIMIT_SD = 4.0
"""Standard deviations of a reduced chi-square beyond which a gap is real."""
LEAST_GAP_LIMIT = 1.04
"""Reduced chi-square up to which no gap is reported, however many residuals: noise is not known better."""

SOIL_ERROR_SHARE = 0.125
"""Share of what an effect changes of the soil's parameters by which these are off (standard deviation), as no
effect's formula is the field's: of the blind `tune` halves of seeds 109 to 113."""
SOIL_ERROR_SHARE_OF: Mapping[str, float] = MappingProxyType({"tyre_deflection": 1.0})
"""The same by name, for effects whose share is another."""


class Verdict(StrEnum):
    """What the diagnosis comes to."""

    NONE = "none"
    NAMED = "named"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


def verdict_of(before: float, after: float, rows: int, chances: Sequence[float], imitation: bool = False) -> Verdict:
    """The verdict of a diagnosis.

    Parameters
    ----------
    before, after
        Gaps (reduced chi-square) under the present model and with the effects added.
    rows
        Held-out residuals of which the gaps are.
    chances
        Probability of each effect added.
    imitation
        Whether the effects explain the data only together, see `diagnose.shares_alone`.
    """
    if is_unexplained(before, after, rows):
        return Verdict.UNKNOWN
    if not chances:
        return Verdict.NONE
    return Verdict.NAMED if min(chances) >= NAMED_PROBABILITY and not imitation else Verdict.AMBIGUOUS


def is_unexplained(before: float, after: float, checked_rows: int) -> bool:
    """Whether a gap (reduced chi-square) remains that the effects added do not explain."""
    return after > gap_limit(checked_rows) and after - 1.0 > MAX_UNEXPLAINED_SHARE * (before - 1.0)


def gap_limit(rows: int) -> float:
    """Reduced chi-square of this number of held-out residuals up to which noise explains them."""
    return max(LEAST_GAP_LIMIT, 1.0 + GAP_LIMIT_SD * math.sqrt(2.0 / max(rows, 1)))


def temperature(excess: float) -> float:
    """T = 1 / zeta where the present model's squared residuals exceed their number by this much."""
    return (1.0 + min(max(excess, 0.0), MAX_EXCESS) / ALPHA) / ZETA_0


def temperature_of_all(temperatures: Sequence[float]) -> float:
    """T of recordings together, from that of each: their excesses add up."""
    return sum(temperatures) - (len(temperatures) - 1) / ZETA_0


def required_fall(divisor: float, gap: float, checked_rows: int, rows: int) -> float:
    """Fall of -2 log evidence from which an effect is added.

    Parameters
    ----------
    divisor
        The temperature.
    gap, checked_rows
        Reduced chi-square under the present model, and the number of held-out residuals of which it is.
    rows
        Residuals of all blocks.
    """
    excess = (gap - 1.0) * rows if gap > gap_limit(checked_rows) else 0.0
    return max(least_required_fall(divisor), LEAST_GAP_SHARE * excess)


def least_required_fall(divisor: float) -> float:
    """The required fall where no gap is seen: an effect is then as probable as none."""
    return TEMPERED_FALL_OF_NONE * divisor


def dominated_deficit(divisor: float) -> float:
    """-2 log posterior above the best candidate's from which a candidate cannot get into the set of names.

    Twice the deficit of -2 log evidence at which its probability is SET_PROBABILITY: the posterior lacks the penalty
    for parameters.
    """
    return -4.0 * math.log(SET_PROBABILITY) * divisor


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


def soil_error_share(name: str) -> float:
    """Share of the change of the soil's parameters by an effect of this name that counts as a standard deviation."""
    return SOIL_ERROR_SHARE_OF.get(name, SOIL_ERROR_SHARE)


def mean_soil_error_share(chances: Mapping[str, float]) -> float:
    """Root mean square of the shares of these names, weighted by their probabilities."""
    return math.sqrt(sum(p * soil_error_share(name) ** 2 for name, p in chances.items()) / sum(chances.values()))
