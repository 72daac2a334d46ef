"""The ticks of the ten-hertz frames fall into step with the windows."""

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from soilbus.daemon.tick_phase import next_tick

CYCLE = 0.1
"""Cycle [s] of the frames that others act on."""
JITTER = 0.006
"""By so much [s] a cycle may be longer or shorter: 6 %, less than receivers' timeouts notice."""
SECOND = 10
"""Ticks of a second."""


@given(st.floats(0.0, 1e5), st.floats(0.0, 10.0), st.integers(1, 30).map(lambda n: n * CYCLE))
def test_after_a_second_a_tick_falls_just_before_each_window_end(first, ahead, hop):
    ticks, end = [first], first + ahead
    for _ in range(240):
        while end < ticks[-1]:
            end += hop
        ticks.append(next_tick(ticks[-1], end))
    gaps = [later - tick for tick, later in itertools.pairwise(ticks)]
    assert min(gaps) >= CYCLE - JITTER
    assert max(gaps) <= CYCLE + JITTER
    assert gaps[SECOND:] == pytest.approx([CYCLE] * (len(gaps) - SECOND), abs=1e-9)
    assert 0.005 < math.remainder(end - ticks[-1], CYCLE) < 0.02  # time to decode, and little left to come


@given(st.floats(0.0, 1e5), st.sampled_from([math.inf, -math.inf, math.nan]))
def test_without_a_window_it_goes_on(tick, end):
    assert next_tick(tick, end) == pytest.approx(tick + CYCLE)
