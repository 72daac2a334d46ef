"""Immobilisation ahead, without a soil: the trend's filter against least squares, and what it must not warn of."""

import math

import numpy as np
import pytest

from soilbus.config.model import Traversability, Warning
from soilbus.decision.moments import Sample
from soilbus.decision.stall import LocalTrend, Stall, stalling

LOOK = 0.1


def warnings(samples: list[Sample], min_speed: float = 0.2) -> list[float]:
    """When warnings begin [s]."""
    state, begun = Stall(), []
    for sample in samples:
        later = stalling(state, sample, min_speed, Warning(), Traversability())
        if later.ahead and not state.ahead:
            begun.append(sample.t)
        state = later
    return begun


def test_the_filter_is_the_least_squares_line_where_the_rate_does_not_wander():
    rng = np.random.default_rng(4)
    t = 0.1 * np.arange(30)
    value = 2.0 - 0.7 * t + 0.05 * rng.standard_normal(30)
    trend = LocalTrend()
    for i, z in enumerate(value.tolist()):
        trend = trend.after(0.1 if i else 0.0, z, 0.05**2, 0.0)
    rows = np.column_stack([np.ones(30), t - t[-1]]) / 0.05
    prior = np.array([[0.0, 1.0]])  # the rate's prior, sd 1
    design, target = np.vstack([rows, prior]), np.append(value / 0.05, 0.0)
    covariance = np.linalg.inv(design.T @ design)
    level, rate = covariance @ design.T @ target
    assert (trend.value, trend.rate) == pytest.approx((level, rate), rel=1e-9)
    assert (trend.var, trend.cov, trend.rate_var) == pytest.approx(
        (covariance[0, 0], covariance[0, 1], covariance[1, 1]), rel=1e-9
    )


def test_a_sample_that_is_not_known_widens_the_trend_and_moves_nothing():
    trend = LocalTrend().after(0.0, 1.0, 0.01, 0.3).after(0.1, 1.1, 0.01, 0.3)
    later = trend.after(0.1, math.nan, math.nan, 0.3)
    assert later.value == pytest.approx(trend.value + 0.1 * trend.rate)
    assert later.var > trend.var


@pytest.mark.parametrize("rate", [0.0, 0.015, 0.04])
def test_wheels_that_sink_to_their_limit_are_warned_of_while_the_vehicle_loses_little_speed(rate):
    rng = np.random.default_rng(5)
    limit, t = Traversability().max_sinkage, np.arange(0.0, 25.0, LOOK)
    depth = np.minimum(0.05 + rate * np.maximum(t - 5.0, 0.0), limit + 0.05) if rate else np.full(len(t), limit - 0.06)
    samples = [
        Sample(
            now, 1.4 - 0.01 * now, 0.02**2, 1.6, 0.01**2, 0.3, depth=z + 0.01 * rng.standard_normal(), depth_var=0.01**2
        )
        for now, z in zip(t.tolist(), depth.tolist(), strict=True)
    ]
    begun = warnings(samples)
    if not rate:
        assert begun == []
        return
    passes = 5.0 + (limit - 0.05) / rate
    assert passes - 3.0 < begun[0] < passes


def test_a_specific_force_shows_the_slope_within_two_seconds_and_no_acceleration_in_its_place():
    rng, state, V, found = np.random.default_rng(5), Stall(), 1.0, []
    for i in range(400):
        t = LOOK * i
        slope = 0.0 if t < 20.0 else 1.0
        rate = 0.4 * math.sin(0.8 * t)
        V += rate * LOOK
        sample = Sample(t, V + 0.01 * rng.standard_normal(), 1e-4, V, 1e-4, 0.2, felt=rate + slope)
        state = stalling(state, sample, 0.2, Warning(), Traversability())
        found.append(state.slope)
    assert max(abs(s) for s in found[20:200]) < 0.15
    assert max(abs(s - 1.0) for s in found[220:]) < 0.15


RUNS_AWAY = {"slips": (0.1, 0.7), "speed": 0.6}
STANDS = {"slips": (0.3, 0.5), "speed": -0.6}


def drive(slips=(0.1, 0.1), speed=1.2, thrusts=(0.3, 0.3), draft=0.2, moves_from=0.0) -> list[Sample]:
    """Samples of 13 s: steady, then from 8 s on slip, speed [m/s], thrust and draft go evenly to these values."""
    samples = []
    for t in np.arange(0.0, 13.0, LOOK).tolist():
        k = max(t - 8.0, 0.0) / 5.0
        V, slip, thrust, pull = (a + k * (b - a) for a, b in ((1.2, speed), slips, thrusts, (0.2, draft)))
        V = max(V, 0.0) if t >= moves_from else 0.0
        samples.append(Sample(t, V, 0.01**2, V / (1.0 - slip), 0.01**2, thrust, draft=pull))
    return samples


@pytest.mark.parametrize("sign", [RUNS_AWAY, STANDS])
def test_it_warns_where_slip_runs_away_and_where_the_vehicle_is_about_to_stand(sign):
    (begun,) = warnings(drive(**sign))
    assert 8.0 < begun < 12.0


@pytest.mark.parametrize(
    ("sign", "otherwise"),
    [
        (RUNS_AWAY, {"slips": (0.1, 0.2)}),
        (RUNS_AWAY, {"speed": 1.3}),
        (RUNS_AWAY, {"thrusts": (0.02, 0.02)}),
        (RUNS_AWAY, {"draft": 0.5}),
        (RUNS_AWAY, {"moves_from": 12.2}),
        (STANDS, {"slips": (0.1, 0.2)}),
        (STANDS, {"thrusts": (0.3, -1.0)}),
    ],
)
def test_one_sign_less_is_no_stall(sign, otherwise):
    """Slip that stays, speed that grows, no push, a draft that grows, a start, hardly any slip, a driver who stops."""
    assert warnings(drive(**sign | otherwise)) == []
