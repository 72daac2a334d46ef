"""From fixes to positions: noise, gaps, the antimeridian, receivers without a fix."""

import math

import numpy as np
import pytest

from soilbus.pipeline.positions import PositionTrack

TIMEOUT = {"latitude": 2.0, "longitude": 2.0}


def track(t, latitude, longitude, timeout=TIMEOUT) -> PositionTrack:
    out = PositionTrack(timeout)
    out.add({"latitude": (np.asarray(t), np.radians(latitude)), "longitude": (np.asarray(t), np.radians(longitude))})
    return out


def degrees(position) -> tuple[float, float]:
    return math.degrees(position.latitude), math.degrees(position.longitude)


def test_between_two_fixes_of_a_slow_receiver():
    slow = track([0.0, 5.0, 10.0], [50.0, 50.0005, 50.002], [8.0, 8.0, 8.001], {"latitude": 7.5, "longitude": 7.5})
    assert degrees(slow.at(6.0)) == (pytest.approx(50.0008), pytest.approx(8.0002))
    assert degrees(slow.at(4.999)) == (pytest.approx(50.0005, abs=1e-6), pytest.approx(8.0))


def test_noise_of_the_fixes_is_averaged_without_lagging_behind():
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 400.0, 0.1)
    noise = 1e-5 * rng.standard_normal((2, len(t)))
    noisy = track(t, 50.0 + 1e-5 * t + noise[0], 8.0 - 2e-5 * t + noise[1])
    asked = np.arange(5.05, 395.0, 2.1)
    found = np.array([degrees(noisy.at(s)) for s in asked])
    error = found - np.column_stack([50.0 + 1e-5 * asked, 8.0 - 2e-5 * asked])
    assert error.std(0) == pytest.approx(1e-5 / math.sqrt(20.0), rel=0.2)
    assert np.abs(error.mean(0)).max() < 4.0 * 1e-5 / math.sqrt(20.0 * len(asked))


def test_no_position_in_a_gap_or_outside_the_fixes():
    t = [0.0, 1.0, 2.0, 4.5, 5.5]
    gap = track(t, 50.0 + 1e-4 * np.array(t), np.full(5, 8.0))
    assert gap.at(1.5) is not None
    assert gap.at(2.5) is None
    assert gap.at(4.4) is None
    assert degrees(gap.at(5.0))[0] == pytest.approx(50.0005)
    assert gap.at(-0.1) is None
    assert gap.at(5.6) is None
    assert PositionTrack(TIMEOUT).at(0.0) is None
    assert PositionTrack({}).at(0.0) is None


def test_fixes_beyond_a_gap_have_no_say():
    t = [0.0, 0.1, 0.2, 0.9, 1.0, 1.1]
    jump = track(t, [50.0, 50.0, 50.0, 51.0, 51.0, 51.0], [8.0] * 6, {"latitude": 0.3, "longitude": 0.3})
    assert degrees(jump.at(0.15))[0] == pytest.approx(50.0, abs=1e-9)
    assert degrees(jump.at(1.05))[0] == pytest.approx(51.0, abs=1e-9)


def test_across_the_antimeridian():
    t = np.arange(0.0, 4.0, 0.1)
    east = 179.9999 + 1e-4 * t
    across = track(t, np.full(len(t), -17.0), (east + 180.0) % 360.0 - 180.0)
    for asked in (0.55, 1.0, 1.05, 3.0):
        latitude, longitude = degrees(across.at(asked))
        assert latitude == pytest.approx(-17.0)
        assert (longitude - 179.9999 - 1e-4 * asked + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-9)
        assert abs(longitude) <= 180.0


def test_zero_and_zero_is_no_fix():
    t = np.arange(0.0, 3.0, 0.1)
    searching = track(t, np.where(t < 1.0, 0.0, 50.0), np.where(t < 1.0, 0.0, 8.0))
    assert searching.at(0.5) is None
    assert degrees(searching.at(1.5)) == (pytest.approx(50.0), pytest.approx(8.0))


def test_latitude_and_longitude_in_frames_of_their_own():
    apart = PositionTrack(TIMEOUT)
    apart.add(
        {"latitude": (np.array([0.0, 1.0, 2.0]), np.radians([50.0, 50.001, 50.002])), "draft": (t := np.zeros(1), t)}
    )
    assert apart.at(1.2) is None
    apart.add({"longitude": (np.array([0.3, 1.3, 2.3]), np.radians([8.0, 8.001, 8.002]))})
    assert degrees(apart.at(1.5)) == (pytest.approx(50.0015), pytest.approx(8.0012))


def test_what_is_dropped_and_what_comes_later_does_not_change_a_position():
    t = np.arange(0.0, 60.0, 0.1)
    latitude, longitude = 50.0 + 1e-5 * t + 1e-6 * np.sin(t), 8.0 + 1e-5 * t
    whole = track(t, latitude, longitude)
    parts, positions = PositionTrack(TIMEOUT), []
    for i in range(0, len(t), 10):
        part = slice(i, i + 10)
        parts.add(
            {"latitude": (t[part], np.radians(latitude[part])), "longitude": (t[part], np.radians(longitude[part]))}
        )
        if i >= 100:
            positions.append((t[i] - 4.9, parts.copy()))
            parts.drop_before(t[i] - 4.9 + 1.0)
    assert [kept.at(s) for s, kept in positions] == [whole.at(s) for s, _ in positions]
    parts.forget()
    assert parts.at(50.0) is None
