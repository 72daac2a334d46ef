"""How well the model describes a drive: chi-square of each channel, and errors of its predictions.

    chi2(channel)  = sum over its rows of r (M r) / number of rows   r: residual, M: inverse covariance of the instant
    share(channel) = sqrt(sum of squares of errors / sum of squares of sizes)                (`estimation.prediction`)

Chi-square is in units of what the recording's own scatter says of each sensor, so that a machine that shakes has 1.  A
gap is a channel that the model has predicted badly for minutes: a sign of a missing effect.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from statistics import median
from typing import NamedTuple

import numpy as np

from soilbus.estimation.linearisation import Linearisation
from soilbus.estimation.prediction import Share

SPAN = 120.0
"""Time [s] over which chi-square and gaps are averaged."""
LEAST_SPAN = 60.0
"""Time [s] of windows below which no gap is reported."""


class Square(NamedTuple):
    """Sum of a channel's squared normalised residuals, and their number."""

    total: float
    rows: int


def squares(at: Linearisation, n_wheels: int) -> dict[str, Square]:
    """Return the squares of torque, draft and, where measured, sinkage in one fitted window, as far as finite.

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


class Sums:
    """Sums by channel of what was taken in the last `span` seconds."""

    def __init__(self, span: float) -> None:
        self.span = span
        self._seen: deque[tuple[float, Mapping[str, tuple[float, float]]]] = deque()

    def take(self, end: float, found: Mapping[str, tuple[float, float]]) -> None:
        """Add what ended at `end` [s]."""
        self._seen.append((end, found))
        while self._seen[0][0] <= end - self.span:
            self._seen.popleft()

    @property
    def length(self) -> float:
        """Time [s] from the first to the last that is kept."""
        return self._seen[-1][0] - self._seen[0][0] if self._seen else 0.0

    def ratios(self) -> dict[str, float]:
        """Return the ratio of the two sums of each channel."""
        sums: dict[str, list[float]] = {}
        for _, found in self._seen:
            for channel, pair in found.items():
                total = sums.setdefault(channel, [0.0, 0.0])
                total[0], total[1] = total[0] + pair[0], total[1] + pair[1]
        return {channel: one / other for channel, (one, other) in sums.items() if other > 0.0}

    def medians(self) -> dict[str, float]:
        """Return the square root of the median ratio of each channel."""
        ratios: dict[str, list[float]] = {}
        for _, found in self._seen:
            for channel, (one, other) in found.items():
                if other > 0.0:
                    ratios.setdefault(channel, []).append(one / other)
        return {channel: math.sqrt(median(values)) for channel, values in ratios.items()}


class PredictionWatch:
    """Errors of predictions over the last window [s], and over minutes."""

    def __init__(self, window: float) -> None:
        self._window, self._minutes = Sums(window), Sums(SPAN)

    def take(self, end: float, found: Mapping[str, Share]) -> None:
        """Add the newest data of a window that ended at `end` [s]."""
        for sums in (self._window, self._minutes):
            sums.take(end, found)

    def shares(self) -> dict[str, float]:
        """Return the error of each channel over its size, of the last window."""
        return {channel: math.sqrt(ratio) for channel, ratio in self._window.ratios().items()}

    def error(self) -> float:
        """Return the largest of the channels' usual shares; 0 before anything was predicted.

        The median over hops: a moment that is spoilt, or on another soil, is no fault of the model.
        """
        return max(self._window.medians().values(), default=0.0)

    def gaps(self, limit: float) -> dict[str, float]:
        """Return the channels whose share has been above the limit for minutes, the worst first."""
        if self._minutes.length < LEAST_SPAN:
            return {}
        found = {channel: math.sqrt(ratio) for channel, ratio in self._minutes.ratios().items()}
        return {c: share for c, share in sorted(found.items(), key=lambda item: -item[1]) if share > limit}
