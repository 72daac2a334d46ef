"""Hysteresis: worse at once, better slowly, never better than the window itself allows."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from soilbus.config.model import Traversability as Settings
from soilbus.decision.traversability import ORDER, Held, State, Status, settled, state_of

CONFIG = Settings()
SURE_GO, SURE_CAUTION = (norm.cdf(norm.ppf(p) + CONFIG.hysteresis) for p in (CONFIG.go, CONFIG.no_go))
GO, CAUTION, NO_GO, UNKNOWN = State.GO, State.CAUTION, State.NO_GO, State.UNKNOWN


def states(*windows, config=CONFIG):
    """States in force after windows of (probability, status) or probabilities of valid ones."""
    held, found = Held(), []
    for window in windows:
        p, status = window if isinstance(window, tuple) else (window, Status.VALID)
        held = settled(held, p, status, config)
        found.append(held.state)
    return found


def test_the_first_window_decides_alone_and_a_worse_one_at_once():
    assert states(0.96, 0.94, 0.49) == [GO, CAUTION, NO_GO]
    assert states(0.4) == [NO_GO]
    assert states(0.96, 0.1) == [GO, NO_GO]
    assert states(0.99, (0.99, Status.DEGRADED)) == [GO, CAUTION]


def test_a_better_state_needs_two_windows_well_above_its_threshold():
    above = SURE_GO + 1e-6
    assert states(0.9, above, above) == [CAUTION, CAUTION, GO]
    assert states(0.9, *[SURE_GO - 1e-6] * 9) == [CAUTION] * 10
    assert states(0.9, above, 0.95, above, above) == [CAUTION] * 4 + [GO]
    assert states(0.4, SURE_CAUTION + 1e-6, 0.99, 0.99) == [NO_GO, NO_GO, CAUTION, GO]
    assert states(0.4, 0.99, 0.99) == [NO_GO, NO_GO, GO]
    assert states(0.4, 0.55, 0.55, 0.55) == [NO_GO] * 4


def test_unknown_comes_at_once_and_forgets():
    assert states(0.4, None, 0.96) == [NO_GO, UNKNOWN, GO]
    assert states(0.99, None) == [GO, UNKNOWN]
    assert states(0.4, 0.99, None, 0.4, 0.99) == [NO_GO, NO_GO, UNKNOWN, NO_GO, NO_GO]


def test_without_hysteresis_and_hold_the_window_decides():
    plain = Settings(hysteresis=0.0, hold=1)
    p = [0.1, 0.6, 0.97, 0.5, 0.96, 0.95]
    assert states(*p, config=plain) == [state_of(x, Status.VALID, plain) for x in p]


WINDOWS = st.lists(st.tuples(st.none() | st.floats(0.0, 1.0), st.sampled_from(Status)), max_size=30)


@given(windows=WINDOWS, hold=st.integers(1, 4), hysteresis=st.floats(0.0, 3.0))
def test_never_better_than_the_window_allows(windows, hold, hysteresis):
    config = Settings(hold=hold, hysteresis=hysteresis)
    found = states(*windows, config=config)
    last, allowed = UNKNOWN, []
    for (p, status), state in zip(windows, found, strict=True):
        if p is None:
            assert state is UNKNOWN
            allowed = []
        else:
            now = ORDER.index(state_of(p, status, config))
            allowed.append(now)
            assert ORDER.index(state) <= now
            if last is not UNKNOWN:
                before = ORDER.index(last)
                assert now > before or ORDER.index(state) == now
                assert now < before or ORDER.index(state) >= before
                if ORDER.index(state) > before:
                    assert len(allowed) >= hold
                    assert min(allowed[-hold:]) >= ORDER.index(state)
        last = state


@pytest.mark.parametrize("wrong", [{"hold": 0}, {"hysteresis": -0.1}])
def test_wrong_settings(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Settings(**wrong)
