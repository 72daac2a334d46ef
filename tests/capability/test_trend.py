"""What is remembered of a series of values."""

from __future__ import annotations

import math

import numpy as np
import pytest

from soilbus.decision.immobilisation import Peaks


@pytest.mark.parametrize("seed", range(20))
def test_peaks_are_those_of_the_last_seconds(seed):
    """At least of the last `hold` seconds, and of nothing that is older than two of them and a step."""
    rng = np.random.default_rng(seed)
    hold, t, values = 2.0, np.cumsum(rng.uniform(0.02, 0.2, 300)), rng.exponential(1.0, 300)
    peaks = Peaks()
    assert peaks.greatest == -math.inf
    for k in range(len(t)):
        peaks = peaks.joined(float(t[k]), float(values[k]), hold)
        least = values[: k + 1][t[: k + 1] >= t[k] - hold].max()
        most = values[: k + 1][t[: k + 1] >= t[k] - 2.0 * hold - 0.4].max()
        assert least <= peaks.greatest <= most
