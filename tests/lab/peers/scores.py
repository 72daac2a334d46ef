"""Errors, failures, coverage and time of answers; who is closer on what, beyond chance."""

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
    """One method's answers on windows, the true soil of each, and the seconds each took."""

    soils: Sequence[Soil]
    answers: Sequence[Answer | None]
    seconds: Sequence[float]

    @property
    def quantities(self) -> list[str]:
        """What the method estimates, in the table's order."""
        found = {name for _, answer in self._answered for name in answer}
        return [name for name in QUANTITIES if name in found]

    def errors(self, quantity: str) -> Array:
        """Relative errors (windows,), nan where there is no physical value."""
        value = np.array([a[quantity].value if a is not None and quantity in a else np.nan for a in self.answers])
        true = np.array([truth(soil, quantity) for soil in self.soils])
        physical = np.isfinite(value) & (value > 0.0) & (value < HIGHEST.get(quantity, np.inf))
        return np.where(physical, value / true - 1.0, np.nan)

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
        found = [(truth(soil, quantity), a[quantity]) for soil, a in self._answered if quantity in a]
        true, value, std = np.array([(true, e.value, e.std) for true, e in found]).T
        if np.isnan(std).all():
            return np.nan
        return float(np.mean(np.abs(np.log(value / true)) <= NORMAL_95 * std / value + 1e-12))

    @property
    def _answered(self) -> list[tuple[Soil, Answer]]:
        return [(soil, answer) for soil, answer in zip(self.soils, self.answers, strict=True) if answer is not None]

    @property
    def milliseconds(self) -> float:
        """Median time for one window."""
        return 1e3 * float(np.median(self.seconds))


@dataclass(frozen=True)
class Duel:
    """A peer's and our RMS error of one quantity on windows where both have a value, and who is closer in how many.

    `closer_in` counts the windows in which the peer is closer, of `windows` in which one is: a missing value is not.
    """

    peer: float
    ours: float
    closer_in: int
    windows: int

    @property
    def closer(self) -> str:
        """ "ours", "peer", "alike" (by RMS error), or "open" where a sign test of the windows does not confirm it."""
        if abs(self.peer - self.ours) <= ALIKE * max(self.peer, self.ours):
            return "alike"
        peer = self.peer < self.ours
        in_most = 2 * self.closer_in > self.windows
        if peer != in_most or binomtest(self.closer_in, self.windows).pvalue >= SIGNIFICANT:
            return "open"
        return "peer" if peer else "ours"


def duel(peer: Score, ours: Score, quantity: str) -> Duel | None:
    """Window against window; None where no window has both values."""
    pairs = np.abs([peer.errors(quantity), ours.errors(quantity)])
    both = np.isfinite(pairs).all(axis=0)
    if not both.any():
        return None
    peer_rms, our_rms = np.sqrt(np.mean(pairs[:, both] ** 2, axis=1)).tolist()
    theirs, mine = np.nan_to_num(pairs, nan=np.inf)
    return Duel(peer_rms, our_rms, int(np.sum(theirs < mine)), int(np.sum(theirs != mine)))
