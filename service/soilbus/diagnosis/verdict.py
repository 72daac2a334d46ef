"""From evidences to a verdict: none, named, ambiguous or unknown, with probabilities.

    P(name) = (1 - q) softmax(fall / (2 T)) + q softmax(fall / (2 T')),  fall = -2 log evidence before - after

No effect's formula is exactly that of the field.  A formula that is off by a share e of its effect leaves e^2 of what
there was to explain, so differences of evidence are divided by a temperature that grows with what is explained: T
usually, the larger T' with probability q (P_LARGE_FORMULA_ERROR).  An effect is added only if its fall exceeds a
required fall, and the verdict is `unknown` if the gap that remains is too large.

The constants were set looking at the blind cases of seeds 1 and 2 and the `tune` half of seed 3
(`python -m soilbus.validation.blind`), MAX_UNEXPLAINED_SHARE_OF_LARGE_GAP at the `tune` halves of seeds 107 to 111;
what is reported are `report` halves of seeds from 3 on.
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

COARSENING = 3000.0
"""Squared residuals of the base model for each unit of temperature (alpha of the coarsened posterior)."""
TEMPERED_FALL_OF_NONE = 2.0 * math.log(len(CATALOGUE))
"""Tempered fall from which an effect is more probable than none: a priori the model is as likely to be complete as not,
and all effects are equally likely."""
LEAST_GAP_SHARE = 0.25
"""Share of a real gap's excess over noise that an effect must explain to be added."""

NAMED_PROBABILITY = 0.8
"""Probability from which a name stands alone."""
SET_PROBABILITY = 0.02
"""Probability from which a name belongs to the set."""
MAX_UNEXPLAINED_SHARE, MAX_UNEXPLAINED_SHARE_OF_LARGE_GAP = 0.35, 0.08
"""Share of the gap's excess over noise that named effects may leave, as no formula is that of the field: where the
remaining gap is small, and where it is large."""
LARGE_GAP = 1.5
"""Reduced chi-square from which a remaining gap is large."""
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
    share = MAX_UNEXPLAINED_SHARE_OF_LARGE_GAP if after > LARGE_GAP else MAX_UNEXPLAINED_SHARE
    return after > gap_limit(checked_rows) and after - 1.0 > share * (before - 1.0)


def gap_limit(rows: int) -> float:
    """Reduced chi-square of this number of held-out residuals up to which noise explains them."""
    return max(LEAST_GAP_LIMIT, 1.0 + GAP_LIMIT_SD * math.sqrt(2.0 / max(rows, 1)))


def temperature(misfit: float) -> float:
    """T = 1 / zeta where the squared residuals of the present model add up to this misfit."""
    return 1.0 + misfit / COARSENING


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
        By name, the parameters that each recording after the first has for itself: that their values agree is a
        coincidence, which no error of a formula makes more likely.

    Returns
    -------
    dict
        Probabilities; what they lack to one is the probability that nothing more is missing.
    """
    tempered = [
        fall / divisor - sum(one.surcharge(divisor) for one in own.get(name, ())) for name, fall in falls.items()
    ]
    chances = softmax(np.array([*tempered, TEMPERED_FALL_OF_NONE]) / 2.0).tolist()[:-1]
    return dict(sorted(zip(falls, chances, strict=True), key=lambda item: -item[1]))


def soil_error_share(name: str) -> float:
    """Share of the change of the soil's parameters by an effect of this name that counts as a standard deviation."""
    return SOIL_ERROR_SHARE_OF.get(name, SOIL_ERROR_SHARE)


def mean_soil_error_share(chances: Mapping[str, float]) -> float:
    """Root mean square of the shares of these names, weighted by their probabilities."""
    return math.sqrt(sum(p * soil_error_share(name) ** 2 for name, p in chances.items()) / sum(chances.values()))
