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
    """Squares of torque, draft and, where measured, sinkage in one fitted window.

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
    return {name: of_channel for name, of_channel in found.items() if of_channel.rows}


class GapWatch:
    """Chi-square of each channel over the last SPAN of overlapping windows (window and hop in s)."""

    def __init__(self, window: float, hop: float) -> None:
        self._overlap = window / hop
        self._seen: deque[tuple[float, Mapping[str, Square]]] = deque()
        self._kept: dict[str, Square] = {}

    def forget(self) -> None:
        """Begin afresh."""
        self._seen.clear()
        self._kept = {}

    def take(self, end: float, found: Mapping[str, Square]) -> None:
        """Add one window that ended at `end` [s]."""
        self._seen.append((end, found))
        while self._seen[0][0] < end - SPAN:
            self._seen.popleft()
        self._kept = self._sums()

    def gaps(self) -> dict[str, float]:
        """Reduced chi-square of the channels that have not fitted for minutes, the worst first."""
        if not self._seen or self._seen[-1][0] - self._seen[0][0] < LEAST_SPAN:
            return {}
        out = {
            channel: known.total / known.rows
            for channel, known in self._kept.items()
            if known.total / known.rows > max(LIMIT, 1.0 + DEVIATIONS * math.sqrt(2.0 * self._overlap / known.rows))
        }
        return dict(sorted(out.items(), key=lambda item: -item[1]))

    def chi2(self) -> dict[str, float]:
        """Reduced chi-square of every channel, whether it fits or not."""
        return {channel: known.total / known.rows for channel, known in self._kept.items()}

    def _sums(self) -> dict[str, Square]:
        """Of each channel over the windows kept."""
        of_channel: dict[str, list[Square]] = {}
        for _, found in self._seen:
            for channel, square in found.items():
                of_channel.setdefault(channel, []).append(square)
        return {
            channel: Square(sum(part.total for part in parts), sum(part.rows for part in parts))
            for channel, parts in of_channel.items()
        }
