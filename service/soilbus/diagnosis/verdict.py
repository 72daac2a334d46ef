"""From block scores to a verdict: none, named, ambiguous or unknown, with probabilities.

    d_b(e)  = s_b without - s_b with effect e                                    of each block b (`blocks`)
    P(name) = mean over weights w of  exp(D_e / 2) / (K + sum over names of exp(D / 2)),    D = B sum of w_b d_b
    w       ~ Dirichlet(1, ..., 1) over the B blocks;  K: effects of the catalogue

The score of a model is what it predicts of blocks that it was not fitted to, and its difference from that of another
is known as well as blocks agree on it: weights drawn over the blocks (Bayesian bootstrap: Rubin 1981, Ann. Statist.
9:130) give the probability that the one predicts better on this ground with this driver (pseudo-BMA+: Yao, Vehtari,
Simpson & Gelman 2018, Bayesian Anal. 13:917).  A priori nothing is missing with probability 1/2, and every effect with
1 / 2 K.  An effect is added where it is more probable than none, and explains more than the formulas of the others may
leave; the verdict is `unknown` where too much of the gap remains.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum

import numpy as np
from scipy.special import softmax

from soilbus.arrays import Array
from soilbus.diagnosis.options import DEFAULT, DiagnosisOptions
from soilbus.terra.effects.catalogue import CATALOGUE

FALL_OF_NONE = 2.0 * math.log(len(CATALOGUE))
"""Fall of the score from which an effect is more probable than none, where all blocks agree on it."""
DRAWS = 1000
"""Of the weights of blocks: a probability of 1/2 is then known to 0.016."""


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
        Gaps (reduced chi-square) under the present model and with the effects added.
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


def probabilities(falls: Mapping[str, Array]) -> dict[str, float]:
    """Probability of each candidate's name, the largest first.

    Parameters
    ----------
    falls
        Fall of the score of each block (B,) by name.

    Returns
    -------
    dict
        Probabilities; what they lack to one is the probability that nothing more is missing.
    """
    if not falls:
        return {}
    of_blocks = np.array(list(falls.values()))
    B = of_blocks.shape[1]
    weights = np.random.default_rng(B).dirichlet(np.ones(B), DRAWS) * B
    drawn = np.column_stack([weights @ of_blocks.T, np.full(DRAWS, FALL_OF_NONE)])
    chances = softmax(drawn / 2.0, axis=1).mean(0)[:-1].tolist()
    return dict(sorted(zip(falls, chances, strict=True), key=lambda item: -item[1]))


def least_fall(probability: float) -> float:
    """Return the fall of the score from which an effect has this probability beside none, where all blocks agree."""
    return FALL_OF_NONE + 2.0 * math.log(probability / (1.0 - probability))


def soil_error_share(name: str, options: DiagnosisOptions = DEFAULT) -> float:
    """Share of the change of the soil's parameters by an effect of this name that counts as a standard deviation."""
    return options.tyre_soil_error_share if name == "tyre_deflection" else options.soil_error_share


def mean_soil_error_share(chances: Mapping[str, float], options: DiagnosisOptions = DEFAULT) -> float:
    """Root mean square of the shares of these names, weighted by their probabilities."""
    square = sum(p * soil_error_share(name, options) ** 2 for name, p in chances.items())
    return math.sqrt(square / sum(chances.values()))
