"""Errors, failures, coverage and time of answers; who is better on what, and beyond chance or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest

from soilbus.arrays import Array
from soilbus.estimation.posterior import NORMAL_95
from soilbus.terra.wheel import Soil
from tests.lab.peers.windows import B_REF, Z_REF, Answer

QUANTITIES = ("bearing", "phi", "n", "c", "K")
HIGHEST = {"phi": np.pi / 2.0}
SIGNIFICANT = 0.05
ALIKE = 0.02
"""Relative difference of RMS errors that counts as none."""


def truth(soil: Soil, quantity: str) -> float:
    """The soil's own value of one of QUANTITIES."""
    return soil.bearing_pressure(Z_REF, B_REF) if quantity == "bearing" else float(getattr(soil, quantity))


@dataclass(frozen=True)
class Score:
    """One method's answers on the windows of one soil, and the seconds each took."""

    soil: Soil
    answers: Sequence[Answer | None]
    seconds: Sequence[float]

    @property
    def quantities(self) -> list[str]:
        """What the method estimates, in the table's order."""
        found = {name for answer in self.answers if answer is not None for name in answer}
        return [name for name in QUANTITIES if name in found]

    def errors(self, quantity: str) -> Array:
        """Relative errors (windows,), nan where there is no physical value."""
        value = np.array([a[quantity].value if a is not None and quantity in a else np.nan for a in self.answers])
        physical = np.isfinite(value) & (value > 0.0) & (value < HIGHEST.get(quantity, np.inf))
        return np.where(physical, value / truth(self.soil, quantity) - 1.0, np.nan)

    @property
    def failure_rate(self) -> float:
        """Share of windows without an answer, or with an unphysical value in it (c or K below zero, say)."""
        if not self.quantities:
            return 1.0
        return float(np.mean(np.isnan([self.errors(q) for q in self.quantities]).any(axis=0)))

    def rms(self, quantity: str) -> float:
        """Root mean square of the relative errors, failures left out."""
        return float(np.sqrt(np.nanmean(self.errors(quantity) ** 2)))

    def median(self, quantity: str) -> float:
        """Median of the relative errors' sizes, failures left out."""
        return float(np.nanmedian(np.abs(self.errors(quantity))))

    def coverage(self, quantity: str) -> float:
        """Share of windows whose 95 % interval, log-normal, holds the truth; nan without error bars."""
        estimates = [a[quantity] for a in self.answers if a is not None and quantity in a]
        value, std = np.array([(e.value, e.std) for e in estimates]).T
        if np.isnan(std).all():
            return np.nan
        off = np.abs(np.log(value / truth(self.soil, quantity)))
        return float(np.mean(off <= NORMAL_95 * std / value + 1e-12))

    @property
    def milliseconds(self) -> float:
        """Median time for one window."""
        return 1e3 * float(np.median(self.seconds))


@dataclass(frozen=True)
class Duel:
    """A peer's and our RMS error of one quantity on the windows where both have a value; p of a sign test."""

    peer: float
    ours: float
    p: float

    @property
    def better(self) -> str:
        """ "peer" or "ours", whichever has the smaller RMS error; "neither" if they are all but the same."""
        if abs(self.peer - self.ours) <= ALIKE * max(self.peer, self.ours):
            return "neither"
        return "peer" if self.peer < self.ours else "ours"

    @property
    def by_chance(self) -> bool:
        """Whether the windows, one by one, leave open which is better."""
        return self.p >= SIGNIFICANT


def duel(peer: Score, ours: Score, quantity: str) -> Duel | None:
    """Window against window; None where no window has both values."""
    pairs = np.abs([peer.errors(quantity), ours.errors(quantity)])
    theirs, mine = pairs[:, np.isfinite(pairs).all(axis=0)]
    if not len(theirs):
        return None
    better, worse = int(np.sum(theirs < mine)), int(np.sum(theirs > mine))
    p = float(binomtest(better, better + worse).pvalue) if better + worse else 1.0
    return Duel(float(np.sqrt(np.mean(theirs**2))), float(np.sqrt(np.mean(mine**2))), p)
