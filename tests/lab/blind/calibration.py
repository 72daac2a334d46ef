"""How often a name is right, by the probability stated for it.

    stated   mean probability of the names in a bin
    right    share of them that are hidden in their case, with the 95 % interval of a binomial share (Clopper-Pearson)

Names are those of all sets of blind cases, pairs and recordings of what the catalogue lacks included; those beside a
verdict `unknown` are left out, as the diagnosis itself says that they do not explain the data.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest

from tests.lab.blind.trial import Trial

BINS = (0.0, 0.1, 0.3, 0.6, 0.8, 0.95, 1.0)
"""Edges of the bins; the last two begin where a name stands alone, and where it is sure at the usual level."""


class Bin(NamedTuple):
    """Names of like probability: how many, their mean probability, how many are right, interval of that share."""

    names: int
    stated: float
    right: int
    low: float
    high: float


def stated(trials: Iterable[Trial]) -> Iterator[tuple[float, bool]]:
    """Each name's probability, and whether it is hidden in its case."""
    for trial in trials:
        if trial.verdict != "unknown":
            for names in trial.sets:
                yield from ((probability, name in trial.hidden) for name, probability in names.items())


def curve(names: Iterable[tuple[float, bool]]) -> list[Bin]:
    """The calibration curve of names with their probabilities; bins without a name are left out."""
    known, found = list(names), []
    for low, high in itertools.pairwise(BINS):
        members = [(p, right) for p, right in known if low < p <= high]
        if members:
            right = sum(right for _, right in members)
            interval = binomtest(right, len(members)).proportion_ci(0.95, "exact")
            mean = float(np.mean([p for p, _ in members]))
            found.append(Bin(len(members), mean, right, float(interval.low), float(interval.high)))
    return found


def draw(bins: Sequence[Bin], path: str) -> None:
    """The curve beside the diagonal as a picture, the same bytes for the same bins."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    share = np.array([b.right / b.names for b in bins])
    error = np.array([(s - b.low, b.high - s) for s, b in zip(share, bins, strict=True)]).T
    with mpl.rc_context({"svg.hashsalt": "calibration", "font.size": 9}):
        figure = Figure(figsize=(4.2, 4.0), layout="constrained")
        axes = figure.add_subplot(xlabel="stated probability of a name", ylabel="share of these names that are right")
        axes.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linewidth=1.0)
        axes.errorbar([b.stated for b in bins], share, np.maximum(error, 0.0), fmt="o", capsize=3)
        for b, s in zip(bins, share.tolist(), strict=True):
            axes.annotate(f"{b.names}", (b.stated, s), (6, -10), textcoords="offset points", fontsize=8)
        axes.set(xlim=(-0.02, 1.05), ylim=(-0.02, 1.05), aspect="equal")
        figure.savefig(path, format="svg", metadata={"Date": None})
