"""The ticks of the ten-hertz frames fall into step with the windows."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from soilbus.daemon.tick_phase import LEAD_BEFORE_WINDOW_END, MAX_PERIOD_CHANGE, next_tick
from soilbus.pipeline.outputs import TICK

MOST = math.ceil(TICK / 2 / MAX_PERIOD_CHANGE)


@given(st.floats(0.0, 1e5), st.floats(0.0, 10.0), st.integers(1, 30).map(lambda n: n * TICK))
def test_after_a_second_a_tick_falls_just_before_each_window_end(first, ahead, hop):
    ticks, end = [first], first + ahead
    for _ in range(4 * MOST + 200):
        while end - LEAD_BEFORE_WINDOW_END < ticks[-1] - 1e-9:
            end += hop
        ticks.append(next_tick(ticks[-1], end))
    gaps = [later - tick for tick, later in itertools.pairwise(ticks)]
    assert min(gaps) >= TICK - MAX_PERIOD_CHANGE - 1e-9
    assert max(gaps) <= TICK + MAX_PERIOD_CHANGE + 1e-9
    assert gaps[MOST:] == pytest.approx([TICK] * (len(gaps) - MOST), abs=1e-9)
    assert math.remainder(end - LEAD_BEFORE_WINDOW_END - ticks[-1], TICK) == pytest.approx(0.0, abs=1e-9)


@given(st.floats(0.0, 1e5), st.sampled_from([math.inf, -math.inf, math.nan]))
def test_without_a_window_it_goes_on(tick, end):
    assert next_tick(tick, end) == tick + TICK
