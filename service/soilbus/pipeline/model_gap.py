"""Gap between model and data: reduced chi-square of each channel over minutes.

    chi2(channel) = sum over its rows of r (M r) / number of rows   r: residual, M: inverse covariance of the instant
    gap           chi2 > max(1.15, 1 + 5 sqrt(2 overlap / rows))         overlap = window / hop

r (M r) has mean 1 where model and noise are right, so chi-square can be split by channel.  One window that does not fit
means little; a channel that does not fit for minutes means a missing effect.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from soilbus.estimation.observation_model import Linearisation

SPAN = 120.0
"""Time [s] over which chi-square is averaged."""
LEAST_SPAN = 60.0
"""Time [s] of windows below which no gap is reported."""
LIMIT = 1.15
"""Reduced chi-square of a channel from which a gap is reported."""
DEVIATIONS = 5.0
"""Standard deviations by which the reduced chi-square must exceed 1 as well."""


class Square(NamedTuple):
    """Sum of a channel's squared normalised residuals, and their number."""

    total: float
    rows: int


def squares(at: Linearisation, n_wheels: int) -> dict[str, Square]:
    """Squares of torque, draft and, where measured, sinkage in one fitted window, as far as they are finite.

    Parameters
    ----------
    at
        Linearisation of the window at its optimum.
    n_wheels
        Number of wheels, whose torques are the first residuals of an instant.
    """
    per_instant = at.by_latents.shape[1]
    square = (at.rows[:, 0] * at.weighed[:, 0]).reshape(-1, per_instant)
    known = at.weighed.any(axis=1).reshape(-1, per_instant)
    parts = {"torque": slice(n_wheels), "draft": slice(n_wheels, n_wheels + 1), "sinkage": slice(n_wheels + 1, None)}
    found = {name: Square(float(square[:, part].sum()), int(np.sum(known[:, part]))) for name, part in parts.items()}
    return {name: of for name, of in found.items() if of.rows and math.isfinite(of.total)}


class GapWatch:
    """Chi-square of each channel over the last SPAN of overlapping windows (window and hop in s)."""

    def __init__(self, window: float, hop: float) -> None:
        self._overlap = window / hop
        self._seen: deque[tuple[float, Mapping[str, Square]]] = deque()
        self._sums: dict[str, Square] = {}

    def forget(self) -> None:
        """Begin afresh."""
        self._seen.clear()
        self._sums = {}

    def take(self, end: float, found: Mapping[str, Square]) -> None:
        """Add one window that ended at `end` [s]."""
        self._seen.append((end, found))
        self._add(found, 1)
        while self._seen[0][0] < end - SPAN:
            self._add(self._seen.popleft()[1], -1)

    def _add(self, found: Mapping[str, Square], sign: int) -> None:
        """Add the squares of one window to the sums, or take them out again (sign -1)."""
        for channel, square in found.items():
            known = self._sums.get(channel, Square(0.0, 0))
            self._sums[channel] = Square(known.total + sign * square.total, known.rows + sign * square.rows)

    def gaps(self) -> dict[str, float]:
        """Reduced chi-square of the channels that have not fitted for minutes, the worst first."""
        if not self._seen or self._seen[-1][0] - self._seen[0][0] < LEAST_SPAN:
            return {}
        out = {
            channel: known.total / known.rows
            for channel, known in self._sums.items()
            if known.rows
            and known.total / known.rows > max(LIMIT, 1.0 + DEVIATIONS * math.sqrt(2.0 * self._overlap / known.rows))
        }
        return dict(sorted(out.items(), key=lambda item: -item[1]))

    def chi2(self) -> dict[str, float]:
        """Reduced chi-square of every channel, whether it fits or not."""
        return {channel: known.total / known.rows for channel, known in self._sums.items() if known.rows}
