"""The tracker's states: what follows from what a window shows, without any data."""

from dataclasses import replace

import pytest

from soilbus.estimation.change_detection import ChangeStatistic, Transition
from soilbus.estimation.soil_state import ChangePoint, Reason, Shown, SoilState, TrackerState, next_state

LENGTH = 10.0
SHARP, GRADUAL = Transition(20.0, 20.5, 1.3), Transition(20.0, 24.0, 1.3)
CHANGE = ChangePoint(20.0, 1.5, ChangeStatistic(180, 31.0, 8.0))
QUIET = Shown(None, None, None, mismatch=False)


def after(state: SoilState, shown: Shown, end: float) -> tuple[TrackerState, Reason]:
    following = next_state(state, shown, end, LENGTH)
    return following.name, following.reason


@pytest.mark.parametrize(
    ("shown", "reason"),
    [
        (QUIET, Reason.ONE_SOIL),
        (QUIET._replace(mismatch=True), Reason.MISMATCH),
        (QUIET._replace(change=CHANGE), Reason.UNCONFIRMED),
    ],
)
def test_without_another_soil_it_stays_the_same(shown, reason):
    assert after(SoilState(), shown, 15.0) == (TrackerState.STEADY, reason)


def test_a_change_with_too_few_data_is_suspect_and_remembered():
    shown = QUIET._replace(found=Reason.CHANGE_STATISTIC, change=CHANGE)
    following = next_state(SoilState(), shown, 21.0, LENGTH)
    assert (following.name, following.reason) == (TrackerState.SUSPECT, Reason.CHANGE_STATISTIC)
    assert following.change == CHANGE
    assert following.transition is None


@pytest.mark.parametrize("transition", [SHARP, GRADUAL])
def test_a_border_is_over_as_soon_as_its_soil_fits(transition):
    found = QUIET._replace(found=Reason.TWO_SOILS, transition=transition)
    assert after(SoilState(), found._replace(mismatch=True), 25.0) == (TrackerState.TRANSITION, Reason.UNSETTLED)
    assert after(SoilState(), found, 25.0) == (TrackerState.NEW_SOIL, Reason.TWO_SOILS)


def test_a_border_is_not_over_while_its_soil_does_not_fit_however_late():
    crossing = SoilState(TrackerState.TRANSITION, Reason.UNSETTLED, SHARP, mismatch=True)
    unsettled = QUIET._replace(transition=SHARP, mismatch=True)
    for end in (22.0, 29.0, 45.0):
        assert after(crossing, unsettled, end) == (TrackerState.TRANSITION, Reason.UNSETTLED)
    # A window that fits and has no data before the border ends it.
    fitted = replace(crossing, mismatch=False)
    assert after(fitted, QUIET._replace(transition=SHARP), 45.0) == (TrackerState.STEADY, Reason.ONE_SOIL)


def test_a_new_soil_is_new_for_a_window_and_then_the_same():
    new, shown = SoilState(TrackerState.NEW_SOIL, Reason.TWO_SOILS, SHARP), QUIET._replace(transition=SHARP)
    assert after(new, shown, 30.0) == (TrackerState.NEW_SOIL, Reason.SPANS_BORDER)
    assert after(new, shown, 30.6) == (TrackerState.STEADY, Reason.ONE_SOIL)
