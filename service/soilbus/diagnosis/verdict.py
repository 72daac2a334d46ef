"""From evidences to a verdict: none, named, ambiguous or unknown, with probabilities.

The constants were set looking at the blind cases of seeds 1 and 2 and the `tune` half of seed 3
(`python -m tests.diagnosis.blind`), UNEXPLAINED_FAR at the `tune` halves of seeds 107 to 111; what is
reported are `report` halves of seeds from 3 on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from types import MappingProxyType

import numpy as np
from scipy.special import expit, softmax

from soilbus.diagnosis.evidence import OwnParameters


class Verdict(StrEnum):
    """What the diagnosis comes to."""

    NONE = "none"
    NAMED = "named"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


PAYS, PAYS_BESIDE = 12.0, 30.0
"""Fall of -2 log evidence from which an effect is added, alone and beside others: they leave more than noise."""
TEMPERATURE = 6.0
"""By how much evidences are less certain than they say, where little is to be explained."""
FORM_ERROR, GREAT_FORM_ERROR = 0.001, 0.1
"""By how much less besides, for each unit that is explained: no effect's formula is the field's, and a formula
that is off by a share e of the effect leaves e^2 of what there was to explain.  Usually, and at times."""
GROWN = 1500.0
"""Fall of -2 log evidence from which the greater error grows no more: great effects have been seen to tell apart."""
AT_TIMES = 0.15
"""How often it is the greater one."""
FORM_LEFT = 0.02
"""The same for whether there is a further effect at all: share of what is explained that its formula may leave."""
HOPELESS = 4.0
"""Great temperatures behind the best one from which a name is so improbable that it is not fitted to all instants."""
SURE = 0.8
"""Probability from which a name stands alone."""
PLAUSIBLE = 0.02
"""Probability from which a name belongs to the set."""
ADDS = 0.001
"""Share of what is explained already that a further effect must explain: less than that formulas are off."""
WORTH = 0.25
"""Share of a real gap's excess over noise that an effect must explain to be added."""
UNEXPLAINED, UNEXPLAINED_FAR = 0.35, 0.08
"""Share of it that may be left by effects that are named, none of which has the formula of the field: of a gap that
is left small, and of one that is not."""
FAR_GAP = 1.5
"""Reduced chi-square from which a gap that is left is not small."""
REAL_GAP = 4.0
"""Standard deviations of a reduced chi-square beyond which a gap is real."""
LEAST_GAP = 1.04
"""Reduced chi-square up to which no gap is told, however many residuals: noise is not known better."""


def probabilities(
    falls: Mapping[str, float],
    explained: float,
    further: Mapping[str, Sequence[OwnParameters]] = MappingProxyType({}),
) -> dict[str, float]:
    """Probability of each name from its fall of -2 log evidence, the largest first, where others explain so much.

    further are the parameters that recordings after the first have for themselves under a name: that they come out
    alike is a chance, which no error of a formula makes more likely.  What is left to one is the probability that
    nothing more is missing.
    """
    most = max(falls.values())
    usual, great = (_shares(falls, t, further) for t in temperatures(explained + most))
    something = float(expit(most / (2.0 * temperature(explained, FORM_LEFT))))
    chances = {n: something * ((1.0 - AT_TIMES) * usual[n] + AT_TIMES * great[n]) for n in falls}
    return dict(sorted(chances.items(), key=lambda item: -item[1]))


def out_of_reach(behind: float, explained: float) -> bool:
    """Whether a name so far behind the best one in -2 log evidence cannot get into the set."""
    return behind > out_of_reach_from(explained)


def out_of_reach_from(explained: float) -> float:
    """How far behind that is."""
    return HOPELESS * _great_temperature(explained)


def temperatures(explained: float) -> tuple[float, float]:
    """What differences of -2 log evidence between names are divided by, where so much is explained: usually, at times.

    At times is AT_TIMES.
    """
    return temperature(explained), _great_temperature(explained)


def temperature(explained: float, form_error: float = FORM_ERROR) -> float:
    """What differences of -2 log evidence are divided by, where so much of it is explained in all."""
    return TEMPERATURE + form_error * max(explained, 0.0)


def _great_temperature(explained: float) -> float:
    return temperature(min(explained, GROWN), GREAT_FORM_ERROR)


def _shares(
    falls: Mapping[str, float], temperature: float, further: Mapping[str, Sequence[OwnParameters]]
) -> dict[str, float]:
    tempered = [
        fall / temperature - sum(own.surcharge(temperature) for own in further.get(name, ()))
        for name, fall in falls.items()
    ]
    return dict(zip(falls, softmax(np.array(tempered) / 2.0).tolist(), strict=True))


def gap_limit(rows: int) -> float:
    """Reduced chi-square of so many held-out residuals up to which noise explains them."""
    return max(LEAST_GAP, 1.0 + REAL_GAP * math.sqrt(2.0 / max(rows, 1)))


def price(explained: float, gap: float, checked_rows: int, rows: int) -> float:
    """Fall of -2 log evidence beyond which an effect is worth adding, where others explain so much already.

    gap is the present one, on so many residuals.
    """
    excess = (gap - 1.0) * rows if gap > gap_limit(checked_rows) else 0.0
    return max(least_that_pays(explained), WORTH * excess)


def least_that_pays(explained: float) -> float:
    """The least that it ever is."""
    return max(PAYS_BESIDE if explained > 0.0 else PAYS, ADDS * explained)


def verdict_of(before: float, after: float, rows: int, chances: Sequence[float], imitation: bool = False) -> Verdict:
    """The verdict from the gaps before and after on so many residuals, and the probability of each effect added.

    imitation: whether the effects explain what they do only together, see `diagnose`.
    """
    if is_real(before, after, rows):
        return Verdict.UNKNOWN
    if not chances:
        return Verdict.NONE
    return Verdict.NAMED if min(chances) >= SURE and not imitation else Verdict.AMBIGUOUS


def is_real(before: float, after: float, checked_rows: int) -> bool:
    """Whether a gap is left that the effects added do not explain."""
    share = UNEXPLAINED_FAR if after > FAR_GAP else UNEXPLAINED
    return after > gap_limit(checked_rows) and after - 1.0 > share * (before - 1.0)
