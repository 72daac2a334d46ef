"""Series of a window's bins: sums, changes, and what lasts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def running_sum(values: NDArray[Any], n: int) -> Array:
    """Sums of each n neighbours of (N,), (N - n + 1,); none where there are fewer."""
    return np.convolve(values, np.ones(n), "valid") if len(values) >= n else np.zeros(0)


def change(values: Array, lag: int) -> Array:
    """Changes (N - lag,) over so many bins of values (N,), in their unit."""
    return values[lag:] - values[:-lag]


def change_variance(variance: Array, lag: int) -> Array:
    """Variances (N - lag,) of such changes, where those of the values (N,) are independent."""
    return variance[lag:] + variance[:-lag]


def smooth(values: Array) -> Array:
    """Means (N,) of each three neighbours."""
    wide = np.concatenate([values[:1], values, values[-1:]])
    return np.asarray((wide[:-2] + wide[1:-1] + wide[2:]) / 3.0)


def moving_sum(values: Array, lag: int) -> Array:
    """Sums (N - lag,) from each bin's middle to that of the one `lag` later."""
    return running_sum((values[1:] + values[:-1]) / 2.0, lag)


def neighbours(values: Array, n: int) -> Array:
    """Each n neighbours of (N,), (N - n + 1, n).

    Not numpy's view of them: each call leaves a used place in Python's table of strings, which after hours doubles.
    """
    return np.asarray(values[np.arange(len(values) - n + 1)[:, None] + np.arange(n)])


def median(values: Array) -> float:
    """Median of what is known; nan of nothing."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def lasts(holds: Mask, bins: int) -> bool:
    """Whether something holds in so many bins in a row."""
    if np.count_nonzero(holds) < bins:
        return False
    return any(last - first >= bins for first, last in runs(holds))


def runs(holds: Mask) -> list[tuple[int, int]]:
    """First index of each run of True, and the index after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
